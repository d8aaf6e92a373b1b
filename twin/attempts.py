"""What a controller is told, and what it tells of each part: configuration, calibration, attempts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from cad import gripper, robot
from cad.spatial import Array
from twin.grasp_config import Grasp

Outcome = Literal["placed", "detection", "declined", "pose", "ik", "grasp", "transport", "place", "collision"]
"""How an attempt ended as far as the controller can tell: placed, or the reason why not."""
OUTCOMES: tuple[str, ...] = get_args(Outcome)


@dataclass(frozen=True, kw_only=True)
class ControllerConfig:
    """Heights, speeds and tolerances of the pick-and-place cycle, inside the UR5e's and Hand-E's limits."""

    hover_m: float = 0.030
    """TCP above its grasp height before it goes straight down, and after it has let go: above every part's top."""
    carry_m: float = 0.080
    """TCP above the board while a part is carried."""
    place_gap_m: float = 0.15e-3
    """The part's lowest point above the nest when it is let go."""
    joint_speed: float = 2.4
    joint_acceleration: float = 8.0
    carry_speed: float = 1.6
    carry_acceleration: float = 2.5
    carry_min_s: float = 1.1
    """A carry takes at least this long."""
    linear_speed: float = 0.25
    linear_acceleration: float = 1.2
    touch_m: float = 0.006
    """The last stretch down, at ``touch_speed``."""
    touch_speed: float = 0.05
    touch_acceleration: float = 0.6
    lift_speed: float = 0.15
    lift_acceleration: float = 0.8
    grip_force_n: float = 20.0
    grip_speed: float = 0.030
    open_speed: float = 0.150
    release_speed: float = 0.020
    release_m: float = 1.0e-3
    """How far each pad backs off slowly before the fingers open fast."""
    overclose_m: float = 4.0e-3
    """The commanded opening lies this far below the part's width, so that the force limit is reached."""
    width_tolerance_m: float = 0.25e-3
    plane_tolerance_m: float = 1.5e-3
    plane_tolerance: float = np.deg2rad(8.0)
    """An estimate further off the board or more tilted than this is not trusted."""
    tries_per_region: int = 3
    region_m: float = 0.008
    idle_looks: int = 2
    """Looks in a row at which nothing can be done before the run ends."""
    max_looks: int = 100

    def __post_init__(self) -> None:
        for name in ("joint_speed", "carry_speed"):
            value, limit = getattr(self, name), min(robot.SPEED_LIMIT_RAD_S)
            if not 0 < value <= limit:
                raise ValueError(f"{name} {value} rad/s must be above 0 and at most {limit:.3f}, the UR5e's limit")
        low, high = gripper.SPEED_RANGE_M_S
        for name in ("grip_speed", "open_speed", "release_speed"):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} {getattr(self, name)} m/s is outside the Hand-E's {low} .. {high}")
        low, high = gripper.FORCE_RANGE_N
        if not low <= self.grip_force_n <= high:
            raise ValueError(f"grip_force_n {self.grip_force_n} is outside the Hand-E's {low} .. {high}")
        if not 0 < self.touch_m <= self.hover_m <= self.carry_m:
            raise ValueError(
                f"heights touch_m {self.touch_m}, hover_m {self.hover_m}, carry_m {self.carry_m} must be above 0 and "
                "in this order"
            )
        if self.tries_per_region < 1 or self.idle_looks < 1 or self.max_looks < 1:
            raise ValueError(
                f"tries_per_region {self.tries_per_region}, idle_looks {self.idle_looks} and max_looks "
                f"{self.max_looks} must be at least 1"
            )


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Where things nominally are for the robot: the board, the nests of each part, the parked arm out of the view.

    ``T_base_board`` (4, 4); ``T_base_nests`` maps a part's name to (K, 4, 4); ``q_park`` (6,) rad;
    ``board_half_m`` half extents of the pick area in the board frame.
    """

    T_base_board: Array
    T_base_nests: Mapping[str, Array]
    q_park: Array
    board_half_m: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """One try at one part, or a part that was seen and never tried (``tried`` false).

    ``T_base_part`` (4, 4) is the estimate brought down to the board plane; ``T_part_tcp`` the grasp as carried out;
    ``opening_m`` the opening measured after closing; ``view`` the kind of look that it was chosen from. Times are the
    robot's, in seconds; ``look_time_s`` is that of the first look after the attempt before.
    """

    part: str
    stable_pose: int
    T_base_part: Array
    outcome: Outcome | None = None
    note: str = ""
    tried: bool = True
    number: int = 1
    grasp: Grasp | None = None
    T_part_tcp: Array | None = None
    nest: int | None = None
    approach_opening_m: float | None = None
    opening_m: float | None = None
    view: str = "usual"
    look_time_s: float = 0.0
    start_s: float = 0.0
    end_s: float = 0.0

    @property
    def T_base_tcp(self) -> Array | None:
        """Tool pose (4, 4) at which the pads close."""
        return None if self.T_part_tcp is None else self.T_base_part @ self.T_part_tcp
