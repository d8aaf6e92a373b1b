"""The motions of a pick: approach, close, check the grip, lift, carry, let go, park; and a push with closed fingers.

Each either does what it says or raises ActionFailed with the reason; a robot's own errors pass through.
"""

from __future__ import annotations

import numpy as np

from cad.spatial import Array, transform
from twin.attempts import Calibration, ControllerConfig, Outcome
from twin.grasp_choice import GraspChoice
from twin.ik import ArmIk
from twin.nudge import Nudge, NudgeConfig
from twin.profiles import speed_for
from twin.robot import GripState, Robot, RobotState


class ActionFailed(Exception):  # noqa: N818 - ends an attempt, never the run
    """An action that did not do what it should; ``outcome`` is the attempt's reason."""

    def __init__(self, outcome: Outcome, note: str) -> None:
        super().__init__(note)
        self.outcome: Outcome = outcome


class Actions:
    """Pick, carry and place with any robot."""

    def __init__(self, robot: Robot, ik: ArmIk, calibration: Calibration, config: ControllerConfig) -> None:
        self._robot, self._ik, self._calibration, self._config = robot, ik, calibration, config

    def park(self, q: Array | None = None) -> None:
        """Bring the arm to ``q`` (6,), out of the camera's view, straight up first where it is among the parts.

        It parks where the calibration says if ``q`` is left out.
        """
        config = self._config
        T_base_tcp = self._robot.observe().T_base_tcp
        if T_base_tcp[2, 3] < self._board_z + 0.9 * config.hover_m:
            self._line(self._at_height(T_base_tcp, self._carry_z), config.linear_speed, config.linear_acceleration)
        self._swing(self._calibration.q_park if q is None else q)

    def nudge(self, nudge: Nudge, nudges: NudgeConfig) -> None:
        """Push with closed fingers, back off, rise."""
        config = self._config
        self._grip(0.0, config.open_speed)
        above = transform(t=[0.0, 0.0, config.hover_m])
        self._swing(self._ik.solve(above @ nudge.T_base_start))
        self._down(nudge.T_base_start, config.linear_speed, config.linear_acceleration)
        self._line(nudge.T_base_end, nudges.speed, nudges.acceleration)
        self._line(nudge.T_base_back, nudges.speed, nudges.acceleration)
        self._line(above @ nudge.T_base_back, config.linear_speed, config.linear_acceleration)

    def pick(self, T_base_part: Array, choice: GraspChoice) -> float:
        """Approach, close, check, lift to carry height. Returns the opening measured after closing, in metres."""
        config, width = self._config, choice.grasp.width_m
        T_base_tcp = T_base_part @ choice.T_part_tcp
        self._grip(choice.openings_m[0], config.open_speed)
        self._swing(self._ik.solve(transform(t=[0.0, 0.0, config.hover_m]) @ T_base_tcp, choice.q_pick))
        self._down(T_base_tcp, config.linear_speed, config.linear_acceleration)
        closed = self._grip(max(0.0, width - config.overclose_m), config.grip_speed)
        if not self._holds(closed, width):
            self._grip(choice.openings_m[0], config.release_speed)
            raise ActionFailed("grasp", _describe(closed, width))
        self._line(self._at_height(T_base_tcp, self._carry_z), config.lift_speed, config.lift_acceleration)
        self._check("grasp", "lost while lifting", width)
        return closed.opening_m

    def carry(self, T_base_part_at_nest: Array, choice: GraspChoice) -> None:
        """Bring the part from above the board to above its nest at carry height."""
        config = self._config
        above = self._at_height(T_base_part_at_nest @ choice.T_part_tcp, self._carry_z)
        q_above = self._ik.solve(above, choice.q_place)
        lead = float(np.abs(q_above - self._robot.observe().q).max())
        speed = min(config.carry_speed, speed_for(lead, config.carry_acceleration, config.carry_min_s))
        self._robot.move_j(q_above, speed=speed, acceleration=config.carry_acceleration)
        self._check("transport", "lost while carried", choice.grasp.width_m)

    def place(self, T_base_part_at_nest: Array, choice: GraspChoice) -> None:
        """Go down, let go, retreat straight up.

        Closing has centred the part across the pads, so it hangs in the hand where the CAD grasp says, and the tool
        goes to that same grasp at the nest. The pads back off slowly first: a quick release throws a light part.
        """
        config, width = self._config, choice.grasp.width_m
        T_base_tcp = transform(t=[0.0, 0.0, config.place_gap_m]) @ T_base_part_at_nest @ choice.T_part_tcp
        self._down(T_base_tcp, config.lift_speed, config.lift_acceleration)
        self._check("place", "lost above the nest", width)
        self._grip(width + 2 * config.release_m, config.release_speed)
        self._grip(choice.openings_m[1], config.open_speed)
        above = transform(t=[0.0, 0.0, config.hover_m]) @ T_base_tcp
        self._line(above, config.linear_speed, config.linear_acceleration)

    @property
    def _board_z(self) -> float:
        return float(self._calibration.T_base_board[2, 3])

    @property
    def _carry_z(self) -> float:
        return self._board_z + self._config.carry_m

    def _at_height(self, T_base_tcp: Array, z: float) -> Array:
        return transform(T_base_tcp[:3, :3], [*T_base_tcp[:2, 3], z])

    def _swing(self, q: Array) -> None:
        self._robot.move_j(q, speed=self._config.joint_speed, acceleration=self._config.joint_acceleration)

    def _line(self, T_base_tcp: Array, speed: float, acceleration: float) -> None:
        self._robot.move_l(T_base_tcp, speed=speed, acceleration=acceleration)

    def _down(self, T_base_tcp: Array, speed: float, acceleration: float) -> None:
        """Straight down, the last stretch slowly."""
        config = self._config
        self._line(transform(t=[0.0, 0.0, config.touch_m]) @ T_base_tcp, speed, acceleration)
        self._line(T_base_tcp, config.touch_speed, config.touch_acceleration)

    def _grip(self, opening_m: float, speed: float) -> RobotState:
        return self._robot.grip(opening_m, force_n=self._config.grip_force_n, speed=speed)

    def _check(self, outcome: Outcome, what: str, width_m: float) -> None:
        state = self._robot.observe()
        if not self._holds(state, width_m):
            raise ActionFailed(outcome, f"{what}: {_describe(state, width_m)}")

    def _holds(self, state: RobotState, width_m: float) -> bool:
        """Whether the hand reports an object and its opening is the part's width."""
        close = abs(state.opening_m - width_m) <= self._config.width_tolerance_m
        return state.grip is GripState.CONTACT_CLOSING and close


def _describe(state: RobotState, width_m: float) -> str:
    return (
        f"the hand reports {state.grip.name} at {1e3 * state.opening_m:.2f} mm, "
        f"the part is {1e3 * width_m:.2f} mm wide there"
    )
