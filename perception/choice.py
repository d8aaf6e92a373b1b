"""Chooses among the refined hypotheses of one crop, and says how sure the choice is.

Two logistic models with a handful of weights each, fitted on validation crops. The *choice* is listwise: the score of a
hypothesis is a weighted sum of its evidence, and scores of one crop's hypotheses are compared by softmax. The *gate*
turns the winner's lead and its absolute evidence into the probability that it is right; a threshold on that decides
whether the estimate may be acted on.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cad.spatial import Array
from perception.estimates import PerceptionError

FEATURES = (
    "classifier",
    "verifier",
    "matched_fraction",
    "matched_outline",
    "correlation",
    "explained",
    "region_fit",
    "region_unexplained",
    "keypoints",
)
"""Evidence for a hypothesis: natural log-probabilities of J and V, scores of the contour and of the region, and minus
the distance between voted and refined keypoints in camera pixels."""

AGAINST = ("region_unexplained",)
"""Evidence that speaks against a hypothesis the larger it is; all other evidence speaks for it."""

GATE_FEATURES = ("constant", "lead", "not_a_part", "matched_fraction", "correlation", "explained")
"""Evidence for the winner: its lead in score, the log-odds of "not a part", and its contour's absolute scores."""

MAX_LEAD = 8.0
MAX_LOG_ODDS = 6.0


@dataclass(frozen=True, kw_only=True)
class ChoiceWeights:
    """Weights by name, the gate's threshold, and what they were fitted on.

    ``accept_above`` is the probability of being right above which an estimate is accepted.
    """

    choice: dict[str, float]
    gate: dict[str, float]
    accept_above: float
    fitted_on: str = ""

    def __post_init__(self) -> None:
        for have, want in ((self.choice, FEATURES), (self.gate, GATE_FEATURES)):
            if set(have) != set(want):
                raise PerceptionError(f"weights for {', '.join(sorted(have))}; expected {', '.join(want)}: fit again")
        if not 0.0 <= self.accept_above < 1.0:
            raise PerceptionError(f"accept_above = {self.accept_above}: must be at least 0 and below 1")

    @staticmethod
    def load(path: Path) -> ChoiceWeights:
        """Read a JSON file; raises PerceptionError when there is none or it does not fit this version."""
        if not path.exists():
            raise PerceptionError(f"no choice weights at {path}; fit them with `python -m perception.train choice`")
        try:
            return ChoiceWeights(**json.loads(path.read_text()))
        except (TypeError, ValueError) as error:
            raise PerceptionError(f"{path} does not hold choice weights ({error}); fit them again") from error

    def save(self, path: Path) -> None:
        """Write as JSON."""
        content = {
            "choice": {name: round(self.choice[name], 5) for name in FEATURES},
            "gate": {name: round(self.gate[name], 5) for name in GATE_FEATURES},
            "accept_above": self.accept_above,
            "fitted_on": self.fitted_on,
        }
        path.write_text(json.dumps(content, indent=2) + "\n")

    def scores(self, evidence: Array) -> Array:
        """Scores (H,) in nats of hypotheses with evidence (H, len(FEATURES))."""
        return evidence @ np.array([self.choice[name] for name in FEATURES])

    def probability_right(self, gate_evidence: Array) -> Array:
        """Probability (...) that a winner with evidence (..., len(GATE_FEATURES)) is right."""
        odds = gate_evidence @ np.array([self.gate[name] for name in GATE_FEATURES])
        return 1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))


def gate_evidence(scores: Array, evidence: Array, best: int, not_a_part: float) -> Array:
    """Evidence (len(GATE_FEATURES),) for hypothesis ``best`` of those with ``scores`` (H,) and ``evidence`` (H, F).

    The lead is that over the best other hypothesis, 8 nats at most and when there is no other.
    """
    others = np.delete(scores, best)
    lead = MAX_LEAD if len(others) == 0 else float(np.clip(scores[best] - others.max(), -MAX_LEAD, MAX_LEAD))
    p = float(np.clip(not_a_part, 1e-4, 1 - 1e-4))
    log_odds = float(np.clip(np.log(p / (1 - p)), -MAX_LOG_ODDS, MAX_LOG_ODDS))
    row = dict(zip(FEATURES, evidence[best], strict=True))
    return np.array(
        [1.0, lead, log_odds, row["matched_fraction"], row["correlation"], row["explained"]], dtype=np.float64
    )


def fit_choice_weights(
    evidence: Sequence[Array], right: Sequence[NDArray[np.bool_]], penalty: float = 3e-3
) -> dict[str, float]:
    """Weights of the choice by listwise logistic regression.

    ``evidence`` holds for every crop (H, len(FEATURES)), ``right`` (H,) bool; crops with one hypothesis, or none that
    is right, say nothing and are left out. No weight takes the sign that its evidence cannot have. Evidence is scaled
    by its spread within crops before the penalty applies.
    """
    pairs = [
        (e, r.astype(bool)) for e, r in zip(evidence, right, strict=True) if len(e) > 1 and r.any() and not r.all()
    ]
    if not pairs:
        raise PerceptionError("no crop has both a right and a wrong hypothesis: nothing to fit the choice on")
    spread = np.sqrt(np.mean(np.concatenate([(e - e.mean(axis=0)) ** 2 for e, _ in pairs]), axis=0)) + 1e-6

    def loss(w: Array) -> tuple[float, Array]:
        total, gradient = penalty * float(w @ w), 2 * penalty * w
        for e, r in pairs:
            x = e / spread
            z = x @ w
            p = np.exp(z - z.max())
            p /= p.sum()
            mass = float(p[r].sum()) + 1e-12
            total -= np.log(mass) / len(pairs)
            gradient = gradient - (x.T @ (p * (r / mass - 1.0))) / len(pairs)
        return total, gradient

    bounds = [(None, 0.0) if name in AGAINST else (0.0, None) for name in FEATURES]
    found = minimize(loss, np.zeros(len(FEATURES)), jac=True, method="L-BFGS-B", bounds=bounds)
    return dict(zip(FEATURES, (found.x / spread).tolist(), strict=True))


def fit_gate(evidence: Array, right: NDArray[np.bool_], penalty: float = 1e-3) -> dict[str, float]:
    """Weights of the gate by logistic regression on winners with evidence (N, len(GATE_FEATURES)), right (N,) bool."""
    spread = np.maximum(evidence.std(axis=0), 1e-6)
    spread[0] = 1.0
    x, sign = evidence / spread, np.where(right, 1.0, -1.0)

    def loss(w: Array) -> tuple[float, Array]:
        margin = sign * (x @ w)
        slope = -sign / (1.0 + np.exp(np.clip(margin, -50, 50))) / len(x)
        return float(np.logaddexp(0.0, -margin).mean() + penalty * (w[1:] @ w[1:])), x.T @ slope + 2 * penalty * np.r_[
            0.0, w[1:]
        ]

    found = minimize(loss, np.zeros(len(GATE_FEATURES)), jac=True, method="L-BFGS-B")
    return dict(zip(GATE_FEATURES, (found.x / spread).tolist(), strict=True))


def threshold_for(probability: Array, right: NDArray[np.bool_], wanted: float) -> float:
    """Smallest threshold on ``probability`` (N,) above which a share ``wanted`` of the accepted are right.

    Where no threshold reaches it, that of the highest share.
    """
    order = np.argsort(-probability, kind="stable")
    share = np.cumsum(right[order]) / np.arange(1, len(order) + 1)
    good = np.flatnonzero(share >= wanted)
    last = int(good[-1]) if len(good) else int(np.argmax(share))
    return float(np.clip(np.floor(probability[order[last]] * 1e4) / 1e4, 0.0, 0.9999))
