"""How sure a figure is: percentile bootstrap over whole frames, and one-sided Clopper-Pearson bounds of shares.

Parts of one frame share light, camera pose and tags, so frames are drawn, not parts. A share's Clopper-Pearson bound
takes parts as independent; it is there because a bootstrap of no failures at all says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import beta

from cad.spatial import Array

Interval = tuple[float, float]


def clopper_pearson_lower(successes: int, trials: int, level: float = 0.95) -> float:
    """One-sided lower bound of a share; 0 without trials."""
    return float(beta.ppf(1.0 - level, successes, trials - successes + 1)) if successes > 0 else 0.0


def clopper_pearson_upper(successes: int, trials: int, level: float = 0.95) -> float:
    """One-sided upper bound of a share; 1 without trials."""
    return float(beta.ppf(level, successes + 1, trials - successes)) if successes < trials else 1.0


class FrameBootstrap:
    """``draws`` samples of as many frames as there are, with replacement; figures are intervals at ``level``."""

    def __init__(self, frames: Sequence[int], rng: np.random.Generator, draws: int = 1000, level: float = 0.95) -> None:
        """``frames`` are the numbers of all frames, those without any value included. Raises ValueError without any."""
        if not len(frames) or draws < 1 or not 0.0 < level < 1.0:
            raise ValueError(
                f"{len(frames)} frames, {draws} draws, level {level}: at least 1, at least 1, within (0, 1)"
            )
        self._index = {int(frame): i for i, frame in enumerate(sorted(set(frames)))}
        n = len(self._index)
        self._counts = rng.multinomial(n, np.full(n, 1.0 / n), size=draws).astype(np.float64)  # (draws, frames)
        self._tails = 50.0 * (1.0 - level), 50.0 * (1.0 + level)

    def mean(self, values: ArrayLike, frames: Sequence[int]) -> Interval:
        """Interval of the mean of values (N,), each from one of ``frames`` (N,); NaN without values."""
        return self._interval(self._means(values, frames))

    def ratio(
        self, above: ArrayLike, above_frames: Sequence[int], below: ArrayLike, below_frames: Sequence[int]
    ) -> Interval:
        """Interval of the mean of some values over the mean of others, of the same drawn frames."""
        return self._interval(_divided(self._means(above, above_frames), self._means(below, below_frames)))

    def quantile(self, values: ArrayLike, frames: Sequence[int], q: float) -> Interval:
        """Interval of the ``q`` quantile: the least value that a share q of the drawn ones does not exceed."""
        v = np.asarray(values, np.float64)
        order = np.argsort(v, kind="stable")
        weights = np.cumsum(self._counts[:, self._places(frames)[order]], axis=1)  # (draws, N)
        drawn = weights[:, -1] > 0 if v.size else np.zeros(len(weights), bool)
        at = (weights[drawn] < q * weights[drawn, -1:]).sum(axis=1) if drawn.any() else np.zeros(0, np.int64)
        return self._interval(v[order][np.minimum(at, v.size - 1)] if v.size else np.zeros(0))

    def _means(self, values: ArrayLike, frames: Sequence[int]) -> Array:
        places, n = self._places(frames), len(self._index)
        total = np.bincount(places, weights=np.asarray(values, np.float64), minlength=n)
        return _divided(self._counts @ total, self._counts @ np.bincount(places, minlength=n))

    def _places(self, frames: Sequence[int]) -> NDArray[np.int64]:
        return np.array([self._index[int(frame)] for frame in frames], np.int64)

    def _interval(self, samples: Array) -> Interval:
        known = samples[np.isfinite(samples)]
        if not known.size:
            return float("nan"), float("nan")
        low, high = np.percentile(known, self._tails)
        return float(low), float(high)


def _divided(above: Array, below: Array) -> Array:
    return np.divide(above, below, out=np.full(len(above), np.nan), where=below > 0)
