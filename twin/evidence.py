"""What several looks at one part say together about how it lies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.candidates import Reading

SAME_RAD = float(np.radians(15.0))
"""Yaws within this angle are one reading."""
FLOOR = 0.02
"""No single look is surer of or against a reading than this."""


def same_reading(a: Reading, b: Reading) -> bool:
    """Whether both are the same part in the same stable pose and yaw branch, modulo what leaves it at rest the same."""
    if a.part is not b.part or a.stable_pose != b.stable_pose:
        return False
    return a.part.rest_symmetries(a.stable_pose).difference(a.T_base_part, b.T_base_part)[1] < SAME_RAD


def agreement(reading: Reading, looks: Sequence[Sequence[Reading]]) -> float:
    """Probability of a reading among all that any of the looks at the part names, each look a witness of its own.

    The log-probabilities of a reading add over the looks. A look that does not name it leaves it what its own readings
    leave over.
    """
    named = [reading]
    for other in (other for look in looks for other in look):
        if not any(same_reading(other, known) for known in named):
            named.append(other)
    logs = np.array([sum(_log_probability(look, other) for look in looks) for other in named])
    weights = np.exp(logs - logs.max())
    return float(weights[0] / weights.sum())


def _log_probability(look: Sequence[Reading], reading: Reading) -> float:
    left = 1.0 - sum(other.probability for other in look)
    probability = next((other.probability for other in look if same_reading(other, reading)), left)
    return float(np.log(np.clip(probability, FLOOR, 1.0 - FLOOR)))
