"""A grasp tried in physics: a hand without an arm takes the part from the board, carries it and puts it down again.

Board, part, fingers and contacts are those of the cell, and heights, speeds and forces those of the controller.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, fields, replace

import numpy as np

from cad import gripper
from cad.parts import Part
from cad.spatial import Array, inverse, rotation_angle, rotation_z, transform
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_board_scene, part_body, set_parts
from twin.attempts import ControllerConfig
from twin.floating_hand import FloatingHand, add_floating_hand
from twin.grasp_config import Grasp, Trial
from twin.robot import GripState
from twin.robot_contacts import RobotContacts

Offset = tuple[float, float, float]
"""Error of the hand: across the pads (m), along them (m), about the vertical (rad)."""


@dataclass(frozen=True, kw_only=True)
class TrialConfig:
    """What a trial does with a part and what it must survive; metres, radians, seconds.

    The part is lifted by ``lift_m``, carried over ``carry_m`` with a ``turn`` on the way, accelerated as the
    controller's fastest carries accelerate the tool, and put down. It may slip by the ``tolerance`` and lie off by as
    much, half of what the referee allows a placed part. ``offsets`` are the errors of the hand that the best grasps are
    tried with.
    """

    lift_m: float = 0.060
    carry_m: float = 0.060
    turn: float = np.deg2rad(20.0)
    acceleration: float = 1.5
    hold_s: float = 0.05
    settle_s: float = 0.10
    above_m: float = 1.0e-3
    tolerance_m: float = 0.15e-3
    tolerance_rad: float = np.deg2rad(1.5)
    pad_friction: float = gripper.PAD_FRICTION
    grip_limit_s: float = 1.0
    grip_rest_s: float = 0.02
    offsets: tuple[Offset, ...] = (
        (0.3e-3, 0.3e-3, np.deg2rad(3.0)),
        (0.3e-3, -0.3e-3, np.deg2rad(-3.0)),
        (-0.3e-3, 0.3e-3, np.deg2rad(-3.0)),
        (-0.3e-3, -0.3e-3, np.deg2rad(3.0)),
    )
    controller: ControllerConfig = field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, float) and not value > 0:
                raise ValueError(f"{entry.name} {value}: it must be positive")


class _Failed(Exception):  # noqa: N818 - ends a trial
    """What a grasp must not do; the message says what it was."""


class TrialBench:
    """A board, a part and a hand to try the part's grasps with. Trials may run in several threads at once."""

    def __init__(self, part: Part, config: TrialConfig | None = None) -> None:
        self.part, self.config = part, config or TrialConfig()
        cell = CellConfig(board_centre_m=(0.0, 0.0), board_yaw_rad=0.0, parts_dir=part.folder.parent)
        self.T_world_board = cell.T_world_board
        spec = build_board_scene(cell, [part.folder.name])
        add_floating_hand(spec, timestep_s=cell.timestep_s, grip_force_n=self.config.controller.grip_force_n)
        self.model = spec.compile()
        for pad in ("pad_left", "pad_right"):
            self.model.geom(pad).friction[0] = self.config.pad_friction

    def run(self, grasp: Grasp, offset: Offset = (0.0, 0.0, 0.0), *, whole: bool = True) -> Trial:
        """Try ``grasp`` with the hand off by ``offset``; ``whole`` False stops once the part is lifted and held."""
        return _Run(self, grasp, offset).result(whole=whole)

    def margin(self, grasp: Grasp, pool: Executor) -> float:
        """The share of the configured offsets of the hand with which the part is still lifted and held."""
        trials = pool.map(lambda offset: self.run(grasp, offset, whole=False), self.config.offsets)
        return float(np.mean([trial.held for trial in trials]))


class _Run:
    """One trial, from a hand above the part to a part on the board again."""

    def __init__(self, bench: TrialBench, grasp: Grasp, offset: Offset) -> None:
        self._config, self._controller = bench.config, bench.config.controller
        self._grasp, self._part = grasp, bench.part
        self._pose = bench.part.stable_poses[grasp.stable_pose]
        self._model, self._data = bench.model, mujoco.MjData(bench.model)
        self._body = self._model.body(part_body(0)).id
        self._hand = FloatingHand(self._model, self._data)
        self._contacts = RobotContacts(self._model, self._data, [self._body])
        self._T_world_part = bench.T_world_board @ self._pose.T_table_part
        across, along, turn = offset
        T_world_tcp = self._T_world_part @ grasp.T_part_tcp @ transform(rotation_z(turn), [across, along, 0.0])
        top = float((self._part.mesh.vertices @ self._T_world_part[2, :3]).max() + self._T_world_part[2, 3])
        self._above = max(0.0, top - float(T_world_tcp[2, 3])) + self._config.above_m
        set_parts(self._model, self._data, self._T_world_part[None])
        self._hand.put(transform(t=[0.0, 0.0, self._above]) @ T_world_tcp, grasp.opening_m)

    def result(self, *, whole: bool) -> Trial:
        """Run the trial and say how it ended."""
        trial = Trial(held=False)
        try:
            self._come_down()
            self._close()
            T_start = self._T_tcp_part
            trial = replace(trial, **self._moved("shift", inverse(self._grasp.T_part_tcp), T_start))
            self._hand_move([0.0, 0.0, self._config.lift_m], self._controller.lift_speed, "while lifted")
            if not whole:
                return replace(trial, held=True)
            self._carry()
            trial = replace(trial, **self._moved("slip", T_start, self._T_tcp_part))
            self._check_moved(trial.slip_m, trial.slip_rad, "slipped in the hand")
            trial = replace(trial, **self._let_go())
            self._check_moved(trial.place_m, trial.place_rad, "came to rest away from its place")
        except _Failed as failure:
            return replace(trial, why=str(failure))
        return replace(trial, held=True)

    # -- motions --------------------------------------------------------------------------------------------------

    def _come_down(self) -> None:
        slow = min(self._above, self._controller.touch_m)
        if self._above > slow:
            self._move([0.0, 0.0, slow - self._above], self._controller.linear_speed)
        self._move([0.0, 0.0, -slow], self._controller.touch_speed)
        self._contacts.update()
        moved = float(np.linalg.norm(self._T_world_part_now[:3, 3] - self._T_world_part[:3, 3]))
        if self._contacts.touched or moved > self._config.tolerance_m:
            raise _Failed("the fingers hit the part on the way down")
        if self._contacts.strikes:
            raise _Failed("the fingers touched the board")

    def _close(self) -> None:
        width = self._grasp.width_m
        self._grip(max(0.0, width - self._controller.overclose_m), self._controller.grip_speed)
        if not self._holds:
            opening = 1e3 * self._hand.hand.opening_m
            raise _Failed(f"closed without a grip: opening {opening:.2f} mm, the part is {1e3 * width:.2f} mm wide")

    def _carry(self) -> None:
        diagonal = self._config.carry_m / np.sqrt(2) * np.array([1.0, 1.0, 0.0])
        self._hand_move(diagonal, self._controller.carry_speed, "while carried", self._config.turn)
        down = self._controller.place_gap_m - self._config.lift_m
        self._hand_move([0.0, 0.0, down], self._controller.lift_speed, "while lowered")

    def _let_go(self) -> dict[str, float]:
        T_should = self._hand.T_world_tcp @ inverse(self._grasp.T_part_tcp)
        self._grip(self._grasp.width_m + 2 * self._controller.release_m, self._controller.release_speed)
        self._hand.wait(self._config.settle_s)
        T = self._T_world_part_now
        T_should[2, 3] = self._T_world_part[2, 3]
        distance, angle = self._part.rest_symmetries(self._pose.index).difference(T_should, T)
        return {"place_m": distance, "place_rad": angle}

    def _move(self, shift: list[float] | Array, speed: float, turn: float = 0.0) -> None:
        self._hand.move(np.asarray(shift), turn, speed=speed, acceleration=self._config.acceleration)

    def _hand_move(self, shift: list[float] | Array, speed: float, when: str, turn: float = 0.0) -> None:
        """A move with the part in the hand."""
        self._move(shift, speed, turn)
        self._hand.wait(self._config.hold_s)
        if not self._holds:
            raise _Failed(f"lost {when}")

    def _grip(self, opening_m: float, speed: float) -> None:
        config = self._config
        force = self._controller.grip_force_n
        limits = {"limit_s": config.grip_limit_s, "rest_s": config.grip_rest_s}
        if not self._hand.grip(opening_m, force_n=force, speed=speed, **limits):
            raise _Failed("the fingers did not come to rest")

    # -- judging --------------------------------------------------------------------------------------------------

    @property
    def _holds(self) -> bool:
        """Whether the hand reports an object as wide as the part, as the controller asks."""
        hand = self._hand.hand
        close = abs(hand.opening_m - self._grasp.width_m) <= self._controller.width_tolerance_m
        return hand.state is GripState.CONTACT_CLOSING and close

    @property
    def _T_world_part_now(self) -> Array:
        return transform(self._data.xmat[self._body].reshape(3, 3).copy(), self._data.xpos[self._body].copy())

    @property
    def _T_tcp_part(self) -> Array:
        return inverse(self._hand.T_world_tcp) @ self._T_world_part_now

    def _moved(self, name: str, T_before: Array, T_after: Array) -> dict[str, float]:
        """How far the part's centre of mass went and by what angle the part turned."""
        centre = self._part.mesh.center_mass
        shift = (T_after[:3, :3] - T_before[:3, :3]) @ centre + T_after[:3, 3] - T_before[:3, 3]
        angle = rotation_angle(T_before[:3, :3], T_after[:3, :3])
        return {f"{name}_m": float(np.linalg.norm(shift)), f"{name}_rad": angle}

    def _check_moved(self, distance: float, angle: float, what: str) -> None:
        if distance > self._config.tolerance_m or angle > self._config.tolerance_rad:
            raise _Failed(f"{what} by {1e3 * distance:.2f} mm and {np.degrees(angle):.1f} degrees")
