import subprocess
import sys

import numpy as np
import pytest

from cad.gripper import T_FLANGE_TCP
from cad.robot import SPEED_LIMIT_RAD_S, forward_kinematics
from cad.spatial import rotation_angle
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_workcell
from twin.attempts import ControllerConfig
from twin.profiles import JointPath, LinearPath, ProfileError
from twin.robot import GripState, MotionRefused, RobotError, top_down
from twin.sim_robot import SimRobot, SimRobotConfig

CELL = CellConfig()
MODEL = build_workcell(CELL, []).compile()
START = top_down(0.45, 0.05, 0.06, 0.4)


def make_robot(model=MODEL, **kwargs):
    data = mujoco.MjData(model)
    for name, q in zip(
        ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"), CELL.home_q, strict=True
    ):
        data.joint(f"{name}_joint").qpos[0] = q
    for name in ("hande_left", "hande_right"):
        data.joint(name).qpos[0] = 0.005
    mujoco.mj_forward(model, data)
    return SimRobot(model, data, CELL, **kwargs), data


def tcp(data):
    site = data.site("tcp")
    return site.xpos.copy(), site.xmat.reshape(3, 3).copy()


def test_static_tcp_error_is_below_a_micrometre():
    robot, data = make_robot()
    q = robot.ik.solve(START)
    sent = robot.move_j(q, speed=1.5, acceleration=5.0)
    np.testing.assert_array_equal(sent.q, q)
    robot.wait(0.3)
    position, R = tcp(data)
    assert np.linalg.norm(position - START[:3, 3]) < 1e-6
    assert rotation_angle(R, START[:3, :3]) < 1e-5


def test_linear_move_keeps_to_the_line_and_to_its_speed():
    robot, data = make_robot()
    robot.move_j(robot.ik.solve(START), speed=1.5, acceleration=5.0)
    end = top_down(0.48, -0.04, 0.012, 1.2)
    path = LinearPath(T_base_start=START, T_base_end=end, speed=0.25, acceleration=1.2)
    trace, speeds = [], []
    robot.on_step = lambda: (trace.append(tcp(data)[0]), speeds.append(robot.observe().qd))
    sent = robot.move_l(end, speed=0.25, acceleration=1.2)
    assert sent.duration_s == pytest.approx(path.duration_s)
    line = (end - START)[:3, 3] / np.linalg.norm((end - START)[:3, 3])
    offsets = np.array(trace) - START[:3, 3]
    off = np.linalg.norm(offsets - np.outer(offsets @ line, line), axis=1)
    assert off.max() < 0.05e-3
    times = MODEL.opt.timestep * np.arange(1, len(trace) + 1)
    lag = [np.linalg.norm(p - path.at(t)[:3, 3]) for t, p in zip(times, trace, strict=True)]
    assert max(lag) < 0.2e-3
    assert (np.abs(speeds) <= SPEED_LIMIT_RAD_S).all()
    assert np.linalg.norm(trace[-1] - end[:3, 3]) < 20e-6


def test_joint_move_keeps_to_its_profile_at_the_speed_of_a_pick():
    robot, data = make_robot()
    config, q = ControllerConfig(), robot.ik.solve(START)
    path = JointPath(
        q_start=np.array(CELL.home_q), q_end=q, speed=config.joint_speed, acceleration=config.joint_acceleration
    )
    trace = []
    robot.on_step = lambda: trace.append((data.time, data.qpos[:6].copy()))
    robot.move_j(q, speed=config.joint_speed, acceleration=config.joint_acceleration)
    ends = trace[3::4]  # where a control period of four steps ends
    joints = np.array([np.abs(actual - path.at(time)[0]).max() for time, actual in ends])
    tools = [(forward_kinematics(a)[6] - forward_kinematics(path.at(t)[0])[6])[:3, 3] for t, a in ends]
    assert joints.max() < 3e-4
    assert np.linalg.norm(tools, axis=1).max() < 0.3e-3
    assert np.abs(np.diff([a for _, a in ends], axis=0)).max() / 0.002 > 0.7 * config.joint_speed


def test_observation_is_what_nominal_kinematics_make_of_the_encoders():
    robot, data = make_robot()
    state = robot.observe()
    np.testing.assert_allclose(state.q, CELL.home_q)
    np.testing.assert_allclose(state.T_base_tcp, forward_kinematics(state.q)[6] @ T_FLANGE_TCP, atol=1e-9)
    assert state.time_s == data.time and state.opening_m == pytest.approx(0.01)


@pytest.mark.parametrize(("opening", "force", "speed"), [(0.03, 20.0, 0.1), (0.0, 60.0, 0.02), (0.05, 130.0, 0.15)])
def test_grip_reaches_its_opening_at_the_commanded_speed(opening, force, speed):
    robot, data = make_robot()
    trace = []
    robot.on_step = lambda: trace.append(robot.observe().opening_m)
    state = robot.grip(opening, force_n=force, speed=speed)
    assert state.grip is GripState.AT_POSITION
    assert state.opening_m == pytest.approx(opening, abs=0.05e-3)
    reached = np.abs(np.gradient(np.array(trace), MODEL.opt.timestep))
    assert np.median(reached[reached > 0.5 * speed]) == pytest.approx(speed, rel=0.05)
    assert abs(data.actuator("hande").force[0]) <= force + 1e-9


def test_every_physics_step_is_told():
    robot, data = make_robot()
    times = []
    robot.on_step = lambda: times.append(data.time)
    robot.wait(0.02)
    np.testing.assert_allclose(np.diff(times), MODEL.opt.timestep)
    assert len(times) == 40


@pytest.mark.parametrize(
    ("move", "reason"),
    [
        (lambda r: r.move_j(np.full(6, np.nan), speed=1.0, acceleration=1.0), "finite"),
        (lambda r: r.move_j(np.zeros(5), speed=1.0, acceleration=1.0), "6 finite"),
        (lambda r: r.move_j(np.array([6.4, 0, 0, 0, 0, 0]), speed=1.0, acceleration=1.0), "limits"),
        (lambda r: r.move_j(np.array([0.0, 0.3, 0, 0, 0, 0]), speed=1.0, acceleration=1.0), "below the table"),
        (lambda r: r.move_j(np.array(CELL.home_q), speed=4.0, acceleration=1.0), "speed 4.0"),
        (lambda r: r.move_l(top_down(0.45, 0.0, -0.001, 0.0), speed=0.1, acceleration=1.0), "below the table"),
        (lambda r: r.move_l(top_down(1.2, 0.0, 0.1, 0.0), speed=0.1, acceleration=1.0), "tool pose at"),
        (lambda r: r.move_l(2 * np.eye(4), speed=0.1, acceleration=1.0), "rigid"),
        (lambda r: r.move_l(START, speed=0.0, acceleration=1.0), "speed 0.0"),
        (lambda r: r.grip(0.06, force_n=20.0, speed=0.1), "opening 0.06"),
        (lambda r: r.grip(0.01, force_n=300.0, speed=0.1), "force 300"),
        (lambda r: r.grip(0.01, force_n=20.0, speed=0.5), "speed 0.5"),
    ],
)
def test_nonsense_is_refused_before_anything_moves(move, reason):
    robot, data = make_robot()
    before = data.qpos.copy()
    with pytest.raises(MotionRefused, match=reason):
        move(robot)
    assert data.time == 0.0
    np.testing.assert_array_equal(data.qpos, before)


def test_something_in_the_way_is_a_protective_stop():
    spec = build_workcell(CELL, [])
    spec.worldbody.add_geom(
        name="wall",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.02, 0.3, 0.3],
        pos=[0.55, 0.0, 0.3],
        contype=1,
        conaffinity=6,
    )
    robot, _ = make_robot(spec.compile(), config=SimRobotConfig(tracking_limit=0.01))
    robot.move_j(robot.ik.solve(START), speed=1.5, acceleration=5.0)
    with pytest.raises(RobotError, match=r"in the arm's way|in its way"):
        robot.move_l(top_down(0.65, 0.05, 0.06, 0.4), speed=0.3, acceleration=2.0)


def test_stop_holds_the_position():
    robot, _ = make_robot()
    robot.stop()
    before = robot.observe()
    robot.wait(0.1)
    np.testing.assert_allclose(robot.observe().q, before.q, atol=1e-7)


def test_control_period_must_fit_the_time_step():
    with pytest.raises(ProfileError, match=r"0\.0012 s.*0\.0005 s"):
        make_robot(config=SimRobotConfig(control_period_s=0.0012))


def test_it_needs_no_torch():
    code = "import sys, twin.sim_robot, twin.controller; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
