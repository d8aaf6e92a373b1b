"""Fits the small models of the choice: listwise and plain logistic regression, temperature, a cautious threshold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import beta

from cad.spatial import Array
from perception.choice import AGAINST, FEATURES, GATE_FEATURES, RIVALRY
from perception.estimates import PerceptionError


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


def fit_part(evidence: Array, has_part: NDArray[np.bool_], penalty: float = 2e-3) -> dict[str, float]:
    """Weights of the gate's evidence (N, len(GATE_FEATURES)) by logistic regression on ``has_part`` (N,) bool.

    No weight takes the sign that its evidence cannot have; the constant is free.
    """
    x, spread, middle = _even(evidence)
    sign = np.where(has_part, 1.0, -1.0)

    def loss(w: Array) -> tuple[float, Array]:
        margin = sign * (x @ w)
        slope = -sign / (1.0 + np.exp(np.clip(margin, -50, 50))) / len(x)
        gradient = x.T @ slope + 2 * penalty * np.append(0.0, w[1:])
        return float(np.logaddexp(0.0, -margin).mean() + penalty * (w[1:] @ w[1:])), gradient

    found = minimize(loss, np.zeros(len(GATE_FEATURES)), jac=True, method="L-BFGS-B", bounds=_GATE_BOUNDS)
    return _named(found.x, spread, middle)


def fit_gate(
    evidence: Array, right: NDArray[np.bool_], penalty: float = 2e-3
) -> tuple[dict[str, float], dict[str, float]]:
    """Weights of the gate and of the rivalry, fitted together on winners with evidence (N, len(GATE_FEATURES)) that are
    ``right`` (N,) bool.

    The probability of being right is a product: a good contour is no help against a rival that scores as well. No
    weight takes the sign that its evidence cannot have. Without examples the odds against a rival are its lead.
    """
    x, spread, middle = _even(evidence)
    lead = evidence[:, GATE_FEATURES.index("lead")]

    def loss(values: Array) -> tuple[float, Array]:
        (c, s), w = values[:2], values[2:]
        a, b = (1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0))) for odds in (x @ w, c + s * lead))
        p = np.clip(a * b, 1e-9, 1.0 - 1e-9)
        slope = np.where(right, -1.0 / p, 1.0 / (1.0 - p)) * p / len(x)  # by the logarithm of p
        by_rivalry, by_gate = slope * (1.0 - b), slope * (1.0 - a)
        total = -np.where(right, np.log(p), np.log(1.0 - p)).mean() + penalty * (w[1:] @ w[1:])
        pull = 0.01 * np.array([c, s - 1.0])
        gradient = np.concatenate(
            [[by_rivalry.sum(), by_rivalry @ lead] + 2 * pull, x.T @ by_gate + 2 * penalty * np.append(0.0, w[1:])]
        )
        return float(total + (pull @ pull) / 0.01), gradient

    start = np.append([0.0, 1.0], np.zeros(len(GATE_FEATURES)))
    bounds = [(-1.0, None), (0.1, None), *_GATE_BOUNDS]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return _named(found[2:], spread, middle), dict(zip(RIVALRY, found[:2].tolist(), strict=True))


_GATE_BOUNDS = [
    (None if name == "constant" or name in AGAINST else 0.0, 0.0 if name in AGAINST else None) for name in GATE_FEATURES
]


def _even(evidence: Array) -> tuple[Array, Array, Array]:
    """The gate's evidence with mean 0 and spread 1, but for the constant, and the spreads and means it had."""
    spread, middle = np.maximum(evidence.std(axis=0), 1e-6), evidence.mean(axis=0)
    spread[0], middle[0] = 1.0, 0.0
    return (evidence - middle) / spread, spread, middle


def _named(found: Array, spread: Array, middle: Array) -> dict[str, float]:
    weights = found / spread
    weights[0] -= float(weights @ middle)
    return dict(zip(GATE_FEATURES, weights.tolist(), strict=True))


def fit_temperature(scores: Sequence[Array], right: Sequence[NDArray[np.bool_]]) -> float:
    """What scores (R,) of a crop's readings are divided by so that their softmax is the probability of being right.

    Crops with one reading or none that is right are left out; without any the temperature is 1.
    """
    pairs = [(s, r) for s, r in zip(scores, right, strict=True) if len(s) > 1 and r.any()]
    if not pairs:
        return 1.0

    def loss(log: float) -> float:
        total = 0.05 * log**2  # so that a few crops without a mistake do not make it vanish
        for s, r in pairs:
            z = s / np.exp(log)
            total += float(np.logaddexp.reduce(z) - np.logaddexp.reduce(z[r]))
        return total

    return float(np.exp(minimize_scalar(loss, bounds=(-2.0, 2.0), method="bounded").x))


def wrong_share_bound(wrong: NDArray[np.int64] | int, n: NDArray[np.int64] | int, confidence: float) -> Array:
    """Upper Clopper-Pearson bound of the share of wrong ones, of which ``wrong`` of ``n`` were seen."""
    return np.where(np.asarray(wrong) >= n, 1.0, beta.ppf(confidence, np.asarray(wrong) + 1, np.maximum(n - wrong, 1)))


def cautious_threshold(probability: Array, right: NDArray[np.bool_], wanted: float, confidence: float = 0.5) -> float:
    """Smallest threshold on ``probability`` (N,) above which a share ``wanted`` of the accepted are right.

    That is, at which the upper Clopper-Pearson bound of the wrong share does not pass 1 - ``wanted``: with few examples
    even none that is wrong is not enough. Where no threshold reaches it, that of the least bound.
    """
    order = np.argsort(-probability, kind="stable")
    p, n = probability[order], np.arange(1, len(order) + 1)
    bound = wrong_share_bound(np.cumsum(~right[order], dtype=np.int64), n, confidence)
    last_of_ties = np.append(p[1:] < p[:-1], True)
    bound = np.where(last_of_ties, bound, np.inf)
    good = np.flatnonzero(bound <= 1.0 - wanted)
    last = int(good[-1]) if len(good) else int(np.argmin(bound))
    below = p[last + 1] if last + 1 < len(p) else 0.0
    # Half-way, in log-odds, between the last that is accepted and the first that is not.
    odds = [float(np.log(q / (1 - q))) for q in np.clip([p[last], below], 1e-4, 1 - 1e-4)]
    return float(np.clip(1.0 / (1.0 + np.exp(-np.mean(odds))), 0.0, 0.9999))
