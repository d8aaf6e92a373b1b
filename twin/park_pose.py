"""Where else to park the arm when, parked as usual, it may hide, shade or be mirrored in what lies on the board."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cad.robot import forward_kinematics
from cad.spatial import Array, apply, inverse
from twin.attempts import Calibration
from twin.ik import ArmIk

UPPER_ARM_M = 0.138
"""The UR5e's upper arm lies this far beside the frames of shoulder and elbow, along the axes of both joints."""


@dataclass(frozen=True, kw_only=True)
class ParkConfig:
    """``arm_m`` is the radius of the arm's tubes with what hangs on them, and that of the hand.

    Light comes in at up to ``lamp_slope`` from the vertical, as a tangent: so far from a thing falls its shadow, for
    each metre of height. ``turns`` (rad) of the base joint are tried, the smallest first.
    """

    arm_m: float = 0.08
    lamp_slope: float = 0.25
    turns: tuple[float, ...] = (0.4, -0.4, 0.8, -0.8, 1.2, -1.2)


def room_beside_board(q: Array, ik: ArmIk, calibration: Calibration, config: ParkConfig | None = None) -> float:
    """Metres by which the arm at ``q`` (6,) and its shadow miss the pick area seen from above; negative over it."""
    config = config or ParkConfig()
    frames = forward_kinematics(q)
    beside = frames[1:3, :3, 3] + UPPER_ARM_M * frames[1:3, :3, 2]
    line = np.vstack([frames[:2, :3, 3], beside, frames[2:, :3, 3], ik.forward(q)[:3, 3]])
    share = np.linspace(0.0, 1.0, 20)[:, None]
    points = np.vstack([a + share * (b - a) for a, b in pairwise(line)])
    p_board = apply(inverse(calibration.T_base_board), points)
    beyond = np.maximum(np.abs(p_board[:, :2]) - calibration.board_half_m, 0.0)
    needed = config.arm_m + config.lamp_slope * np.maximum(p_board[:, 2], 0.0)
    return float((np.linalg.norm(beyond, axis=1) - needed).min())


def park_elsewhere(ik: ArmIk, calibration: Calibration, config: ParkConfig | None = None) -> Array | None:
    """Another joint vector (6,) to park at, with the arm clear of the board and within its limits.

    The usual one with the base joint turned: tool and elbow keep their height on the way. None where the arm is clear
    of the board as it parks, and another place would show nothing else, or where there is no such place.
    """
    config = config or ParkConfig()
    if room_beside_board(calibration.q_park, ik, calibration, config) >= 0:
        return None
    low, high = ik.joint_limits
    for turn in config.turns:
        q = calibration.q_park + turn * np.eye(6)[0]
        within = bool((q >= low).all() and (q <= high).all())
        if within and room_beside_board(q, ik, calibration, config) >= 0:
            return q
    return None
