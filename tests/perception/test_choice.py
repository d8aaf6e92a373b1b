from pathlib import Path

import numpy as np
import pytest

from perception.choice import (
    FEATURES,
    GATE_FEATURES,
    ChoiceWeights,
    fit_choice_weights,
    fit_gate,
    gate_evidence,
    threshold_for,
)
from perception.estimates import PerceptionError

PLAIN = ChoiceWeights(choice=dict.fromkeys(FEATURES, 1.0), gate=dict.fromkeys(GATE_FEATURES, 0.5), accept_above=0.5)


def crops(rng: np.random.Generator, count: int = 400):
    """Crops with three hypotheses each; the evidence of the right one is larger in two features by a known amount."""
    evidence, right = [], []
    for _ in range(count):
        e = rng.normal(size=(3, len(FEATURES)))
        truth = int(rng.integers(3))
        e[truth, FEATURES.index("verifier")] += 2.0
        e[truth, FEATURES.index("matched_fraction")] += 1.0
        evidence.append(e)
        right.append(np.arange(3) == truth)
    return evidence, right


def test_fitted_weights_find_the_evidence_that_matters() -> None:
    evidence, right = crops(np.random.default_rng(0))
    weights = fit_choice_weights(evidence, right)
    ranked = sorted(FEATURES, key=lambda name: -abs(weights[name]))
    assert ranked[:2] == ["verifier", "matched_fraction"]
    assert weights["verifier"] == pytest.approx(2.0, abs=0.6)  # the log likelihood ratio of unit normals 2 apart
    fitted = ChoiceWeights(choice=weights, gate=PLAIN.gate, accept_above=0.5)
    share = np.mean([r[int(fitted.scores(e).argmax())] for e, r in zip(evidence, right, strict=True)])
    assert share > 0.85


def test_gate_is_calibrated() -> None:
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(4000, len(GATE_FEATURES)))
    evidence[:, 0] = 1.0
    right = rng.random(4000) < 1 / (1 + np.exp(-(1.0 + 1.5 * evidence[:, 1])))
    weights = ChoiceWeights(choice=PLAIN.choice, gate=fit_gate(evidence, right), accept_above=0.5)
    p = weights.probability_right(evidence)
    for low in (0.2, 0.4, 0.6, 0.8):
        inside = (p >= low) & (p < low + 0.2)
        assert right[inside].mean() == pytest.approx(p[inside].mean(), abs=0.05)


def test_threshold_keeps_the_wanted_share_right() -> None:
    p = np.linspace(0.01, 0.99, 99)
    right = p > 0.5
    threshold = threshold_for(p, right, 0.9)
    accepted = p > threshold
    assert right[accepted].mean() >= 0.9
    assert accepted.sum() > right.sum()
    assert threshold_for(p, np.zeros(99, bool), 0.9) >= 0.98  # nothing is good enough: next to nothing is accepted


def test_lead_is_that_over_the_best_other() -> None:
    evidence = np.zeros((3, len(FEATURES)))
    gate = gate_evidence(np.array([1.0, 4.0, 3.5]), evidence, 1, 0.5)
    assert gate[GATE_FEATURES.index("lead")] == pytest.approx(0.5)
    assert gate[GATE_FEATURES.index("not_a_part")] == pytest.approx(0.0)
    alone = gate_evidence(np.array([1.0]), evidence[:1], 0, 1e-9)
    assert alone[GATE_FEATURES.index("lead")] == 8.0
    assert np.isfinite(alone).all()


def test_weights_round_trip(tmp_path: Path) -> None:
    PLAIN.save(tmp_path / "choice.json")
    assert ChoiceWeights.load(tmp_path / "choice.json") == PLAIN


def test_missing_and_unfit_weights_are_errors(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"perception\.train choice"):
        ChoiceWeights.load(tmp_path / "none.json")
    (tmp_path / "odd.json").write_text('{"weights": 1}')
    with pytest.raises(PerceptionError, match="fit them again"):
        ChoiceWeights.load(tmp_path / "odd.json")
    with pytest.raises(PerceptionError, match="expected classifier"):
        ChoiceWeights(choice={"verifier": 1.0}, gate=PLAIN.gate, accept_above=0.5)
    with pytest.raises(PerceptionError, match="nothing to fit"):
        fit_choice_weights([np.zeros((1, len(FEATURES)))], [np.array([True])])
