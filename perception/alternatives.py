"""Which poses one view leaves open: readings that look the same from above, and readings that score nearly as well.

An ambiguous view yields the set of poses, not a guess. Readings that no overhead view can tell apart, as the CAD says,
are always in the set together; others are while the likelier ones do not have all of the wanted probability.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cad.parts import planar
from cad.spatial import Array
from perception.estimates import PoseAlternative
from perception.faces import Face, FaceTable

SAME_YAW = float(np.radians(6.0))
_SAME_POSE_M, _SAME_POSE_RAD = 2e-4, float(np.radians(3.0))

Placement = tuple[int, float, float, float]
"""Face index, x and y in metres, yaw in rad, in the table frame."""


def like_placements(table: FaceTable, placement: Placement) -> list[Placement]:
    """All placements that look the same from above, the given one first."""
    face, x, y, yaw = placement
    c, s = np.cos(yaw), np.sin(yaw)
    return [
        (e.face, x + c * e.shift_m[0] - s * e.shift_m[1], y + s * e.shift_m[0] + c * e.shift_m[1], yaw + e.yaw)
        for e in table.equivalents[face]
    ]


def same_reading(table: FaceTable, a: Placement, b: Placement, within_m: float = np.inf) -> bool:
    """Whether placement b looks like a: yaw within 6 degrees and, when asked, place within ``within_m``."""
    return any(
        face == b[0]
        and abs(np.angle(np.exp(1j * (yaw - b[3])))) <= SAME_YAW
        and np.hypot(x - b[1], y - b[2]) <= within_m
        for face, x, y, yaw in like_placements(table, a)
    )


def readings(table: FaceTable, placements: Sequence[Placement]) -> list[int]:
    """For each placement the number of its reading: placements that look the same, wherever they lie, have one."""
    firsts: list[int] = []
    out: list[int] = []
    for i, placement in enumerate(placements):
        same = [n for n, first in enumerate(firsts) if same_reading(table, placements[first], placement)]
        if not same:
            firsts.append(i)
        out.append(same[0] if same else len(firsts) - 1)
    return out


def reading_probabilities(scores: Array, numbers: Sequence[int], temperature: float) -> Array:
    """Probability (R,) of each reading from the scores (H,) of its placements, the best of which counts."""
    best = np.full(max(numbers) + 1, -np.inf)
    np.maximum.at(best, np.array(numbers), scores / temperature)
    p = np.exp(best - best.max())
    return p / p.sum()


def likely_readings(probabilities: Array, mass: float) -> list[int]:
    """The likeliest readings that together have ``mass`` of the probability, best first, at least one."""
    order = np.argsort(-probabilities, kind="stable")
    count = int(np.searchsorted(np.cumsum(probabilities[order]), mass)) + 1
    return [int(i) for i in order[:count]]


def pose_alternatives(
    table: FaceTable,
    placements: Sequence[Placement],
    scores: Array,
    T_cam_table: Array,
    *,
    temperature: float = 1.0,
    mass: float = 0.99,
    prior_weight: float = 1.0,
) -> tuple[PoseAlternative, ...]:
    """The prediction set of a crop from its candidates' placements and scores (H,): the best one first.

    Poses that a symmetry of the part maps onto each other are one. Among poses of one reading probability goes by how
    often a dropped part comes to rest so, to the power of ``prior_weight``; of all it sums to one.
    """
    numbers = readings(table, placements)
    p = reading_probabilities(scores, numbers, temperature)
    first = int(np.argmax(scores))
    found: list[tuple[Face, Array, float]] = []
    for number in sorted(likely_readings(p, mass), key=lambda n: n != numbers[first]):
        mine = [i for i, n in enumerate(numbers) if n == number]
        best = max(mine, key=lambda i: scores[i])
        group: list[tuple[Face, Array]] = []
        for face_index, x, y, yaw in like_placements(table, placements[best]):
            face = table[face_index]
            T = T_cam_table @ planar(x, y, yaw) @ face.stable_pose.T_table_part
            if not any(_same_pose(face, T, other, T_other) for other, T_other in group):
                group.append((face, T))
        shares = np.array([max(face.stable_pose.probability, 1e-2) ** prior_weight for face, _ in group])
        shares = p[number] * shares / shares.sum()
        found += [(face, T, float(share)) for (face, T), share in zip(group, shares, strict=True)]
    total = sum(share for *_, share in found)
    alternatives = [
        PoseAlternative(
            part=face.part.name, stable_pose=face.stable_pose.index, T_cam_part=T, probability=share / total
        )
        for face, T, share in found
    ]
    return (alternatives[0], *sorted(alternatives[1:], key=lambda a: -a.probability))


def _same_pose(a: Face, T_a: Array, b: Face, T_b: Array) -> bool:
    if a.part is not b.part:
        return False
    distance, angle = a.part.symmetries.difference(T_a, T_b)
    return distance < _SAME_POSE_M and angle < _SAME_POSE_RAD
