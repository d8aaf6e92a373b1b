"""Risk over coverage: what share of accepted estimates is wrong when only the surest are accepted.

After El-Yaniv and Wiener (2010) and Geifman and El-Yaniv (2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cad.spatial import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RiskCoverage:
    """For falling thresholds on the score: ``threshold``, the share accepted ``coverage`` and the share of these that
    is wrong ``risk``, each (K,).

    ``area`` is that under risk over coverage (0 is best); ``excess_area`` what of it better ordering could avoid.
    """

    threshold: Array
    coverage: Array
    risk: Array
    area: float
    excess_area: float

    def coverage_at(self, risk: float) -> float:
        """Largest share that can be accepted with no more than ``risk`` wrong, 0 when there is none."""
        good = np.flatnonzero(self.risk <= risk)
        return float(self.coverage[good[-1]]) if len(good) else 0.0

    def risk_at(self, coverage: float) -> float:
        """Share that is wrong when at least the share ``coverage`` is accepted."""
        at = int(np.searchsorted(self.coverage, coverage - 1e-12))
        return float(self.risk[min(at, len(self.risk) - 1)])


def risk_coverage(scores: ArrayLike, wrong: ArrayLike) -> RiskCoverage:
    """Curve of estimates with ``scores`` (N,), larger is surer, of which ``wrong`` (N,) bool are wrong.

    Estimates of one score are accepted together. Raises ValueError when there are none, or a score is not a number.
    """
    s, w = np.asarray(scores, np.float64).ravel(), np.asarray(wrong, bool).ravel()
    if not len(s) or len(s) != len(w) or not np.isfinite(s).all():
        raise ValueError(
            f"{len(s)} scores for {len(w)} estimates: there must be one finite score for each, at least one"
        )
    order = np.argsort(-s, kind="stable")
    s, mistakes, n = s[order], np.cumsum(w[order]), np.arange(1, len(s) + 1)
    last = np.append(s[1:] < s[:-1], True)
    risk = mistakes[last] / n[last]
    # Within a tie any order is as likely as another, so mistakes come evenly.
    even = np.interp(n, np.append(0, n[last]), np.append(0, mistakes[last])) / n
    best = np.maximum(0, n - (len(s) - int(w.sum()))) / n
    return RiskCoverage(
        threshold=s[last],
        coverage=n[last] / len(s),
        risk=risk,
        area=float(even.mean()),
        excess_area=float(even.mean() - best.mean()),
    )
