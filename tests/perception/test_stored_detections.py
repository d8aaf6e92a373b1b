import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pycocotools import mask as run_lengths

from perception.estimates import PerceptionError
from perception.stored_detections import StoredDetections, read_detections


def result(image: int, score: float) -> dict:
    mask = np.zeros((40, 60), np.uint8, order="F")
    mask[5:15, 10:30] = 1
    runs = run_lengths.encode(mask)
    runs["counts"] = runs["counts"].decode("ascii")
    return {
        "image_id": image,
        "category_id": 2,
        "segmentation": runs,
        "bbox": [10.0, 5.0, 20.0, 10.0],
        "score": score,
    }


STORED = StoredDetections(
    method="maskrcnn",
    weights="1a2b",
    data="3c4d",
    min_score=0.5,
    seconds={0: 0.25, 1001: 0.5},
    results=(result(0, 0.9), result(0, 0.3), result(1001, 0.5)),
)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    STORED.write(tmp_path / "out" / "detections.json")
    assert read_detections(tmp_path / "out" / "detections.json") == STORED
    assert len(list((tmp_path / "out").iterdir())) == 1


def test_results_are_in_cocos_form(tmp_path: Path) -> None:
    STORED.write(tmp_path / "detections.json")
    results = json.loads((tmp_path / "detections.json").read_text())["results"]
    mask = run_lengths.decode(results[0]["segmentation"])
    assert mask.shape == (40, 60) and mask.sum() == 200


def test_what_is_below_the_threshold_does_not_count() -> None:
    assert [r["score"] for r in STORED.counted(0)] == [0.9]
    assert [r["score"] for r in STORED.counted(1001)] == [0.5]
    assert STORED.counted(2) == []


def test_detections_of_other_data_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"3c4d, this one is ffff: run maskrcnn on it"):
        STORED.check("ffff", [0, 1001], tmp_path / "detections.json")


def test_images_nobody_looked_at_are_not_images_without_parts(tmp_path: Path) -> None:
    STORED.check("3c4d", [0, 1001], tmp_path / "detections.json")
    with pytest.raises(PerceptionError, match=r"lacks 1 of 3 images, 001000 the first"):
        STORED.check("3c4d", [0, 1000, 1001], tmp_path / "detections.json")


@pytest.mark.parametrize("name", ["method", "weights", "data", "min_score", "seconds", "results"])
def test_a_file_that_lacks_something_is_refused_by_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "detections.json"
    STORED.write(path)
    content = json.loads(path.read_text())
    del content[name]
    path.write_text(json.dumps(content))
    with pytest.raises(PerceptionError, match=rf"detections\.json has no {name}; a file of detections has"):
        read_detections(path)


@pytest.mark.parametrize(("field", "value"), [("score", None), ("area", 3.0)])
def test_a_result_of_another_form_is_refused(field: str, value: float | None, tmp_path: Path) -> None:
    changed = dict(result(0, 0.9)) | ({field: value} if value is not None else {})
    if value is None:
        del changed[field]
    replace(STORED, results=(result(0, 0.9), changed)).write(tmp_path / "detections.json")
    with pytest.raises(PerceptionError, match=rf"result 1 differs from COCO's form in {field}"):
        read_detections(tmp_path / "detections.json")


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "detections.json"
    STORED.write(path)
    path.write_text(path.read_text()[:200])
    with pytest.raises(PerceptionError, match=r"detections\.json cannot be read"):
        read_detections(path)
