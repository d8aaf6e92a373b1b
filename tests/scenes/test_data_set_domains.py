"""Labels of a data set are the same files in every domain rendered here; images do not depend on the shards."""

import cv2
import numpy as np
import pytest

from cad.spatial import inverse
from cad.tagboard import TagboardConfig
from perception.calibration import camera_from_tags
from perception.estimates import Frame
from scenes.dataset_config import DatasetConfig
from scenes.generate import generate
from scenes.image_maker import ImageMaker
from scenes.shots import ShotRanges

CROPS = {"kind": "crop", "size": (64, 64), "downscale": 4, "count": 6, "seed": 1}
LABELS = ("scene_gt.json", "scene_gt_info.json", "scene_gt_coco.json", "scene_camera.json")


@pytest.fixture(scope="module")
def classic(tmp_path_factory):
    out = tmp_path_factory.mktemp("classic") / "data"
    generate(DatasetConfig(**CROPS, shard=6), out)
    return out / "train"


def test_filament_writes_the_labels_of_classic(classic, tmp_path):
    generate(DatasetConfig(**CROPS, shard=6, domain="filament"), tmp_path / "data")
    ours, theirs = classic / "000000", tmp_path / "data" / "train" / "000000"
    masks = sorted(path.relative_to(ours) for path in ours.glob("mask*/*"))
    assert len(masks) >= 6 and masks == sorted(path.relative_to(theirs) for path in theirs.glob("mask*/*"))
    for name in (*LABELS, *masks):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    for path in sorted((ours / "rgb").iterdir()):
        assert path.read_bytes() != (theirs / "rgb" / path.name).read_bytes()


def test_images_do_not_depend_on_shards_or_on_what_the_worker_made_before(classic, tmp_path):
    generate(DatasetConfig(**CROPS, shard=4), tmp_path / "data")
    for index in range(4, 6):
        ours = classic / "000000" / "rgb" / f"{index:06d}.png"
        theirs = tmp_path / "data" / "train" / "000001" / "rgb" / f"{index - 4:06d}.png"
        np.testing.assert_array_equal(cv2.imread(str(ours)), cv2.imread(str(theirs)))


@pytest.mark.slow
def test_tags_are_found_as_well_on_path_traced_ground_of_few_samples(tmp_path, monkeypatch):
    monkeypatch.setattr("scenes.path_traced.LARGE_PX", 100_000)
    shots = ShotRanges(scene_parts=(2, 3), scene_distractors=(0, 1), scene_crumbs=(0, 0))
    found = {}
    for domain in ("classic", "mitsuba"):
        config = DatasetConfig(kind="scene", domain=domain, size=(1368, 912), seed=4, shots=shots)
        maker = ImageMaker(config, tmp_path)
        try:
            made = maker.make(0)
        finally:
            maker.close()
        frame = Frame(image=made.image, intrinsics=made.intrinsics, time_s=0.0)
        found[domain] = camera_from_tags(frame, TagboardConfig())
        difference = inverse(made.T_cam_board) @ found[domain].T_cam_board
        assert np.linalg.norm(difference[:2, 3]) < 2e-5 and abs(difference[2, 3]) < 2e-4
    assert found["mitsuba"].tags_seen == found["classic"].tags_seen > 15
    assert found["mitsuba"].rms_px < 1.5 * found["classic"].rms_px
