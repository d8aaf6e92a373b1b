"""What became of each part, and how wrong the estimates were: the referee's records beside the controller's beliefs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from cad.equivalence import Symmetries
from cad.parts import Part
from cad.resting import nearest_rest
from cad.spatial import Array, inverse, rotation_angle
from perception.estimates import PartEstimate
from twin.attempts import Attempt
from twin.referee import PartRecord
from twin.scorecard import PartResult, PoseError

MATCH_M = 0.006
"""An estimate belongs to the part whose centre lies nearest, at most this far away across the view."""
BRANCH_RAD = np.radians(15.0)
"""Within this angle of the truth the discrete choice (face and yaw branch) was right."""


@dataclass(kw_only=True)
class Beliefs:
    """What was believed about one presented part: its estimate at the first look, and the attempts made on it."""

    estimate: PartEstimate | None = None
    error: PoseError | None = None
    attempts: list[Attempt] = field(default_factory=list)


def centre(part: Part, T: Array) -> Array:
    """Centre of the part's bounding box (3,) in the frame that ``T`` (4, 4) maps to."""
    return T[:3, :3] @ part.mesh.bounds.mean(axis=0) + T[:3, 3]


def match(
    estimates: Sequence[PartEstimate], parts: dict[str, Part], truth: Sequence[Part], T_cam_truth: Array
) -> dict[int, PartEstimate]:
    """Estimates by index of the presented part they belong to, one to one, least total distance across the view."""
    if not estimates or not len(truth):
        return {}
    seen = np.array([centre(parts[e.part], e.T_cam_part)[:2] for e in estimates])
    there = np.array([centre(p, T)[:2] for p, T in zip(truth, T_cam_truth, strict=True)])
    distance = np.linalg.norm(there[:, None] - seen[None], axis=-1)  # (truth, estimates)
    rows, columns = linear_sum_assignment(np.minimum(distance, MATCH_M))
    return {int(i): estimates[j] for i, j in zip(rows, columns, strict=True) if distance[i, j] < MATCH_M}


def pose_error(part: Part, T_cam_part: Array, estimate: PartEstimate) -> PoseError:
    """Absolute errors in the camera frame; the angle modulo the part's proper symmetries."""
    T_nearest = part.symmetries.nearest(T_cam_part, estimate.T_cam_part)
    e = 1e3 * np.abs(T_nearest[:3, 3] - T_cam_part[:3, 3])
    angle = rotation_angle(T_cam_part[:3, :3], T_nearest[:3, :3])
    class_right = estimate.part == part.name
    return PoseError(
        e_x_mm=float(e[0]),
        e_y_mm=float(e[1]),
        e_z_mm=float(e[2]),
        e_theta_deg=float(np.degrees(angle)),
        branch_right=bool(class_right and angle <= BRANCH_RAD),
        class_right=class_right,
    )


def in_hand_error(alike: Symmetries, T_tcp_part: Array, T_part_tcp: Array) -> tuple[float, float, float, float]:
    """(x mm, y mm, z mm, angle deg) of the part in the hand against where its grasp says it is, in the tcp frame.

    ``alike`` are the transforms that its resting pose does not tell apart.
    """
    T_believed = inverse(T_part_tcp)
    T_nearest = alike.nearest(T_believed, T_tcp_part)
    x, y, z = 1e3 * (T_nearest[:3, 3] - T_believed[:3, 3])
    angle = rotation_angle(T_believed[:3, :3], T_nearest[:3, :3])
    return float(x), float(y), float(z), float(np.degrees(angle))


def assess(scene: int, record: PartRecord, part: Part, beliefs: Beliefs) -> PartResult:
    """The result of one presented part."""
    failure, note = (None, "") if record.succeeded else _failure(record, part, beliefs)
    tried = [a for a in beliefs.attempts if a.T_part_tcp is not None]
    in_hand = None
    if record.T_tcp_part is not None and tried and tried[-1].T_part_tcp is not None and tried[-1].part == part.name:
        in_hand = in_hand_error(part.rest_symmetries(record.stable_pose), record.T_tcp_part, tried[-1].T_part_tcp)
    return PartResult(
        scene=scene,
        instance=record.instance,
        part=record.part,
        stable_pose=record.stable_pose,
        attempted=bool(tried),
        attempts=record.attempts,
        picked=record.picked,
        placed=record.placed,
        succeeded=record.succeeded,
        failure=failure,
        note=note,
        pose_error=beliefs.error,
        in_hand_error_mm=in_hand,
        place_error_mm_deg=None
        if record.place_error_m is None or record.place_error_rad is None
        else (1e3 * record.place_error_m, float(np.degrees(record.place_error_rad))),
        collisions=tuple(dict.fromkeys(record.collisions)),
        disturbed=tuple(dict.fromkeys(record.disturbed)),
    )


def _failure(record: PartRecord, part: Part, beliefs: Beliefs) -> tuple[str, str]:
    """One cause, the earliest in the chain that explains the rest, and what is known about it."""
    if record.collisions:
        return "collision", f"touched {', '.join(dict.fromkeys(record.collisions))}"
    if record.disturbed:
        return "disturbed", f"moved {', '.join(dict.fromkeys(record.disturbed))}"
    tried = [a for a in beliefs.attempts if a.tried]
    if not tried and not record.attempts:
        return _never_tried(record, beliefs)
    wrong = [note for a in tried if (note := _wrong_estimate(record, part, a))]
    if tried and len(wrong) == len(tried):
        return "pose", wrong[-1]
    last = tried[-1] if tried else None
    note = last.note if last else ""
    if last and last.outcome == "ik":
        return "ik", note
    if not record.picked:
        return "grasp", note or "not held 50 mm above the board for 1 s"
    if last and last.outcome == "transport":
        return "transport", note
    if wrong:
        return "pose", wrong[-1]
    return "place", note or _place_note(record)


def _never_tried(record: PartRecord, beliefs: Beliefs) -> tuple[str, str]:
    if beliefs.attempts:
        last = beliefs.attempts[-1]
        return ("declined" if last.outcome in (None, "declined") else last.outcome), last.note
    if record.moved_by_others:
        return "disturbed", "moved before it was tried"
    if beliefs.estimate is not None:
        return "declined", beliefs.estimate.verdict
    return "detection", "not seen at the first look"


def _wrong_estimate(record: PartRecord, part: Part, attempt: Attempt) -> str:
    """What was wrong with the discrete choice behind an attempt; empty when it was right."""
    if attempt.part != record.part:
        return f"taken for {attempt.part}"
    believed, _ = nearest_rest(part, attempt.T_base_part[:3, :3])
    if believed.index != record.stable_pose:
        return f"face {record.stable_pose} taken for face {believed.index}"
    _, angle = part.rest_symmetries(believed.index).difference(record.T_world_presented, attempt.T_base_part)
    return f"{np.degrees(angle):.0f} degrees off" if angle > BRANCH_RAD and not record.moved_by_others else ""


def _place_note(record: PartRecord) -> str:
    if record.place_error_m is None or record.place_error_rad is None:
        return "not in a nest of its class"
    return f"{1e3 * record.place_error_m:.2f} mm and {np.degrees(record.place_error_rad):.1f} degrees from its nest"
