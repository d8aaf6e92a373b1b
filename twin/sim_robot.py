"""The robot in simulation: UR's moveJ and moveL and the Hand-E's grip on a MuJoCo model of the cell.

The robot owns the clock: its moves step the physics. What it observes is what a real controller would report: joint
encoders, the TCP that nominal kinematics make of them, and the gripper's own opening and object detection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from cad import robot
from cad.spatial import Array
from scenes.arm import arm_inputs
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm
from twin.ik import ArmIk, IkConfig, IkError
from twin.profiles import JointPath, LinearPath, sample, steps_per_period
from twin.robot import JointMove, LinearMove, MotionRefused, RobotError, RobotState
from twin.sim_hand import SimHand


@dataclass(frozen=True, kw_only=True)
class SimRobotConfig:
    """Control period, limits and tolerances of the simulated controller; metres, radians, seconds."""

    control_period_s: float = 0.002
    """UR's e-Series controllers run at 500 Hz."""
    max_joint_acceleration: float = 40.0
    max_tool_speed: float = 3.0
    max_tool_acceleration: float = 150.0
    """Largest values that a UR accepts for moves (ur_rtde's own guards)."""
    min_tcp_z_m: float = 0.0
    """The table: no target or path may bring the TCP below it."""
    knot_spacing_m: float = 0.005
    """Linear moves are solved this densely; the cubic spline in between stays within 0.01 um of the line."""
    tracking_limit: float = 0.1
    """A joint further than this from its path means that something is in the way: a protective stop."""
    settle_error: float = 1e-5
    settle_speed: float = 1e-3
    settle_limit_s: float = 0.5
    grip_rest_s: float = 0.02
    grip_limit_s: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value) or (value <= 0 and name != "min_tcp_z_m"):
                raise ValueError(f"{name} {value} must be finite and positive")


class SimRobot:
    """A UR5e with a Hand-E inside a compiled cell; implements :class:`twin.robot.Robot`.

    ``on_step`` is called after every physics step; ``ik`` is a solver for this arm around the cell's home pose. Raises
    ProfileError when the control period is not a whole multiple of the model's time step. The arm holds the position
    it is in when the robot is made.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        cell: CellConfig,
        config: SimRobotConfig | None = None,
        *,
        on_step: Callable[[], None] | None = None,
    ) -> None:
        self._model, self._data, self._config = model, data, config or SimRobotConfig()
        self._steps = steps_per_period(self._config.control_period_s, float(model.opt.timestep))
        self.on_step = on_step
        arm, q_home = build_arm(cell), np.array(cell.home_q)
        self.ik = ArmIk(arm.compile(), q_home)
        self._kinematics = ArmIk(arm.compile(), q_home, IkConfig(joint_window=4 * np.pi))
        joints = [model.joint(name) for name in robot.JOINT_NAMES]
        # views of the arm's entries, made once: they are read in every control period
        self._dofs = _run(np.array([j.dofadr[0] for j in joints]))
        self._q, self._qd = data.qpos[_run(np.array([j.qposadr[0] for j in joints]))], data.qvel[self._dofs]
        self._servos = data.ctrl[_run(arm_inputs(model).T)].reshape(6, 3).T
        self._hand = SimHand(model, data)
        self._hold_s = (self._config.control_period_s + float(model.opt.timestep)) / 2
        self._inertia, self._acceleration, self._off = np.zeros(model.nv), np.zeros(model.nv), np.zeros(6)
        self._q_target = self._q.copy()
        self._hold(self._q_target)

    # -- Robot ----------------------------------------------------------------------------------------------------

    def observe(self) -> RobotState:
        """The latest measured state."""
        q = self._q.copy()
        return RobotState(
            time_s=float(self._data.time),
            q=q,
            qd=self._qd.copy(),
            T_base_tcp=self._kinematics.forward(q),
            opening_m=self._hand.opening_m,
            grip=self._hand.state,
        )

    def move_j(self, q: Array, *, speed: float, acceleration: float) -> JointMove:
        """See :class:`twin.robot.Robot`. Raises MotionRefused before anything moves, RobotError when it gets stuck."""
        target = np.array(q, dtype=np.float64)
        self._check_joint_move(target, speed, acceleration)
        path = JointPath(q_start=self._q_target, q_end=target, speed=speed, acceleration=acceleration)
        for fraction in np.linspace(0.0, 1.0, 20):
            self._check_height(self._kinematics.forward(path.q_start + fraction * (target - path.q_start)))
        s, ds, dds = sample(path.profile, self._config.control_period_s)
        self._follow(path.q_start + path.direction * s, path.direction * ds, path.direction * dds, target)
        return JointMove(q=target, speed=speed, acceleration=acceleration, duration_s=path.duration_s)

    def move_l(self, T_base_tcp: Array, *, speed: float, acceleration: float) -> LinearMove:
        """See :class:`twin.robot.Robot`. Raises MotionRefused before anything moves, RobotError when it gets stuck."""
        target = np.array(T_base_tcp, dtype=np.float64)
        self._check_linear_move(target, speed, acceleration)
        path = LinearPath(
            T_base_start=self._kinematics.forward(self._q_target),
            T_base_end=target,
            speed=speed,
            acceleration=acceleration,
        )
        profile = path.profile
        if profile.length > 0.0:
            spline = self._joint_spline(path)
            s, ds, dds = sample(profile, self._config.control_period_s) / profile.length
            slope, bend = spline(s[:, 0], 1), spline(s[:, 0], 2)
            self._follow(spline(s[:, 0]), slope * ds, bend * ds**2 + slope * dds, spline(1.0))
        return LinearMove(T_base_tcp=target, speed=speed, acceleration=acceleration, duration_s=profile.duration_s)

    def grip(self, opening_m: float, *, force_n: float, speed: float) -> RobotState:
        """See :class:`twin.robot.Robot`. Raises MotionRefused outside the hand's ranges."""
        self._hand.go(opening_m, force_n=force_n, speed=speed)
        travel_s = abs(opening_m - self._hand.opening_m) / speed
        rest_s = waited_s = 0.0
        while rest_s < self._config.grip_rest_s:
            if waited_s > travel_s + self._config.grip_limit_s:
                raise RobotError(
                    f"the fingers did not come to rest within {self._config.grip_limit_s} s after being sent to "
                    f"{1e3 * opening_m:.2f} mm; they are at {1e3 * self._hand.opening_m:.2f} mm"
                )
            self._period()
            waited_s += self._config.control_period_s
            rest_s = rest_s + self._config.control_period_s if self._hand.at_rest else 0.0
        self._check_finite()
        return self.observe()

    def stop(self) -> None:
        """Stop all motion now: the arm holds where it is, and so do fingers that are not gripping anything."""
        self._q_target = self._q.copy()
        self._hold(self._q_target)
        self._hand.stop()

    def wait(self, duration_s: float) -> None:
        """Let simulated time pass while the robot holds still."""
        for _ in range(round(duration_s / self._config.control_period_s)):
            self._period()

    # -- motion ---------------------------------------------------------------------------------------------------

    def _follow(self, q: Array, qd: Array, qdd: Array, q_end: Array) -> None:
        """Run through the set points, one row (6,) a control period, and settle at ``q_end`` (6,)."""
        h = self._hold_s
        rows = np.stack([q - h * qd, qd - h * qdd, qdd], axis=1)
        for inputs, target in zip(rows, q, strict=True):
            self._command(inputs)
            self._period()
            self._check_tracking(target)
        self._q_target = q_end.copy()
        self._hold(q_end)
        waited_s = 0.0
        while not self._settled(q_end):
            if waited_s > self._config.settle_limit_s:
                error = np.abs(self._q - q_end).max()
                self.stop()
                raise RobotError(
                    f"the arm did not settle within {self._config.settle_limit_s} s: a joint is still {error:.2e} rad "
                    "away; something is in its way"
                )
            self._period()
            waited_s += self._config.control_period_s
        self._check_finite()

    def _hold(self, q: Array) -> None:
        """Set points of the servos that hold the arm at ``q`` (6,)."""
        self._command(np.stack([q, np.zeros(6), np.zeros(6)]))

    def _command(self, inputs: Array) -> None:
        """Give the servos angles, speeds and accelerations (3, 6); what torque the last need is fed forward.

        Servos hold their set points for a whole period and follow them on average: what they get is that of its middle.
        """
        if inputs[2].any():
            self._acceleration[self._dofs] = inputs[2]
            mujoco.mj_mulM(self._model, self._data, self._inertia, self._acceleration)
            inputs[2] = self._inertia[self._dofs]
        self._servos[...] = inputs

    def _period(self) -> None:
        """One control period of the hand's controller and of physics."""
        self._hand.advance(self._config.control_period_s)
        model, data, step, on_step = self._model, self._data, mujoco.mj_step, self.on_step
        if on_step is None:
            step(model, data, self._steps)
            return
        for _ in range(self._steps):
            step(model, data)
            on_step()

    def _joint_spline(self, path: LinearPath) -> CubicSpline:
        """Joint angles over the share of a linear path in [0, 1]; every knot is solved before anything moves."""
        profile = path.profile
        shares = np.linspace(0.0, 1.0, max(4, int(np.ceil(profile.length / self._config.knot_spacing_m)) + 1))
        knots = [self._q_target]
        for share in shares[1:]:
            T_base_tcp = path.at_share(float(share))
            self._check_height(T_base_tcp)
            try:
                ahead = 2 * knots[-1] - knots[-2] if len(knots) > 1 else knots[-1]
                knots.append(self._kinematics.refine(T_base_tcp, ahead))
            except IkError as error:
                raise MotionRefused(f"linear move refused: {error}") from error
        spline = CubicSpline(shares, knots)
        fastest = np.abs(spline(shares, 1)).max(axis=0) * profile.peak_speed / profile.length
        if (fastest > robot.SPEED_LIMIT_RAD_S).any():
            raise MotionRefused(
                f"linear move refused: it needs joint speeds of {fastest.round(2)} rad/s, the limits are "
                f"{np.round(robot.SPEED_LIMIT_RAD_S, 2)}; move slower or further from a singularity"
            )
        return spline

    # -- checks ---------------------------------------------------------------------------------------------------

    def _settled(self, q_end: Array) -> bool:
        error = np.abs(self._q - q_end).max()
        speed = np.abs(self._qd).max()
        return bool(error < self._config.settle_error and speed < self._config.settle_speed)

    def _check_tracking(self, q: Array) -> None:
        off = np.subtract(self._q, q, out=self._off)
        if not np.abs(off, out=off).max() <= self._config.tracking_limit:
            self.stop()
            raise RobotError(
                f"protective stop: joints are {off.round(3)} rad off their path, more than "
                f"{self._config.tracking_limit} rad; something is in the arm's way"
            )

    def _check_finite(self) -> None:
        if not np.isfinite(self._data.qpos).all():
            raise RobotError(f"the simulation diverged at {self._data.time:.3f} s: joint positions are not finite")

    def _check_joint_move(self, q: Array, speed: float, acceleration: float) -> None:
        if q.shape != (6,) or not np.isfinite(q).all():
            raise MotionRefused(f"joint target {q} refused: it must be 6 finite angles in rad")
        low, high = self._kinematics.joint_limits
        if (q < low).any() or (q > high).any():
            raise MotionRefused(f"joint target {q.round(4)} rad refused: limits are {low.round(4)} to {high.round(4)}")
        _check_rates("joint", speed, robot.SPEED_LIMIT_RAD_S[0], acceleration, self._config.max_joint_acceleration)

    def _check_linear_move(self, T_base_tcp: Array, speed: float, acceleration: float) -> None:
        R = T_base_tcp[:3, :3] if T_base_tcp.shape == (4, 4) else np.full((3, 3), np.nan)
        if not np.isfinite(T_base_tcp).all() or not np.allclose(R @ R.T, np.eye(3), atol=1e-6):
            raise MotionRefused(f"tool target refused: it is no finite rigid transform:\n{T_base_tcp}")
        self._check_height(T_base_tcp)
        _check_rates("tool", speed, self._config.max_tool_speed, acceleration, self._config.max_tool_acceleration)

    def _check_height(self, T_base_tcp: Array) -> None:
        z = float(T_base_tcp[2, 3])
        if z < self._config.min_tcp_z_m:
            raise MotionRefused(
                f"move refused: it would bring the TCP to z = {1e3 * z:.2f} mm, below the table at "
                f"{1e3 * self._config.min_tcp_z_m:.2f} mm"
            )


def _run(indices: Array) -> slice:
    """The slice of an array that indices following each other stand for; a slice's view is never made again."""
    first, count = int(indices.flat[0]), indices.size
    if not np.array_equal(indices.ravel(), np.arange(first, first + count)):
        raise ValueError(f"the arm's entries {indices.ravel().tolist()} do not follow each other in the model")
    return slice(first, first + count)


def _check_rates(what: str, speed: float, max_speed: float, acceleration: float, max_acceleration: float) -> None:
    if not 0 < speed <= max_speed or not 0 < acceleration <= max_acceleration:
        raise MotionRefused(
            f"{what} speed {speed} and acceleration {acceleration} refused: they must be above 0 and at most "
            f"{max_speed:.3f} and {max_acceleration:.3f}"
        )
