"""Which grasp to use: free of neighbours at the part and at the nest, and within the arm's reach at both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cad import gripper
from cad.parts import Part
from cad.spatial import Array, transform
from twin.grasp_config import Grasp, GraspConfig
from twin.grasp_geometry import convex_gap, footprint, rectangle
from twin.robot import TwinError


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedPart:
    """A part where an estimate or the bookkeeping says it is: ``T_base_part`` (4, 4)."""

    part: Part
    T_base_part: Array

    @cached_property
    def outline(self) -> Array:
        """Footprint (N, 2) in ``base``."""
        return footprint(self.part.mesh, self.T_base_part)


@dataclass(frozen=True, kw_only=True)
class GraspChoice:
    """A grasp that fits between the neighbours, with the poses and joint vectors that carry it out.

    ``T_part_tcp`` is the grasp's, turned by 180 degrees about the approach direction where the wrist prefers it.
    ``openings_m`` are the openings at the part and at the nest, before closing and after letting go.
    """

    grasp: Grasp
    T_part_tcp: Array
    openings_m: tuple[float, float]
    q_pick: Array
    q_place: Array


def choose_grasp(
    target: PlacedPart,
    neighbours: Sequence[PlacedPart],
    T_base_part_at_nest: Array,
    nest_neighbours: Sequence[PlacedPart],
    grasps: Sequence[Grasp],
    solve: Callable[[Array], Array],
    q_park: Array,
    config: GraspConfig,
) -> GraspChoice | str:
    """The best grasp that is free at the part and at the nest and within the arm's reach, or why there is none.

    ``solve`` turns ``T_base_tcp`` into joint angles (6,) and raises TwinError where the arm cannot reach; the arm comes
    from ``q_park`` (6,) and goes back there.
    """
    reasons: Counter[str] = Counter()
    for grasp in grasps:
        opening = _free_opening(target.T_base_part @ grasp.T_part_tcp, grasp.width_m, neighbours, config)
        if opening is None:
            reasons["a neighbour is in the way"] += 1
            continue
        release = _free_opening(T_base_part_at_nest @ grasp.T_part_tcp, grasp.width_m, nest_neighbours, config)
        if release is None:
            reasons["a part in the tray is in the way"] += 1
            continue
        reached = list(_reachable(grasp, target.T_base_part, T_base_part_at_nest, solve))
        if not reached:
            reasons["out of the arm's reach"] += 1
            continue
        # the hand is the same after half a turn: the one that turns the wrist least from park over both and back
        turned, q_pick, q_place = min(reached, key=lambda r: _wrist_travel(q_park, *r[1:]))
        return GraspChoice(
            grasp=grasp, T_part_tcp=turned, openings_m=(opening, release), q_pick=q_pick, q_place=q_place
        )
    return ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common()) or "no grasp is known"


def _free_opening(
    T_base_tcp: Array, width_m: float, neighbours: Sequence[PlacedPart], config: GraspConfig
) -> float | None:
    """The widest opening at which the fingers, closing included, stay clear of every neighbour; None when none does."""
    outlines = [n.outline for n in neighbours]
    for clearance in np.arange(config.clearance_at(width_m), config.min_clearance_m - 1e-9, -0.5e-3):
        half = width_m / 2 + float(clearance)
        y = (-gripper.PAD_WIDTH_M / 2, gripper.PAD_WIDTH_M / 2)
        fingers = [
            rectangle(T_base_tcp, x, y)
            for x in ((width_m / 2, half + gripper.PAD_THICKNESS_M), (-half - gripper.PAD_THICKNESS_M, -width_m / 2))
        ]
        if all(convex_gap(f, o) > config.neighbour_margin_m for f in fingers for o in outlines):
            return 2 * half
    return None


def _wrist_travel(q_park: Array, q_pick: Array, q_place: Array) -> float:
    """Longest turn in rad of the last joint on the way from park over part and nest and back to park."""
    stops = np.array([q_park[5], q_pick[5], q_place[5], q_park[5]])
    return float(np.abs(np.diff(stops)).max())


def _reachable(
    grasp: Grasp, T_base_part: Array, T_base_part_at_nest: Array, solve: Callable[[Array], Array]
) -> Iterator[tuple[Array, Array, Array]]:
    for half_turn in (np.eye(4), transform(np.diag([-1.0, -1.0, 1.0]))):
        T_part_tcp = grasp.T_part_tcp @ half_turn
        try:
            yield T_part_tcp, solve(T_base_part @ T_part_tcp), solve(T_base_part_at_nest @ T_part_tcp)
        except TwinError:
            continue
