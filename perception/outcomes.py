"""What became of each part in a frame: one row for every part and method, and one for every detection of no part.

Rows are plain data that go to JSON and back. Tables, plots and pictures of failures are made from nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from perception.estimates import PerceptionError

STRICT, SYMMETRIC, EQUIVALENT = "strict", "symmetric", "equivalent"
COMPARISONS = (STRICT, SYMMETRIC, EQUIVALENT)
"""How poses are compared: as they stand, modulo the part's proper symmetries, and modulo what looks the same too."""
ERRORS = ("e_x_mm", "e_y_mm", "e_z_mm", "e_theta_deg")
NO_PART = -1
"""``Outcome.instance`` of a detection that belongs to no part."""
BRANCH_YAW_DEG = 6.0
"""Within this yaw of the truth, class and stable pose right, the discrete choice was right."""
WHOLE_SHARE = 0.6
"""A part of which less than this is visible, or that the image's border cuts, is reported apart."""

Errors = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One part of an image as one method saw it; or one of its detections that belongs to no part (``instance`` -1).

    About the part: ``part``, ``stable_pose``, share of its silhouette that is visible, whether it is ``whole`` (at
    least 60 % visible, not cut by the border), where its centre is on the board and the mean grey level of the 256
    pixels square round it. About the estimate that belongs to it, if it was ``detected``: overlap of the masks, score,
    verdict, what it was taken for, whether class, face (class and stable pose) and branch (face, and yaw within 6
    degrees) are right, and the errors: absolute differences in the camera frame and the angle between the orientations,
    by comparison. ``raw_errors`` are those before refinement. ``readings`` is the number of poses that the estimate
    leaves open, ``reading_right`` whether the branch of one of them is right (view-equivalent). ``yaw_error_deg``
    (signed, modulo symmetries) is there when the face is right, ``mssd_mm`` when the class is, ``nees`` (6 degrees of
    freedom) and ``nees_planar`` (3: x, y, yaw) when the branch is and there is a covariance.

    Of a part that was not detected ``verdict`` says "missed", or "not a part" when an estimate of it was rejected so.
    """

    method: str
    domain: str
    image: int
    instance: int
    part: str = ""
    stable_pose: int = -1
    visible_share: float = 0.0
    whole: bool = True
    x_board_mm: float = 0.0
    y_board_mm: float = 0.0
    brightness: float = 0.0
    detected: bool = False
    iou: float = 0.0
    score: float = 0.0
    accepted: bool = False
    verdict: str = "missed"
    estimated_part: str = ""
    estimated_stable_pose: int = -1
    class_right: bool = False
    face_right: bool = False
    branch_right: bool = False
    branch_right_equivalent: bool = False
    readings: int = 1
    reading_right: bool = False
    yaw_error_deg: float | None = None
    errors: dict[str, Errors] | None = None
    raw_errors: dict[str, Errors] | None = None
    mssd_mm: float | None = None
    nees: float | None = None
    nees_planar: float | None = None
    details: dict[str, float] = field(default_factory=dict)

    @property
    def is_part(self) -> bool:
        """Whether the row is of a part, not of a detection that belongs to none."""
        return self.instance != NO_PART

    @property
    def flipped(self) -> bool:
        """Whether the face is right and the yaw is more than 90 degrees off."""
        return self.face_right and self.yaw_error_deg is not None and abs(self.yaw_error_deg) > 90.0


_FIELDS = {f.name for f in fields(Outcome)}


def outcome_to_json(outcome: Outcome) -> dict[str, Any]:
    """A JSON object with the fields' names."""
    return asdict(outcome)


def outcome_from_json(row: Mapping[str, Any]) -> Outcome:
    """The outcome that ``outcome_to_json`` wrote; raises PerceptionError naming fields that are unknown or missing."""
    unknown = sorted(set(row) - _FIELDS)
    missing = sorted({"method", "domain", "image", "instance"} - set(row))
    if unknown or missing:
        what = [f"unknown fields {unknown}"] * bool(unknown) + [f"no {', '.join(missing)}"] * bool(missing)
        raise PerceptionError(
            f"an outcome with {' and '.join(what)}: it is of another version; evaluate again into a new folder"
        )
    return Outcome(**row)


def outcomes_to_text(outcomes: Iterable[Outcome]) -> str:
    """JSON, one row a line."""
    rows = ",\n".join(json.dumps(outcome_to_json(o)) for o in outcomes)
    return f"[\n{rows}\n]\n"
