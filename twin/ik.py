"""Inverse kinematics of the arm: the closed form picks the branch, mink brings the TCP exactly onto the pose.

Frame ``base`` is the arm model's world. The closed form knows the nominal arm; mink works on the model itself, so a
calibrated arm is solved exactly too.
"""

from __future__ import annotations

from dataclasses import dataclass

import mink
import mujoco
import numpy as np

from cad.gripper import T_FLANGE_TCP
from cad.robot import JOINT_NAMES, forward_kinematics, inverse_kinematics
from cad.spatial import Array, inverse, rotation_angle, rotvec_from_rotation
from twin.robot import TwinError

TCP_SITE, FLANGE_SITE = "tcp", "flange"
BRANCH_WEIGHTS = np.array([10.0, 10.0, 10.0, 3.0, 3.0, 1.0])
"""What a radian of each joint counts for when the nearest branch is chosen: big links outweigh a turn of the wrist."""


NOMINAL_TOLERANCE_M = 0.03
"""A calibrated arm's flange lies at most this far from the nominal one's; real ones differ by some millimetres."""


class IkError(TwinError):
    """A tool pose that no joint vector within the limits reaches; the message holds the pose and the residual."""


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """Tolerances of a solution, in metres and radians, and how long to try."""

    position_tolerance_m: float = 1e-7
    angle_tolerance: float = 1e-6
    max_iterations: int = 40
    joint_window: float = np.pi
    """Joints stay this close to home on either side, so that no joint winds up and each pose has one wrist turn."""
    lm_damping: float = 1.0

    def __post_init__(self) -> None:
        if not (self.position_tolerance_m > 0 and self.angle_tolerance > 0 and self.max_iterations > 0):
            raise ValueError(
                f"tolerances {self.position_tolerance_m} m, {self.angle_tolerance} rad and max_iterations "
                f"{self.max_iterations} must be positive"
            )


class ArmIk:
    """Forward and inverse kinematics of the TCP on the arm-only model.

    ``model`` holds the arm's six joints by name, nominal or calibrated, and the sites ``flange`` and ``tcp``;
    ``q_home`` (6,) rad says which branch is preferred. Raises IkError for a model of another arm or tool.
    """

    def __init__(self, model: mujoco.MjModel, q_home: Array, config: IkConfig | None = None) -> None:
        self._config = config or IkConfig()
        self._q_home = np.array(q_home, dtype=np.float64)
        joints = [model.joint(name) for name in JOINT_NAMES]
        self._qpos = np.array([j.qposadr[0] for j in joints])
        self._dofs = np.array([j.dofadr[0] for j in joints])
        for joint, home in zip(joints, self._q_home, strict=True):
            window = self._config.joint_window
            model.jnt_range[joint.id] = np.clip(joint.range, home - window, home + window)
        self._lower, self._upper = np.array([model.jnt_range[j.id] for j in joints]).T
        self._configuration = mink.Configuration(model)
        self._task = mink.FrameTask(
            TCP_SITE, "site", position_cost=1.0, orientation_cost=0.1, lm_damping=self._config.lm_damping
        )
        self._limits = [mink.ConfigurationLimit(model)]
        T_base_flange = self._frame(FLANGE_SITE, self._q_home)
        off_m = np.linalg.norm((T_base_flange - forward_kinematics(self._q_home)[6])[:3, 3])
        if off_m > NOMINAL_TOLERANCE_M:
            raise IkError(
                f"the arm model's flange is {1e3 * off_m:.1f} mm from where the nominal arm's is: the model is of "
                "another arm or its base is not at the origin"
            )
        T_flange_tcp = inverse(T_base_flange) @ self.forward(self._q_home)
        if not np.allclose(T_flange_tcp, T_FLANGE_TCP, atol=1e-6):
            raise IkError(
                f"the arm model's TCP lies at {T_flange_tcp[:3, 3]} m in the flange frame, the gripper's at "
                f"{T_FLANGE_TCP[:3, 3]} m: the model is of another tool"
            )

    @property
    def joint_limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits (6,) rad that solutions keep."""
        return self._lower.copy(), self._upper.copy()

    def forward(self, q: Array) -> Array:
        """``T_base_tcp`` (4, 4) at joint angles ``q`` (6,) rad."""
        return self._frame(TCP_SITE, q)

    def jacobian(self, q: Array) -> Array:
        """Jacobian (6, 6) of the TCP in ``base``: rows are linear (m/rad), then angular velocity."""
        self._set(q)
        model, data = self._configuration.model, self._configuration.data
        J = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], model.site(TCP_SITE).id)
        return J[:, self._dofs]

    def solve(self, T_base_tcp: Array, q_near: Array | None = None) -> Array:
        """Joint angles (6,) rad that bring the TCP to ``T_base_tcp`` (4, 4).

        The closed-form branch nearest ``q_near`` (default: home) starts the iteration. Raises IkError.
        """
        if not np.isfinite(T_base_tcp).all():
            raise IkError(f"the asked tool pose is not finite: {np.array2string(T_base_tcp, precision=4)}")
        near = self._q_home if q_near is None else np.asarray(q_near, dtype=np.float64)
        branches = inverse_kinematics(T_base_tcp @ inverse(T_FLANGE_TCP), q6_singular=float(near[5]))
        branches = self._lower + (branches - self._lower) % (2 * np.pi)
        branches = branches[(branches <= self._upper).all(axis=1)]
        if not len(branches):
            raise IkError(f"{_describe(T_base_tcp)} is out of the arm's reach: no closed-form branch reaches it")
        return self.refine(T_base_tcp, branches[(np.abs(branches - near) @ BRANCH_WEIGHTS).argmin()])

    def refine(self, T_base_tcp: Array, q_start: Array) -> Array:
        """Joint angles (6,) rad at ``T_base_tcp`` by iterating from ``q_start`` (6,). Raises IkError."""
        self._set(q_start)
        self._task.set_target(mink.SE3.from_matrix(T_base_tcp))
        distance, angle = self._residual(T_base_tcp)
        for _ in range(self._config.max_iterations):
            if distance <= self._config.position_tolerance_m and angle <= self._config.angle_tolerance:
                return self._configuration.data.qpos[self._qpos].copy()
            try:
                velocity = mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", limits=self._limits)
            except mink.NoSolutionFound as error:
                raise IkError(f"no joint step leads to {_describe(T_base_tcp)}: {error}") from error
            self._configuration.integrate_inplace(velocity, 1.0)
            distance, angle = self._residual(T_base_tcp)
        raise IkError(
            f"{_describe(T_base_tcp)} was not reached in {self._config.max_iterations} iterations: "
            f"{distance * 1e3:.4f} mm and {np.degrees(angle):.4f} degrees are left"
        )

    def _frame(self, site: str, q: Array) -> Array:
        self._set(q)
        return self._configuration.get_transform_frame_to_world(site, "site").as_matrix()

    def _set(self, q: Array) -> None:
        qpos = self._configuration.data.qpos.copy()
        qpos[self._qpos] = q
        self._configuration.update(qpos)

    def _residual(self, T_base_tcp: Array) -> tuple[float, float]:
        T = self._configuration.get_transform_frame_to_world(TCP_SITE, "site").as_matrix()
        return float(np.linalg.norm(T[:3, 3] - T_base_tcp[:3, 3])), rotation_angle(T[:3, :3], T_base_tcp[:3, :3])


def _describe(T_base_tcp: Array) -> str:
    x, y, z = T_base_tcp[:3, 3]
    turn = np.degrees(rotvec_from_rotation(T_base_tcp[:3, :3]))
    return f"tool pose at ({x:.4f}, {y:.4f}, {z:.4f}) m, rotation vector {turn.round(2)} degrees"
