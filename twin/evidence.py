"""What several looks at one part say together about how it lies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.candidates import Candidate

SAME_RAD = float(np.radians(15.0))
"""Yaws within this angle are one reading."""
FLOOR = 0.02
"""No single look is surer of or against a reading than this."""


def same_reading(a: Candidate, b: Candidate) -> bool:
    """Whether both are the same part in the same stable pose and yaw branch, modulo what leaves it at rest the same."""
    if a.estimate.part != b.estimate.part or a.estimate.stable_pose != b.estimate.stable_pose:
        return False
    alike = a.placed.part.rest_symmetries(a.estimate.stable_pose)
    return alike.difference(a.placed.T_base_part, b.placed.T_base_part)[1] < SAME_RAD


def agreement(reading: Candidate, looks: Sequence[Candidate]) -> float:
    """Probability of a reading among all that ``looks`` at the part name, each look a witness of its own.

    The score of an estimate is the probability that it is right; what is left of it goes to any other reading. The
    log-probabilities of a reading add over the looks.
    """
    named: list[Candidate] = [reading]
    for look in looks:
        if not any(same_reading(look, other) for other in named):
            named.append(look)
    logs = np.array([sum(_log_probability(look, other) for look in looks) for other in named])
    weights = np.exp(logs - logs.max())
    return float(weights[0] / weights.sum())


def _log_probability(look: Candidate, reading: Candidate) -> float:
    score = look.estimate.score
    return float(np.log(np.clip(score if same_reading(look, reading) else 1.0 - score, FLOOR, 1.0 - FLOOR)))
