"""What the generator writes the reader gives back: the same poses, masks and keypoints, and rests that are labels."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO

from cad.parts import BUILT_IN, load_part
from cad.spatial import BASLER, apply
from perception.dataset import CropSet, WindowSet, load_crops, load_windows
from perception.faces import FaceTable
from perception.labels import label_crops
from perception.voting import ransac_vote, vector_field
from scenes.dataset_config import DatasetConfig
from scenes.generate import generate

PARTS = [load_part(name) for name in BUILT_IN]
CROPS = DatasetConfig(kind="crop", split="val", size=(128, 128), downscale=2, count=10, shard=5, seed=2, jpeg=95)
WINDOWS = DatasetConfig(kind="window", split="test", count=4, seed=3, faces="physics")


@pytest.fixture(scope="module")
def crops_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("crops") / "set"
    generate(CROPS, out)
    return out


@pytest.fixture(scope="module")
def crops(crops_dir: Path) -> CropSet:
    return load_crops(crops_dir)


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> WindowSet:
    out = tmp_path_factory.mktemp("windows") / "set"
    generate(WINDOWS, out)
    return load_windows(out)


def annotations_of(data_dir: Path, split: str) -> list[list[dict]]:
    """COCO annotations of every image, in order."""
    out = []
    for shard in sorted((data_dir / split).glob("[0-9]*")):
        with contextlib.redirect_stdout(io.StringIO()):
            coco = COCO(str(shard / "scene_gt_coco.json"))
        out += [coco.imgToAnns[image] for image in sorted(coco.imgs)]
    return out


def test_crops_are_those_that_were_asked_for(crops: CropSet) -> None:
    assert crops.images.shape == (10, 128, 128, 3)
    np.testing.assert_allclose(crops.K[:, 0, 0], BASLER.fx / 2)
    assert (crops.obj_id > 0).sum() >= 5 and set(crops.obj_id.tolist()) <= {0, 1, 2, 3}
    assert crops.masks().any(axis=(1, 2)).tolist() == (crops.obj_id > 0).tolist()


def test_targets_lie_near_the_middle_on_the_face_that_the_label_names(crops: CropSet) -> None:
    labels = crops.labels(PARTS)
    for i in np.flatnonzero(crops.obj_id > 0):
        assert np.abs(labels.body_px[i] - 63.5).max() < 20
        part = PARTS[labels.part_index[i]]
        T_table_part = np.linalg.inv(labels.T_cam_table[i]) @ crops.T_cam_part[i]
        up = part.stable_poses[crops.stable_pose[i]].R_table_part[2]
        assert np.degrees(np.arccos(np.clip(up @ T_table_part[2, :3], -1, 1))) < 2.0
        assert abs(apply(T_table_part, part.mesh.vertices)[:, 2].min()) < 2e-4


def test_keypoints_of_the_files_are_those_of_the_poses(crops: CropSet, crops_dir: Path) -> None:
    labels = label_crops(FaceTable(PARTS), crops)
    listed = annotations_of(crops_dir, "val")
    for i in np.flatnonzero(crops.obj_id > 0):
        target = next(a for a in listed[i] if a["gt_id"] == 0)
        keypoints = np.reshape(target["keypoints"], (-1, 3))[:, :2]
        part = next(p for p in PARTS if p.obj_id == target["category_id"])
        projected = apply(crops.T_cam_part[i], part.keypoints) @ crops.K[i].T
        np.testing.assert_allclose(keypoints, projected[:, :2] / projected[:, 2:], atol=1e-3)
        # a label is of the face as stored: a part that leans on dust is off by a fraction of a pixel
        assert np.abs(labels.keypoints[i, 0] - keypoints).max() < 1.5


def test_vector_fields_follow_from_the_files(crops: CropSet, crops_dir: Path) -> None:
    listed = annotations_of(crops_dir, "val")
    i = int(np.flatnonzero(crops.obj_id > 0)[0])
    keypoints = np.reshape(next(a for a in listed[i] if a["gt_id"] == 0)["keypoints"], (-1, 3))[:, :2]
    mask = crops.masks(i)
    v, u = np.nonzero(mask)
    field = vector_field(mask, keypoints)[v, u]
    found, _ = ransac_vote(np.stack([u, v], axis=-1), field, np.random.default_rng(0))
    np.testing.assert_allclose(found, keypoints, atol=0.1)


def test_windows_hold_every_part_that_is_seen(windows: WindowSet) -> None:
    assert windows.images.shape == (4, 320, 320, 3) and len(windows.obj_id) >= 4
    for i, rows in enumerate(windows.instances_of):
        assert set(np.unique(windows.instance_map[i])) - {0} == set((windows.instance[rows] + 1).tolist())
    labels = windows.labels(PARTS)
    for m, (image, k) in enumerate(zip(windows.image_index, windows.instance, strict=True)):
        v, u = np.nonzero(windows.instance_map[image] == k + 1)
        inside = u.min() > 0 and u.max() < 319 and v.min() > 0 and v.max() < 319
        if inside:
            assert np.hypot(*(labels.body_px[m] - [u.mean(), v.mean()])) < 15
