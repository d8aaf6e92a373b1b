"""Where everything in the cell stands: one frozen config and the frames that follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cad.gripper import FORCE_RANGE_N
from cad.parts import Part
from cad.robot import UR5E, DhTable
from cad.spatial import BASLER, Array, Intrinsics, rotation_x, rotation_z, transform
from cad.station import BOOM_REACH_M, TRAY_SIZE_M
from cad.tagboard import TagboardConfig
from scenes.errors import SceneError

HAND_CLEARANCE_M = 0.012
"""Between the parts in two nests: room for an open finger on either side of each."""


@dataclass(frozen=True, kw_only=True)
class TrayConfig:
    """A flat tray with a row of nests for each class, lengths in metres; its size is ``cad.station.TRAY_SIZE_M``.

    The tray lies on the table; its frame is at the centre of its top face, turned like the board. Classes follow each
    other along the tray's x, the nests of a class along its y.
    """

    centre_m: tuple[float, float] = (0.43, 0.25)
    classes: tuple[str, ...] = ("inserted", "main", "top")
    nests_per_class: int = 5
    pitch_m: tuple[float, float] = (0.036, 0.030)

    def __post_init__(self) -> None:
        if self.nests_per_class < 1 or not self.classes:
            raise SceneError(f"a tray needs classes and nests, got {self.classes} with {self.nests_per_class} each")
        need = (len(self.classes) * self.pitch_m[0], self.nests_per_class * self.pitch_m[1])
        if need[0] > TRAY_SIZE_M[0] or need[1] > TRAY_SIZE_M[1]:
            raise SceneError(
                f"{len(self.classes)} classes with {self.nests_per_class} nests need {need[0]:.3f} x {need[1]:.3f} m; "
                f"the tray has {TRAY_SIZE_M[0]} x {TRAY_SIZE_M[1]} m: use fewer nests_per_class or a smaller pitch_m"
            )

    @classmethod
    def for_parts(cls, parts: Sequence[Part], at_least: int = 1) -> TrayConfig:
        """A tray with as many nests for ``parts`` as their size leaves room for, up to the usual number.

        Raises SceneError when there is no room for ``at_least`` nests a class.
        """
        plain = cls()
        need = max(2 * part.radius_m for part in parts) + HAND_CLEARANCE_M
        nests = min(plain.nests_per_class, int(TRAY_SIZE_M[1] / need))
        if nests < at_least or len(parts) * need > TRAY_SIZE_M[0]:
            raise SceneError(
                f"the tray of {1e3 * TRAY_SIZE_M[0]:.0f} x {1e3 * TRAY_SIZE_M[1]:.0f} mm has no room for {at_least} "
                f"nests of {1e3 * need:.0f} mm for each of {len(parts)} parts; use fewer or smaller parts"
            )
        pitch = max(need, min(plain.pitch_m[0], TRAY_SIZE_M[0] / len(parts))), max(need, plain.pitch_m[1])
        return cls(classes=tuple(part.name for part in parts), nests_per_class=nests, pitch_m=pitch)

    def nests(self, part: str) -> Array:
        """``T_tray_nest`` (K, 4, 4) of a class; raises SceneError for a class the tray has no nests for."""
        if part not in self.classes:
            raise SceneError(f"the tray has no nest for {part!r}; its classes are {', '.join(self.classes)}")
        x = (self.classes.index(part) - (len(self.classes) - 1) / 2) * self.pitch_m[0]
        rows = (np.arange(self.nests_per_class) - (self.nests_per_class - 1) / 2) * self.pitch_m[1]
        return np.stack([transform(t=[x, y, 0.0]) for y in rows])


@dataclass(frozen=True, kw_only=True)
class CellConfig:
    """The cell, lengths in metres, in the world frame (= the arm's ``base``), z = 0 on the table.

    ``pick_area_half_m`` are the half extents, in the board's frame, of the area that parts are dropped into.
    ``home_q`` (6,) rad keeps arm and hand out of the camera's sight. ``grip_force_n`` is the hand's force at the start.
    ``arm`` is the arm's kinematic table: nominal, or one calibrated arm's (``cad.robot_calibration``).
    """

    tagboard: TagboardConfig = field(default_factory=TagboardConfig)
    board_centre_m: tuple[float, float] = (0.45, 0.0)
    board_yaw_rad: float = -np.pi / 2
    pick_area_half_m: tuple[float, float] = (0.075, 0.045)
    camera_height_m: float = 0.70
    intrinsics: Intrinsics = BASLER
    tray: TrayConfig = field(default_factory=TrayConfig)
    arm: DhTable = UR5E
    home_q: tuple[float, ...] = (-2.396, -1.968, 1.988, -1.591, -1.571, 0.746)
    grip_force_n: float = FORCE_RANGE_N[0]
    timestep_s: float = 0.0005
    parts_dir: Path | None = None

    def __post_init__(self) -> None:
        if len(self.home_q) != 6:
            raise SceneError(f"home_q has {len(self.home_q)} entries; it needs 6, one a joint")
        if not 0 < self.timestep_s <= 0.002:
            raise SceneError(f"timestep_s {self.timestep_s}: must be above 0 and at most 0.002 s for parts this small")
        free = self.tagboard.free_half_extents_m
        if self.pick_area_half_m[0] > free[0] or self.pick_area_half_m[1] > free[1]:
            raise SceneError(f"pick area {self.pick_area_half_m} m exceeds the board's free middle {free} m")
        if self.camera_height_m <= 0.1:
            raise SceneError(f"camera_height_m {self.camera_height_m}: at least 0.1 m above the board is needed")

    @property
    def T_world_board(self) -> Array:
        """(4, 4) board frame: centre of the plate's top face."""
        return transform(rotation_z(self.board_yaw_rad), [*self.board_centre_m, self.tagboard.thickness_m])

    @property
    def T_board_cam(self) -> Array:
        """(4, 4) nominal camera: straight above the board's centre, image right along the board's x."""
        return transform(rotation_x(np.pi), [0.0, 0.0, self.camera_height_m])

    @property
    def T_world_cam(self) -> Array:
        """(4, 4) nominal camera."""
        return self.T_world_board @ self.T_board_cam

    @property
    def T_world_tray(self) -> Array:
        """(4, 4) tray frame: centre of its top face."""
        return transform(rotation_z(self.board_yaw_rad), [*self.tray.centre_m, TRAY_SIZE_M[2]])

    @property
    def T_world_stand(self) -> Array:
        """(4, 4) stand frame: on the table at the foot of the column, behind the board as seen from the robot."""
        return transform(t=[self.board_centre_m[0] + BOOM_REACH_M, self.board_centre_m[1], 0.0])

    def nest_frames(self, part: str) -> Array:
        """``T_world_nest`` (K, 4, 4) of a class: a part lies right in a nest at ``T_world_nest @ T_table_part``."""
        return self.T_world_tray @ self.tray.nests(part)
