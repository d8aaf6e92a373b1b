from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.choice import FEATURES
from perception.dataset import CropSet
from perception.estimates import PerceptionError
from perception.fit_choice import NEUTRAL, ChoiceFitConfig, CropEvidence, collect_evidence, fit_weights

CONFIG = ChoiceFitConfig(data=Path("data"), out=Path("out"))


def evidence(rng: np.random.Generator, count: int = 600) -> list[CropEvidence]:
    """Crops of which a tenth hold no part; the right hypothesis matches better, and empty crops match badly."""
    out = []
    for i in range(count):
        has = i % 10 > 0
        e = rng.normal(size=(3, len(FEATURES))) * 0.1
        e[:, FEATURES.index("matched_fraction")] += 0.4
        right = np.zeros(3, bool)
        if has:
            right[rng.integers(3)] = True
            e[right, FEATURES.index("matched_fraction")] += 0.5
        not_a_part = float(rng.beta(1, 9) if has else rng.beta(9, 1))
        out.append(CropEvidence(evidence=e, right=right, usable=right, not_a_part=not_a_part, has_part=has))
    return out


def test_fitted_weights_choose_and_decline_well() -> None:
    weights, figures = fit_weights(evidence(np.random.default_rng(0)), CONFIG)
    assert weights.choice["matched_fraction"] > 0
    assert figures["usable"] > 0.95
    assert figures["best_possible"] == 1.0
    assert figures["usable_of_accepted"] >= CONFIG.wanted_right
    assert figures["accepted_share"] > 0.8
    assert figures["empty_accepted"] < 0.1


def test_the_same_evidence_gives_the_same_weights() -> None:
    first, _ = fit_weights(evidence(np.random.default_rng(1), 200), CONFIG)
    second, _ = fit_weights(evidence(np.random.default_rng(1), 200), CONFIG)
    assert first == second


def test_half_resolution_crops_are_refused() -> None:
    n = 2
    crops = CropSet(
        images=np.zeros((n, 128, 128, 3), np.uint8),
        obj_id=np.zeros(n, np.int64),
        stable_pose=np.full(n, -1),
        T_cam_part=np.tile(np.eye(4), (n, 1, 1)),
        T_cam_board=np.tile(np.eye(4), (n, 1, 1)),
        K=np.tile(np.eye(3), (n, 1, 1)),
        packed_masks=np.zeros((n, 128, 16), np.uint8),
    )
    with pytest.raises(PerceptionError, match="--recipe val_fine"):
        collect_evidence(None, crops)  # pyright: ignore[reportArgumentType]


def test_settings_that_make_no_sense_are_errors() -> None:
    with pytest.raises(ValueError, match="wanted_right"):
        replace(CONFIG, wanted_right=1.0)
    assert set(NEUTRAL.choice) == set(FEATURES)
