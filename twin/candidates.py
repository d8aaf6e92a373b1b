"""Estimates as a controller uses them: brought down to the board, with what speaks against picking them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cad.parts import Part
from cad.resting import as_rest, settled
from cad.spatial import Array, apply, inverse, rotation_angle
from perception.estimates import NOT_A_PART, OTHER_PART, PartEstimate
from twin.attempts import Calibration, ControllerConfig, Outcome
from twin.grasp_choice import PlacedPart


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """One way to read what a look shows: ``T_base_part`` (4, 4) of a part in a stable pose, and how probable it is."""

    part: Part
    stable_pose: int
    T_base_part: Array
    probability: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """An estimate brought down to the board plane, and the reason why it cannot be used, if there is one.

    ``readings`` are all that the look leaves open, the estimate's own first.
    """

    estimate: PartEstimate
    placed: PlacedPart
    readings: tuple[Reading, ...]
    problem: tuple[Outcome, str] | None = None

    @cached_property
    def centre(self) -> Array:
        """Middle of the part's bounding box seen from above (2,), in ``base``."""
        return apply(self.placed.T_base_part, self.placed.part.mesh.bounds.mean(axis=0))[:2]

    @property
    def unsure(self) -> bool:
        """Whether another look may make a part of it that can be picked."""
        declined = self.problem is not None and self.problem[0] == "declined"
        return declined and self.estimate.verdict not in (NOT_A_PART, OTHER_PART)


def bring_down(
    estimate: PartEstimate,
    parts: Mapping[str, Part],
    T_base_cam: Array,
    calibration: Calibration,
    config: ControllerConfig,
) -> Candidate:
    """The estimate as a part that lies on the board: x, y and yaw are kept, the rest is the stable pose's.

    ``parts`` by name hold the estimate's; a reading of another one is left out.
    """
    part, T_base_board = parts[estimate.part], calibration.T_base_board
    pose = part.stable_poses[estimate.stable_pose]
    T_board_part = as_rest(part, pose, inverse(T_base_board) @ T_base_cam @ estimate.T_cam_part)
    flat = settled(pose, T_board_part)
    tilt = rotation_angle(flat[:3, :3], T_board_part[:3, :3])
    x, y = flat[:2, 3] - (flat[:3, :3] @ pose.R_table_part.T @ pose.t_table_part)[:2]
    off = T_board_part[2, 3] - flat[2, 3]
    problem: tuple[Outcome, str] | None = None
    if not estimate.accepted:
        problem = "declined", estimate.verdict
    elif tilt > config.plane_tolerance or abs(off) > config.plane_tolerance_m:
        problem = "pose", f"{1e3 * off:.2f} mm off the board and {np.degrees(tilt):.1f} degrees from its stable pose"
    elif abs(x) > calibration.board_half_m[0] or abs(y) > calibration.board_half_m[1]:
        problem = "pose", f"at ({1e3 * x:.1f}, {1e3 * y:.1f}) mm on the board, outside the pick area"
    placed = PlacedPart(part=part, T_base_part=T_base_board @ flat)
    return Candidate(estimate=estimate, placed=placed, readings=_readings(estimate, parts, T_base_cam), problem=problem)


def _readings(estimate: PartEstimate, parts: Mapping[str, Part], T_base_cam: Array) -> tuple[Reading, ...]:
    """What the estimate leaves open, its own reading at most as probable as its score: a poor look tells little.

    An estimate that names no alternatives leaves open its own reading alone.
    """
    named = [(a.part, a.stable_pose, a.T_cam_part, a.probability) for a in estimate.alternatives]
    named = named or [(estimate.part, estimate.stable_pose, estimate.T_cam_part, 1.0)]
    share = min(1.0, estimate.score / max(named[0][3], 1e-9))
    return tuple(
        Reading(part=parts[name], stable_pose=k, T_base_part=T_base_cam @ T_cam_part, probability=share * probability)
        for name, k, T_cam_part, probability in named
        if name in parts
    )
