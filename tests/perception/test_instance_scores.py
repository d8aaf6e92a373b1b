"""Table 1 on frames with known answers, and COCO's figures beside our own average precision."""

import numpy as np
import pytest
from made_frames import LAYOUT, estimate_of, moved, right_answer, seen, write_frames
from pycocotools.coco import COCO

from cad.run_lengths import overlaps
from perception.bootstrap import FrameBootstrap
from perception.coco_results import coco_ground_truth, coco_scores, frame_results, write_coco_results
from perception.estimates import NOT_A_PART, PerceptionError
from perception.ground_truth import read_ground_truth
from perception.instance_scores import instance_scores
from perception.metrics import COCO_THRESHOLDS, DetectionScores

CUT = ("top", 0, 0.0, 0.0245, 0.0)
OBJ_IDS = {"inserted": 1, "main": 2, "top": 3}


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames") / "data"
    return read_ground_truth(write_frames(folder, [LAYOUT, [*LAYOUT[:2], CUT], LAYOUT[1:]]))


def scores(truth, estimates, min_score: float = 0.0):
    results = [r for f, e in zip(truth.frames, estimates, strict=True) for r in frame_results(e, f, OBJ_IDS)]
    return instance_scores(truth, results, FrameBootstrap([0, 1, 2], np.random.default_rng(0), 100), min_score)


def test_perfect_instances_score_one_without_the_part_that_is_cut(truth) -> None:
    found = scores(truth, [right_answer(f) for f in truth.frames])
    for name in ("ap", "ap50", "ap75", "ar", "precision50", "recall50"):
        assert found[name] == pytest.approx(1.0), name
    assert found["mean_iou_of_found"] == 1.0 and found["n_parts"] == truth.n_parts == 7
    assert found["paper_ap"]["0.95"] == found["paper_ar"]["mean"] == 1.0
    assert found["parts"]["main"]["iou"] == 1.0 and found["intervals_95"]["recall50"] == (1.0, 1.0)


def test_nothing_found_scores_nothing(truth) -> None:
    found = scores(truth, [seen() for _ in truth.frames])
    assert found["recall50"] == found["ap"] == found["ar"] == found["miou"] == 0.0 and np.isnan(found["precision50"])


def test_a_wrong_class_is_found_but_wrong(truth) -> None:
    swapped = [r for f in truth.frames for r in frame_results(right_answer(f), f, OBJ_IDS)]
    swapped[0]["category_id"] = 3
    found = instance_scores(truth, swapped, FrameBootstrap([0, 1, 2], np.random.default_rng(0), 50))
    assert found["recall50"] == found["precision50"] == 1.0
    assert found["parts"]["inserted"]["recall50"] == 0.5 and found["parts"]["top"]["precision50"] == 0.0
    assert found["paper_ar"]["0.50"] == pytest.approx((0.5 + 1.0) / 2) and found["miou"] < 0.7


def test_misses_and_strays_count_where_they_should(truth) -> None:
    frame = truth.frames[0]
    stray = estimate_of(frame.parts[0], moved(frame.parts[0], 0.02), score=0.2)
    answers = [seen(estimate_of(frame.parts[0]), stray), *(right_answer(f) for f in truth.frames[1:])]
    found = scores(truth, answers)
    assert found["recall50"] == pytest.approx(5 / 7) and found["precision50"] == pytest.approx(5 / 6)
    sure = scores(truth, answers, min_score=0.5)
    assert sure["precision50"] == 1.0 and sure["ap"] == found["ap"]


def test_rejected_estimates_are_no_instances(truth) -> None:
    part = truth.frames[0].parts[0]
    estimates = seen(estimate_of(part, verdict=NOT_A_PART), estimate_of(part, mask=None))
    assert frame_results(estimates, truth.frames[0], OBJ_IDS) == []


def test_coco_figures_are_those_of_our_average_precision(truth) -> None:
    """Masks shifted at random, one class: pycocotools and DetectionScores go through the same matching."""
    rng, own, results = np.random.default_rng(4), DetectionScores(), []
    frames = [f for f in truth.frames if all(p.whole for p in f.parts)]
    content = coco_ground_truth(truth)
    wanted = {"id": 2, "name": "main"}
    kept = [a for a in content["annotations"] if a["category_id"] == 2 and a["image_id"] != 1]
    for f in frames:
        mains = [p for p in f.parts if p.part.name == "main"]
        guesses = [
            estimate_of(p, moved(p, *rng.normal(0, 1.5e-3, 2)), score=float(rng.uniform())) for p in mains for _ in "ab"
        ]
        found = frame_results(seen(*guesses), f, OBJ_IDS)
        results += found
        own.add(overlaps([r["segmentation"] for r in found], [p.runs for p in mains]), [r["score"] for r in found])
    one_class = {**content, "annotations": kept, "categories": [wanted]}
    scored = coco_scores(one_class, results)
    assert 0.02 < scored["ap"] < 0.98
    assert scored["ap"] == pytest.approx(np.mean([own.average_precision(t) for t in COCO_THRESHOLDS]), abs=1e-9)
    assert scored["ar"] == pytest.approx(np.mean([own.precision_recall(t)[1] for t in COCO_THRESHOLDS]), abs=1e-9)


def test_results_of_other_images_are_errors(truth) -> None:
    result = frame_results(right_answer(truth.frames[0]), truth.frames[0], OBJ_IDS)[0]
    with pytest.raises(PerceptionError, match=r"images \[77\]"):
        coco_scores(coco_ground_truth(truth), [{**result, "image_id": 77}])


def test_results_are_as_coco_loads_them(truth, tmp_path) -> None:
    frame = truth.frames[0]
    results = frame_results(right_answer(frame), frame, OBJ_IDS)
    write_coco_results(tmp_path / "coco" / "m.json", results)
    reference = COCO()
    reference.dataset = coco_ground_truth(truth)
    reference.createIndex()
    loaded = reference.loadRes(str(tmp_path / "coco" / "m.json"))
    masks = [loaded.annToMask(a) for a in loaded.loadAnns(loaded.getAnnIds())]
    assert [m.shape for m in masks] == [(700, 1000)] * 3
    estimate = estimate_of(frame.parts[0])
    u, v = estimate.mask_origin
    assert estimate.mask is not None
    h, w = estimate.mask.shape
    assert (masks[0][v : v + h, u : u + w] == estimate.mask).all() and masks[0].sum() == estimate.mask.sum()
