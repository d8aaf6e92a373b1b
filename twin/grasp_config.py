"""What a grasp is, how grasps are searched and cleared, and what a trial in physics found of one."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from cad import gripper
from cad.spatial import Array
from twin.grasp_geometry import ContactRules, PadContact
from twin.robot import TwinError


class GraspError(TwinError):
    """A grasp file that is missing or does not fit its part."""


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """How grasps are searched and cleared, in metres and radians.

    ``clearance_m`` is what the fingers leave free on either side of a part before they close, down to
    ``min_clearance_m`` where neighbours or the stroke do not allow more. The hand does not notice parts narrower than
    ``min_width_m``. ``keep`` candidates of a stable pose are tried in physics until ``enough`` of them have held,
    fewer of a part of many convex pieces, each trial of which takes long: ``pieces_in_trials`` over all.
    """

    yaw_step: float = np.deg2rad(5.0)
    lateral_step_m: float = 0.5e-3
    lateral_reach_m: float = 4.0e-3
    distinct_m: float = 0.9e-3
    distinct_yaw: float = np.deg2rad(8.0)
    tip_clearance_m: float = 0.15e-3
    sample_spacing_m: float = 0.08e-3
    max_samples: int = 120_000
    clearance_m: float = 3.0e-3
    min_clearance_m: float = 1.5e-3
    neighbour_margin_m: float = 0.5e-3
    min_width_m: float = 0.4e-3
    keep: int = 12
    enough: int = 8
    pieces_in_trials: int = 240
    rules: ContactRules = field(default_factory=ContactRules)

    def __post_init__(self) -> None:
        if not 0 < self.min_clearance_m <= self.clearance_m:
            raise ValueError(
                f"opening clearances {self.min_clearance_m} .. {self.clearance_m} m a side must be positive and ordered"
            )
        if not 0 < self.tip_clearance_m < gripper.PAD_HEIGHT_M:
            raise ValueError(
                f"tip clearance {self.tip_clearance_m} m must lie between 0 and the pad height {gripper.PAD_HEIGHT_M} m"
            )
        if not 1 <= self.enough <= self.keep:
            raise ValueError(f"enough {self.enough} must be at least 1 and at most keep {self.keep}")

    @property
    def max_width_m(self) -> float:
        """The widest that a part may be between the pads."""
        return gripper.STROKE_M - 2 * self.min_clearance_m

    def enough_for(self, pieces: int) -> int:
        """How many grasps of a stable pose are enough for a part of that many convex pieces."""
        return max(1, min(self.enough, self.pieces_in_trials // max(1, pieces)))

    def clearance_at(self, width_m: float) -> float:
        """Clearance on either side with which the fingers come down on a part of that width."""
        return min(self.clearance_m, (gripper.STROKE_M - width_m) / 2)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What became of a part that was gripped, lifted, carried, lowered and let go in physics.

    ``why`` says what went wrong when it was not ``held``. ``shift_*`` is how far closing moved the part in the hand
    from where the grasp has it, ``slip_*`` how far it moved in the hand from then until it was let go, ``place_*`` how
    far it came to rest from where it should be, in metres and radians; NaN where the trial did not get that far.
    ``margin`` is the share of trials with the hand off by the offsets of :class:`twin.grasp_trial.TrialConfig` that
    held as well, None when that was not tried.
    """

    held: bool
    why: str = ""
    shift_m: float = np.nan
    shift_rad: float = np.nan
    slip_m: float = np.nan
    slip_rad: float = np.nan
    place_m: float = np.nan
    place_rad: float = np.nan
    margin: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain numbers in millimetres and degrees; only trials that held are stored."""
        out: dict[str, Any] = {"held": self.held}
        for name in ("shift", "slip", "place"):
            out[f"{name}_mm"] = round(1e3 * getattr(self, f"{name}_m"), 4)
            out[f"{name}_deg"] = round(float(np.degrees(getattr(self, f"{name}_rad"))), 3)
        return out | {"margin": self.margin}


def trial_from_json(entry: dict[str, Any]) -> Trial:
    """The trial that ``Trial.as_json`` wrote."""
    return Trial(
        held=entry["held"],
        margin=entry["margin"],
        shift_m=1e-3 * entry["shift_mm"],
        shift_rad=float(np.radians(entry["shift_deg"])),
        slip_m=1e-3 * entry["slip_mm"],
        slip_rad=float(np.radians(entry["slip_deg"])),
        place_m=1e-3 * entry["place_mm"],
        place_rad=float(np.radians(entry["place_deg"])),
    )


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One way to take hold of a part that lies in one of its stable poses.

    ``T_part_tcp`` (4, 4) is where the tool is when the pads have closed, ``width_m`` the opening then, ``opening_m``
    the opening to come down with, ``quality`` in (0, 1], best first. A stored grasp has a ``trial``, which held.
    """

    part: str
    stable_pose: int
    T_part_tcp: Array
    width_m: float
    opening_m: float
    quality: float
    contact: PadContact
    trial: Trial | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for ``grasps.json``."""
        return {
            "stable_pose": self.stable_pose,
            "T_part_tcp": self.T_part_tcp.round(9).tolist(),
            "width_m": round(self.width_m, 7),
            "opening_m": round(self.opening_m, 7),
            "quality": round(self.quality, 4),
            "contact": {k: float(f"{v:.4g}") for k, v in asdict(self.contact).items()},
            "trial": self.trial.as_json() if self.trial else None,
        }


def grasp_from_json(part: str, entry: dict[str, Any]) -> Grasp:
    """The grasp that ``Grasp.as_json`` wrote."""
    return Grasp(
        part=part,
        stable_pose=entry["stable_pose"],
        T_part_tcp=np.array(entry["T_part_tcp"]),
        width_m=entry["width_m"],
        opening_m=entry["opening_m"],
        quality=entry["quality"],
        contact=PadContact(**entry["contact"]),
        trial=trial_from_json(entry["trial"]) if entry.get("trial") else None,
    )
