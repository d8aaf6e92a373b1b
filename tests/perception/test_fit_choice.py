import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from perception.choice import FEATURES, NEUTRAL, CropContext
from perception.choice_errors import normalised_errors
from perception.choice_evidence import CropFindings, FrameFindings, collect, findings_from_json, winner_of
from perception.estimates import PerceptionError
from perception.estimator import EstimatorConfig
from perception.fit_choice import ChoiceFitConfig, fit_weights

CONFIG = ChoiceFitConfig(data=(Path("data"),), out=Path("out"), wanted_right=0.98)
SIGMA = np.array([1e-5, 1e-5, 1e-3, 3e-5, 2e-3, 2e-3])


def crop(rng: np.random.Generator, has: bool) -> CropFindings:
    """Three readings of a crop; the right one matches better, and of empty crops all match badly."""
    e = rng.normal(size=(3, len(FEATURES))) * 0.1
    e[:, FEATURES.index("matched_fraction")] += 0.4
    right = np.zeros(3, bool)
    if has:
        right[rng.integers(3)] = True
        e[right, FEATURES.index("matched_fraction")] += 0.5
    context = CropContext(
        not_a_part=float(rng.beta(1, 9) if has else rng.beta(9, 1)),
        entropy=0.1,
        segmenter_score=float(rng.beta(6, 2) if has else rng.beta(3, 3)),
        cut=False,
        tag_rms_px=0.1,
    )
    return CropFindings(
        evidence=e.tolist(),
        first=[True, False, False],
        right=right.tolist(),
        usable=right.tolist(),
        reading=[0, 1, 2],
        place=[[0.0, 0.0]] * 3,
        right_reading=right.tolist(),
        sure=False,
        context=context,
        part="block" if has else "",
        stable_pose=0 if has else -1,
        whole=True,
        errors=[rng.normal(0, SIGMA).tolist() if r else None for r in right],
        planar=[np.diag(np.square([1e-7, 1e-7, 1e-5])).tolist()] * 3,
    )


def frames(seed: int, count: int = 40) -> list[FrameFindings]:
    """Frames of ten detections, one of which is of no part."""
    rng = np.random.default_rng(seed)
    return [
        FrameFindings(
            data="data",
            domain="classic",
            image=i,
            whole_parts=9,
            found_parts=9,
            crops=tuple(crop(rng, has=k > 0) for k in range(10)),
        )
        for i in range(count)
    ]


def test_fitted_weights_choose_and_decline_well() -> None:
    weights, figures = fit_weights(frames(0), CONFIG)
    assert weights.choice["matched_fraction"] > 0
    assert figures["usable"] > 0.95
    assert figures["best_possible"] == 1.0
    assert figures["accepted"] > 0.8
    assert figures["accepted_wrong"] <= (1 - CONFIG.wanted_right) * 0.9 * 400
    assert figures["accepted_wrong"] <= figures["accepted_unusable"] <= (1 - CONFIG.wanted_usable) * 0.9 * 400
    assert figures["part_kept"] > 0.95
    assert figures["empty_kept"] < 0.15
    assert figures["set_holds"] >= 0.97
    assert weights.noise["block"].height_m == pytest.approx(3e-5, rel=0.1)


def test_covariances_hold_on_frames_they_were_not_fitted_on() -> None:
    found = frames(1, 20)
    held = normalised_errors(found, fit_weights(found, CONFIG)[0], CONFIG.folds)
    assert set(held) == {"block", "block, classic"}
    assert held["block"]["planar"] == pytest.approx(3.0, abs=0.6)
    assert held["block"]["pose"] == pytest.approx(6.0, abs=0.9)


def test_the_same_findings_give_the_same_weights() -> None:
    assert fit_weights(frames(2, 10), CONFIG)[0] == fit_weights(frames(2, 10), CONFIG)[0]


def test_what_the_pipeline_would_not_have_refined_does_not_count() -> None:
    found = crop(np.random.default_rng(3), has=True)
    e = np.array(found.evidence)
    e[2, FEATURES.index("matched_fraction")] = 5.0
    assert winner_of(replace(found, evidence=e.tolist()), NEUTRAL)[0] == 2
    best, scores, gate = winner_of(replace(found, evidence=e.tolist(), sure=True), NEUTRAL)
    assert best == 0
    assert np.isneginf(scores[1:]).all()
    assert gate[1] == 8.0


def test_findings_survive_the_file() -> None:
    (found,) = frames(4, 1)
    assert findings_from_json(json.loads(json.dumps(asdict(found)))) == found


def test_too_few_frames_and_no_data_are_errors(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"10 are needed.*render more frames"):
        fit_weights(frames(5, 4), CONFIG)
    for name in ("segmentation", "classifier", "verifier", "keypoints"):
        (tmp_path / f"{name}.safetensors").write_bytes(b"")
    with pytest.raises(PerceptionError, match="--data DIR"):
        collect([], tmp_path, tmp_path / "cache", EstimatorConfig())


def test_settings_that_make_no_sense_are_errors() -> None:
    with pytest.raises(ValueError, match="wanted_right"):
        replace(CONFIG, wanted_right=1.0)
    with pytest.raises(ValueError, match="folds"):
        replace(CONFIG, folds=2)
