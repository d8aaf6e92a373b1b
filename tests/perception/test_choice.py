from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.choice import FEATURES, GATE_FEATURES, ChoiceWeights, CropContext, gate_evidence
from perception.choice_models import (
    cautious_threshold,
    fit_choice_weights,
    fit_gate,
    fit_part,
    fit_temperature,
    wrong_share_bound,
)
from perception.covariance import NoiseModel
from perception.estimates import PerceptionError

PLAIN = ChoiceWeights(
    choice=dict.fromkeys(FEATURES, 1.0),
    gate=dict.fromkeys(GATE_FEATURES, 0.5),
    rivalry={"constant": 0.5, "lead": 2.0},
    part=dict.fromkeys(GATE_FEATURES, 0.25),
    accept_above=0.5,
    noise={"block": NoiseModel(floor_m=2e-5)},
)
CONTEXT = CropContext(not_a_part=0.5, entropy=0.2, segmenter_score=0.5, cut=False, tag_rms_px=0.1)


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
    fitted = ChoiceWeights(choice=weights, gate=PLAIN.gate, rivalry=PLAIN.rivalry, part=PLAIN.part, accept_above=0.5)
    share = np.mean([r[int(fitted.scores(e).argmax())] for e, r in zip(evidence, right, strict=True)])
    assert share > 0.85


def calibrated(p: np.ndarray, right: np.ndarray) -> None:
    for low in (0.2, 0.4, 0.6, 0.8):
        inside = (p >= low) & (p < low + 0.2)
        assert right[inside].mean() == pytest.approx(p[inside].mean(), abs=0.05)


def test_probabilities_are_calibrated_and_weights_keep_their_signs() -> None:
    rng = np.random.default_rng(1)
    evidence = rng.normal(size=(6000, len(GATE_FEATURES)))
    evidence[:, 0] = 1.0
    lead, matched, tags = (GATE_FEATURES.index(name) for name in ("lead", "matched_fraction", "tags"))
    has_part = rng.random(6000) < 1 / (1 + np.exp(-(1.0 + 1.5 * evidence[:, matched] - 0.5 * evidence[:, tags])))
    part = fit_part(evidence, has_part)
    assert part["tags"] == 0.0  # evidence that cannot speak against a part
    assert part["region_unexplained"] <= 0.0
    evidence[:, lead] = rng.exponential(2.0, 6000)
    good = 1 / (1 + np.exp(-(1.0 + 1.5 * evidence[:, matched])))
    right = rng.random(6000) < good / (1 + np.exp(-1.2 * evidence[:, lead]))
    gate, rivalry = fit_gate(evidence, right)
    weights = ChoiceWeights(choice=PLAIN.choice, gate=gate, rivalry=rivalry, part=part, accept_above=0.5)
    calibrated(weights.probability_right(evidence), right)
    calibrated(weights.probability_part(evidence), has_part)
    assert rivalry["lead"] == pytest.approx(1.2, abs=0.3)
    assert gate["matched_fraction"] == pytest.approx(1.5, abs=0.2)


def test_a_perfect_contour_does_not_help_against_an_equal_rival() -> None:
    gate = np.full(len(GATE_FEATURES), 50.0)
    gate[GATE_FEATURES.index("lead")] = 0.0
    even = ChoiceWeights(
        choice=PLAIN.choice, gate=PLAIN.gate, rivalry={"constant": 0.0, "lead": 1.0}, part=PLAIN.part, accept_above=0.5
    )
    assert even.probability_right(gate) == pytest.approx(0.5)


def test_temperature_is_found_again() -> None:
    rng = np.random.default_rng(2)
    scores, right = [], []
    for _ in range(2000):
        s = rng.normal(0, 4.0, 3)
        p = np.exp(s / 3.0) / np.exp(s / 3.0).sum()
        scores.append(s)
        right.append(np.arange(3) == rng.choice(3, p=p))
    assert fit_temperature(scores, right) == pytest.approx(3.0, rel=0.1)
    assert fit_temperature([np.zeros(1)], [np.array([True])]) == 1.0


def test_threshold_keeps_the_wanted_share_right() -> None:
    p = np.linspace(0.01, 0.99, 990)
    right = p > 0.5
    threshold = cautious_threshold(p, right, 0.9)
    accepted = p > threshold
    assert right[accepted].mean() >= 0.9
    assert accepted.sum() > right.sum()
    assert (
        cautious_threshold(p, np.zeros(990, bool), 0.9) >= 0.98
    )  # nothing is good enough: next to nothing is accepted


def test_few_examples_without_a_mistake_do_not_prove_much() -> None:
    p = np.linspace(0.5, 0.99, 40)
    right = np.ones(40, bool)
    right[0] = False
    few = cautious_threshold(p, right, 0.995)
    assert (p > few).sum() == 39  # the least bound that there is, though it does not reach what is wanted
    assert wrong_share_bound(0, 299, 0.95) == pytest.approx(0.01, abs=1e-4)
    assert wrong_share_bound(0, 139, 0.5) == pytest.approx(0.005, abs=1e-4)
    assert wrong_share_bound(3, 3, 0.95) == 1.0
    many = cautious_threshold(np.repeat(p, 30), np.repeat(right, 30), 0.995)
    assert (np.repeat(p, 30) > many).sum() == 39 * 30


def test_estimates_of_one_probability_are_accepted_together() -> None:
    p = np.array([0.9] * 200 + [0.5] * 200)
    right = np.array([True] * 200 + [True, False] * 100)
    assert 0.5 < cautious_threshold(p, right, 0.99) < 0.9


def test_lead_is_that_over_the_best_rival() -> None:
    evidence = np.zeros((3, len(FEATURES)))
    evidence[:, FEATURES.index("classifier")] = [-1.0, -3.0, -20.0]
    scores, everyone = np.array([1.0, 4.0, 3.5]), np.array([True, False, True])

    def of(name: str, gate: np.ndarray) -> float:
        return float(gate[GATE_FEATURES.index(name)])

    gate = gate_evidence(scores, evidence, 1, everyone, CONTEXT)
    assert of("lead", gate) == pytest.approx(0.5)
    assert of("proposed", gate) == pytest.approx(-2.0)
    assert of("verified", gate) == 0.0
    assert of("is_part", gate) == pytest.approx(0.0)
    same_view = gate_evidence(scores, evidence, 1, np.array([True, False, False]), CONTEXT)
    assert of("lead", same_view) == pytest.approx(3.0)
    alone = gate_evidence(np.array([1.0]), evidence[:1], 0, np.array([False]), CONTEXT)
    assert of("lead", alone) == 8.0
    assert np.isfinite(alone).all()


def test_weights_round_trip(tmp_path: Path) -> None:
    PLAIN.save(tmp_path / "choice.json")
    assert ChoiceWeights.load(tmp_path / "choice.json") == PLAIN
    assert [p.name for p in tmp_path.iterdir()] == ["choice.json"]
    assert PLAIN.noise_of("block", 0).floor_m == 2e-5
    upright = replace(PLAIN, noise=PLAIN.noise | {"block 1": NoiseModel(floor_m=5e-5)})
    assert upright.noise_of("block", 1).floor_m == 5e-5 and upright.noise_of("block", 2).floor_m == 2e-5
    assert PLAIN.noise_of("another", 0) == NoiseModel()


def test_missing_and_unfit_weights_are_errors(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"perception\.train choice"):
        ChoiceWeights.load(tmp_path / "none.json")
    (tmp_path / "odd.json").write_text('{"weights": 1}')
    with pytest.raises(PerceptionError, match="fit them again"):
        ChoiceWeights.load(tmp_path / "odd.json")
    with pytest.raises(PerceptionError, match="expected classifier"):
        ChoiceWeights(
            choice={"verifier": 1.0}, gate=PLAIN.gate, rivalry=PLAIN.rivalry, part=PLAIN.part, accept_above=0.5
        )
    with pytest.raises(PerceptionError, match="nothing to fit"):
        fit_choice_weights([np.zeros((1, len(FEATURES)))], [np.array([True])])
