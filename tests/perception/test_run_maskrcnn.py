import json
from pathlib import Path

import numpy as np
import pytest
from data_sets import Picture, patch, write_data_set
from pycocotools import mask as run_lengths

from cad.parts import BUILT_IN, load_part
from cad.spatial import BASLER, rotation_x, transform
from perception import run_maskrcnn
from perception.run_maskrcnn import MaskRCNNRun, main
from perception.segmentation import Detection
from perception.stored_detections import read_detections

SIDE = 64


class BrightSquares:
    """Finds what is bright, instead of a network; counts the images that it was shown."""

    part_names = BUILT_IN
    min_score = 0.5

    def __init__(self) -> None:
        self.shown = 0

    def detect_reduced(self, image: np.ndarray, min_score: float) -> list[Detection]:
        self.shown += 1
        v, u = np.nonzero(image[..., 0] > 200)
        mask = np.zeros((v.max() - v.min() + 1, u.max() - u.min() + 1), bool)
        mask[v - v.min(), u - u.min()] = True
        return [
            Detection(
                centre_px=np.array([u.mean(), v.mean()]),
                score=0.8,
                class_probabilities=np.array([0.0, 1.0, 0.0]),
                mask=mask,
                mask_origin=(int(u.min()), int(v.min())),
            )
        ]


@pytest.fixture
def segmenter(monkeypatch) -> BrightSquares:
    squares = BrightSquares()
    monkeypatch.setattr(run_maskrcnn.MaskRCNNSegmenter, "load", lambda *_: squares)
    return squares


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Three windows, each with a bright square at another place."""
    parts = [load_part(name) for name in BUILT_IN]
    camera = BASLER.crop(2700, 1800, SIDE, SIDE)
    T_cam_board = transform(rotation_x(np.pi), [0, 0, 0.7])
    pictures = []
    for k in range(3):
        image = np.full((SIDE, SIDE, 3), 90, np.uint8)
        image[20 : 20 + 9, 10 + 8 * k : 10 + 8 * k + 9] = 250
        square = patch(parts[1].obj_id, 0, transform(np.eye(3), [0, 0, 0.7]), 10 + 8 * k, 20, size=9)
        pictures.append(Picture(image, camera, T_cam_board, [square]))
    folder = write_data_set(tmp_path / "data", "val", parts, pictures)
    described = {
        "kind": "window",
        "domain": "classic",
        "split": "val",
        "size": [SIDE, SIDE],
        "parts": {part.name: {"mesh": part.mesh_hash} for part in parts},
    }
    (folder / "dataset.json").write_text(json.dumps(described))
    return folder


def weights(tmp_path: Path, content: str = "weights") -> Path:
    (tmp_path / "weights").mkdir(exist_ok=True)
    (tmp_path / "weights" / "maskrcnn.safetensors").write_text(content)
    return tmp_path / "weights"


def run(tmp_path: Path, data: Path, *more: str) -> int:
    out = tmp_path / "found.json"
    return main(["--data", str(data), "--out", str(out), "--weights", str(tmp_path / "weights"), *more])


def test_the_file_holds_the_masks_and_classes_of_all_images(tmp_path, data, segmenter) -> None:
    weights(tmp_path)
    assert run(tmp_path, data) == 0
    found = read_detections(tmp_path / "found.json")
    assert sorted(found.seconds) == [0, 1, 2] and segmenter.shown == 3
    for k, result in enumerate(found.results):
        assert result["image_id"] == k and result["category_id"] == load_part(BUILT_IN[1]).obj_id
        assert result["bbox"] == [10 + 8 * k, 20, 9, 9]
        assert run_lengths.decode(result["segmentation"]).sum() == 81


def test_a_run_that_stopped_goes_on_where_it_was(tmp_path, data, segmenter) -> None:
    weights(tmp_path)
    assert run(tmp_path, data) == 0
    whole = read_detections(tmp_path / "found.json")
    (tmp_path / "found.json").unlink()
    segmenter.shown = 0
    assert run(tmp_path, data, "--count", "1") == 0
    assert segmenter.shown == 1
    assert run(tmp_path, data) == 0
    assert segmenter.shown == 3
    assert read_detections(tmp_path / "found.json").results == whole.results


def test_detections_of_other_weights_are_not_added_to(tmp_path, data, segmenter, capsys) -> None:
    weights(tmp_path)
    assert run(tmp_path, data, "--count", "1") == 0
    before = (tmp_path / "found.json").read_text()
    weights(tmp_path, "other weights")
    assert run(tmp_path, data) == 1
    assert "give another --out, or remove it" in capsys.readouterr().err
    assert (tmp_path / "found.json").read_text() == before


def test_a_folder_without_a_data_set_is_named(tmp_path, segmenter, capsys) -> None:
    weights(tmp_path)
    assert run(tmp_path, tmp_path / "nothing") == 1
    assert str(tmp_path / "nothing") in capsys.readouterr().err


def test_a_count_of_none_is_refused() -> None:
    with pytest.raises(ValueError, match="count = 0"):
        MaskRCNNRun(data=Path("a"), out=Path("b"), count=0)
