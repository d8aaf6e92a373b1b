"""How well contacts hold up on one part: sinking and drifting at rest, squeeze, creep and slip in the grip.

All figures come from the whole cell with the controller's own force and speeds, and with sleeping switched off: a part
that is put to sleep does not drift whatever its contacts are worth.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cad.parts import Part
from cad.robot import JOINT_NAMES
from cad.spatial import Array, transform
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_board_scene, build_workcell, part_body, set_parts
from twin.attempts import ControllerConfig
from twin.grasp_config import Grasp, GraspError
from twin.grasps import read_grasps
from twin.sim_robot import SimRobot


@dataclass(frozen=True, kw_only=True)
class ContactStudyConfig:
    """How long to look, in seconds, how far to carry, in metres, and the force and speeds of picks."""

    timestep_s: float = CellConfig.timestep_s
    settle_s: float = 0.5
    rest_s: float = 2.0
    hold_s: float = 5.0
    carry_m: float = 0.100
    lift_m: float = 0.060
    pick: ControllerConfig = field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        for name in ("timestep_s", "settle_s", "rest_s", "hold_s", "carry_m", "lift_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} {getattr(self, name)} must be positive")


@dataclass(frozen=True, kw_only=True)
class RestFigures:
    """The worst of a part's stable poses: how deep it sinks into the board in m, how fast it drifts in m/s."""

    penetration_m: float
    drift_m_s: float


@dataclass(frozen=True, kw_only=True)
class GripFigures:
    """One grasp: depth of both pads in the part, and motion of the part in the hand, in m.

    ``creep_m`` is over ``hold_s`` of standing still after the lift, ``slip_m`` over the carry.
    """

    squeeze_m: float
    creep_m: float
    slip_m: float
    contacts: int


def study_rest(part: Part, config: ContactStudyConfig) -> RestFigures:
    """Lay the part on the board in each of its stable poses and watch."""
    cell = CellConfig(timestep_s=config.timestep_s, parts_dir=part.folder.parent)
    model = _awake(build_board_scene(cell, [part.name]))
    data = mujoco.MjData(model)
    body = model.body(part_body(0)).id
    depths, speeds = [], []
    for pose in part.stable_poses:
        mujoco.mj_resetData(model, data)
        set_parts(model, data, (cell.T_world_board @ pose.T_table_part)[None])
        _step(model, data, config.settle_s)
        before = data.xipos[body].copy()
        _step(model, data, config.rest_s)
        depths.append(max(0.0, float(-data.contact.dist.min(initial=0.0))))
        speeds.append(float(np.linalg.norm(data.xipos[body] - before)) / config.rest_s)
    return RestFigures(penetration_m=max(depths), drift_m_s=max(speeds))


def study_grip(part: Part, grasp: Grasp, config: ContactStudyConfig) -> GripFigures:
    """Take the part, lift it, hold it, and carry it across the board. Raises RobotError when the arm is stopped."""
    cell = CellConfig(timestep_s=config.timestep_s, parts_dir=part.folder.parent)
    model = _awake(build_workcell(cell, [part.name]))
    data = mujoco.MjData(model)
    T_world_part = cell.T_world_board @ transform(t=[-config.carry_m / 2, 0.0, 0.0])
    T_world_part = T_world_part @ part.stable_poses[grasp.stable_pose].T_table_part
    set_parts(model, data, T_world_part[None])
    for name, q in zip(JOINT_NAMES, cell.home_q, strict=True):
        data.joint(name).qpos[0] = q
    mujoco.mj_forward(model, data)
    robot, pick, body = SimRobot(model, data, cell), config.pick, model.body(part_body(0)).id
    T_base_tcp = T_world_part @ grasp.T_part_tcp
    up, across = np.array([0.0, 0.0, config.lift_m]), cell.T_world_board[:3, 0] * config.carry_m
    robot.grip(grasp.opening_m, force_n=pick.grip_force_n, speed=pick.open_speed)
    above = robot.ik.solve(transform(t=up) @ T_base_tcp)
    robot.move_j(above, speed=pick.joint_speed, acceleration=pick.joint_acceleration)
    robot.move_l(T_base_tcp, speed=pick.linear_speed, acceleration=pick.linear_acceleration)
    closed = max(0.0, grasp.width_m - pick.overclose_m)
    robot.grip(closed, force_n=pick.grip_force_n, speed=pick.grip_speed)
    robot.move_l(transform(t=up) @ T_base_tcp, speed=pick.lift_speed, acceleration=pick.lift_acceleration)
    robot.wait(config.settle_s)
    lifted = _in_hand(model, data, body)
    squeeze, contacts = _pad_depths(model, data), int(data.ncon)
    robot.wait(config.hold_s)
    held = _in_hand(model, data, body)
    robot.move_l(transform(t=up + across) @ T_base_tcp, speed=pick.linear_speed, acceleration=pick.linear_acceleration)
    robot.wait(config.settle_s)
    carried = _in_hand(model, data, body)
    return GripFigures(
        squeeze_m=squeeze,
        creep_m=float(np.linalg.norm(held - lifted)),
        slip_m=float(np.linalg.norm(carried - held)),
        contacts=contacts,
    )


def best_grasp(part: Part) -> Grasp:
    """The grasp that the part's folder ranks first in its most probable stable pose that can be gripped.

    Raises GraspError when the folder holds none.
    """
    for grasps in read_grasps(part):
        if grasps:
            return grasps[0]
    raise GraspError(f"part {part.name!r} cannot be gripped in any of its stable poses")


def _awake(spec: mujoco.MjSpec) -> mujoco.MjModel:
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return spec.compile()


def _step(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))


def _in_hand(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Array:
    """The part's centre of mass (3,) in the frame of the tool."""
    site = model.site("tcp").id
    return data.site_xmat[site].reshape(3, 3).T @ (data.xipos[body] - data.site_xpos[site])


def _pad_depths(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Deepest penetration of the left pad plus that of the right one."""
    pads = [model.geom(name).id for name in ("pad_left", "pad_right")]
    touches = (data.contact.geom[:, :, None] == pads).any(axis=1)
    return sum(float(np.maximum(-data.contact.dist[rows], 0.0).max(initial=0.0)) for rows in touches.T)
