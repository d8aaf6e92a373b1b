"""A gentle push with closed fingers: it moves and turns one part, so that light and camera show it another way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cad import gripper
from cad.spatial import Array, apply, inverse
from twin.attempts import Calibration
from twin.candidates import Candidate
from twin.robot import TwinError, top_down

FINGERS_M = float(np.hypot(gripper.PAD_WIDTH_M / 2, gripper.PAD_THICKNESS_M))
"""Closed fingers stay within this distance of the tool's axis, as high as parts reach."""
ROOM_M = 0.02
"""More room than this is no better: among such pushes the one towards the board's middle is taken."""


@dataclass(frozen=True, kw_only=True)
class NudgeConfig:
    """Lengths in metres, speeds in m/s.

    The fingers come down ``clearance_m`` beside the circle that no part reaches out of, ``tip_m`` above the board, and
    push the part by ``push_m``; their middle passes its middle at ``lever_m``, which turns it. They back off by
    ``back_off_m`` before they rise. Everything on the way stays ``margin_m`` clear of all else that is seen. The best
    of ``directions`` is taken.
    """

    push_m: float = 4.0e-3
    lever_m: float = 1.5e-3
    clearance_m: float = 1.5e-3
    margin_m: float = 3.0e-3
    tip_m: float = 0.6e-3
    back_off_m: float = 2.0e-3
    speed: float = 0.03
    acceleration: float = 0.3
    directions: int = 24

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and (value > 0 or (name == "lever_m" and value == 0))):
                raise ValueError(f"nudge {name} {value} must be finite and positive")


@dataclass(frozen=True, kw_only=True, eq=False)
class Nudge:
    """A push: from ``T_base_start`` straight to ``T_base_end``, then back to ``T_base_back``, all (4, 4) in ``base``.

    ``part`` is what the thing at ``centre`` (2,) was taken for; its middle should come to lie at ``centre_after`` (2,).
    ``free_m`` is how much room is left around everything that moves.
    """

    part: str
    centre: Array
    centre_after: Array
    T_base_start: Array
    T_base_end: Array
    T_base_back: Array
    free_m: float


def plan_nudge(
    target: Candidate,
    others: Sequence[Array],
    *,
    radius_m: float,
    solve: Callable[[Array], Array],
    calibration: Calibration,
    config: NudgeConfig,
) -> Nudge | str:
    """The push with the most room around it, or why there is none.

    ``radius_m`` is the largest distance of a point of any part from its middle: what lies there may not be what it is
    taken for. ``others`` are the middles (2,) of all else that is seen. ``solve`` turns ``T_base_tcp`` into joint
    angles (6,) and raises TwinError where the arm cannot reach.
    """
    centres = np.array(others).reshape(-1, 2)
    options: list[Nudge] = []
    on_board = False
    for heading in 2 * np.pi * np.arange(config.directions) / config.directions:
        nudge = _nudge(target, heading, centres, radius_m, calibration, config)
        if not _inside(nudge.centre_after, calibration):
            continue
        on_board = True
        if nudge.free_m >= config.margin_m:
            options.append(nudge)
    middle = calibration.T_base_board[:2, 3]
    options.sort(key=lambda n: (-min(n.free_m, ROOM_M), float(np.linalg.norm(n.centre_after - middle))))
    for nudge in options:
        try:
            for T_base_tcp in (nudge.T_base_start, nudge.T_base_end, nudge.T_base_back):
                solve(T_base_tcp)
        except TwinError:
            continue
        return nudge
    if options:
        return "a push is out of the arm's reach"
    return "a neighbour is too near for a push" if on_board else "a push would leave the pick area"


def _nudge(
    target: Candidate, heading: float, others: Array, radius_m: float, calibration: Calibration, config: NudgeConfig
) -> Nudge:
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    axis = target.centre + config.lever_m * across  # the fingers' path passes here
    reach = float(((target.centre - target.placed.outline) @ along).max())
    ahead = gripper.PAD_WIDTH_M / 2  # of the fingers' face before the tool's axis
    start = axis - (radius_m + config.clearance_m + FINGERS_M) * along
    end = axis + (config.push_m - reach - ahead) * along
    back = end - config.back_off_m * along
    after = target.centre + config.push_m * along
    free = np.inf
    if len(others):
        fingers = min(_distance(p, start, end) for p in others) - FINGERS_M
        part = min(_distance(p, target.centre, after) for p in others) - radius_m
        free = min(fingers, part) - radius_m
    z = float(calibration.T_base_board[2, 3]) + config.tip_m
    turn = heading + np.pi / 2  # the fingers' narrow side goes first: their closing direction is across the push
    T_start, T_end, T_back = (top_down(x, y, z, turn) for x, y in (start, end, back))
    return Nudge(
        part=target.estimate.part,
        centre=target.centre,
        centre_after=after,
        T_base_start=T_start,
        T_base_end=T_end,
        T_base_back=T_back,
        free_m=free,
    )


def _inside(p_base: Array, calibration: Calibration) -> bool:
    p_board = apply(inverse(calibration.T_base_board), [*p_base, 0.0])[:2]
    return bool((np.abs(p_board) <= calibration.board_half_m).all())


def _distance(point: Array, start: Array, end: Array) -> float:
    """Distance of a point from a segment, all (2,)."""
    way = end - start
    share = np.clip((point - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * way))
