"""The simulated Hand-E: speed and force as commanded, and object detection that needs an object."""

import numpy as np
import pytest

from cad import gripper, robot
from cad.spatial import quat_wxyz_from_rotation
from scenes.arm import FINGER_JOINTS, arm_inputs
from scenes.contacts import BOX, PART, Touches, make_collision
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm
from twin.robot import GripState, MotionRefused
from twin.sim_robot import SimRobot

CELL = CellConfig()
T_BASE_TCP = robot.forward_kinematics(CELL.home_q)[6] @ gripper.T_FLANGE_TCP
WIDTH_M = 0.008
WALL_M = 0.030
"""Opening of the fingers whose outer faces touch the walls."""


def add_box(spec, name, centre, half, kind):
    """A box at ``centre`` (3,) m in the tool's frame at home; a part floats freely, anything else is fixed."""
    T = T_BASE_TCP
    body = spec.worldbody.add_body(
        name=name, pos=T[:3, :3] @ centre + T[:3, 3], quat=quat_wxyz_from_rotation(T[:3, :3]), gravcomp=1.0
    )
    if kind is Touches.PART:
        body.add_freejoint(name=name)
    geom = body.add_geom(name=name, type=BOX, size=half)
    make_collision(geom, kind, PART)
    geom.mass = 0.0003


def make_robot(*, part=False, walls=False, opening=0.02):
    spec = build_arm(CELL)
    if part:
        add_box(spec, "part", [0.0, 0.0, -0.004], [WIDTH_M / 2, 0.003, 0.003], Touches.PART)
    if walls:
        outer = WALL_M / 2 + gripper.PAD_THICKNESS_M
        for i, side in enumerate((1.0, -1.0)):
            add_box(spec, f"wall_{i}", [side * (outer + 0.005), 0.0, -0.003], [0.005, 0.01, 0.002], Touches.CELL)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:6] = data.ctrl[arm_inputs(model)[0]] = CELL.home_q
    for name in FINGER_JOINTS:
        data.joint(name).qpos[0] = opening / 2
    mujoco.mj_forward(model, data)
    return SimRobot(model, data, CELL), model, data


def pad_forces(model, data):
    """Normal force (N) on each pad, left and right."""
    total, wrench = {"pad_left": 0.0, "pad_right": 0.0}, np.zeros(6)
    for i, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, i, wrench)
        for geom in (contact.geom1, contact.geom2):
            if model.geom(geom).name in total:
                total[model.geom(geom).name] += wrench[0]
    return np.array(list(total.values()))


@pytest.mark.parametrize("force", [20.0, 60.0, 130.0])
@pytest.mark.parametrize("beyond_m", [0.0004, 0.001, 0.008])
def test_each_pad_presses_with_the_commanded_force(force, beyond_m):
    """However little the commanded opening lies below the part's width."""
    hand, model, data = make_robot(part=True)
    state = hand.grip(WIDTH_M - beyond_m, force_n=force, speed=0.150)
    np.testing.assert_allclose(pad_forces(model, data), force, rtol=0.02)
    assert state.grip is GripState.CONTACT_CLOSING
    assert state.opening_m == pytest.approx(WIDTH_M, abs=0.1e-3)


@pytest.mark.parametrize(("speed", "force"), [(0.020, 20.0), (0.060, 130.0), (0.150, 20.0), (0.150, 130.0)])
@pytest.mark.parametrize(("start", "end"), [(0.05, 0.0), (0.0, 0.05)])
def test_fingers_move_at_the_commanded_speed(speed, force, start, end):
    hand, _, data = make_robot(opening=start)
    times, openings = [], []
    hand.on_step = lambda: (times.append(data.time), openings.append(data.qpos[6:8].sum()))
    state = hand.grip(end, force_n=force, speed=speed)
    assert state.grip is GripState.AT_POSITION and state.opening_m == pytest.approx(end, abs=0.05e-3)
    middle = np.abs(np.array(openings) - 0.025) < 0.020
    assert np.abs(np.polyfit(np.array(times)[middle], np.array(openings)[middle], 1)[0]) == pytest.approx(
        speed, rel=0.01
    )


def test_closing_on_nothing_is_no_contact():
    hand, _, _ = make_robot()
    seen = set()
    hand.on_step = lambda: seen.add(hand.observe().grip)
    assert hand.grip(0.0, force_n=20.0, speed=0.1).grip is GripState.AT_POSITION
    assert seen == {GripState.MOVING, GripState.AT_POSITION}


def test_fingers_short_of_their_command_that_touch_nothing_are_moving():
    hand, _, data = make_robot()
    hand.grip(0.02, force_n=20.0, speed=0.1)
    for name in FINGER_JOINTS:
        data.joint(name).qpos[0] = 0.012
    assert hand.observe().grip is GripState.MOVING


def test_contact_is_told_only_once_the_part_stops_the_fingers():
    hand, model, data = make_robot(part=True)
    seen = []
    hand.on_step = lambda: seen.append((hand.observe().grip, pad_forces(model, data).max(), data.qpos[6:8].sum()))
    hand.grip(0.0, force_n=20.0, speed=0.05)
    contact = [force for grip, force, _ in seen if grip is GripState.CONTACT_CLOSING]
    assert len(contact) > 20 and min(contact) > 1.0
    assert all(grip is GripState.MOVING for grip, _, opening in seen if opening > WIDTH_M + 0.1e-3)


def test_a_part_thinner_than_the_hand_can_tell_is_at_position():
    """As Robotiq's manual warns: fingers that reach the commanded opening report no object."""
    hand, model, data = make_robot(part=True)
    assert hand.grip(WIDTH_M - 0.1e-3, force_n=20.0, speed=0.05).grip is GripState.AT_POSITION
    assert pad_forces(model, data).min() > 0.1


def test_opening_against_something_is_contact_while_opening():
    hand, _, _ = make_robot(walls=True)
    state = hand.grip(0.045, force_n=40.0, speed=0.05)
    assert state.grip is GripState.CONTACT_OPENING
    assert state.opening_m == pytest.approx(WALL_M, abs=0.1e-3)
    assert hand.grip(0.010, force_n=40.0, speed=0.05).grip is GripState.AT_POSITION


def test_a_part_lost_from_the_grip_is_noticed_and_the_fingers_go_on():
    hand, _, data = make_robot(part=True)
    assert hand.grip(0.002, force_n=20.0, speed=0.03).grip is GripState.CONTACT_CLOSING
    hand.wait(0.1)
    assert hand.observe().grip is GripState.CONTACT_CLOSING
    data.joint("part").qpos[:3] += [0.0, 0.0, 0.5]
    hand.wait(0.02)
    assert hand.observe().opening_m > WIDTH_M - 0.002  # it lets fly only until the next control period
    speeds = []
    hand.on_step = lambda: speeds.append(np.abs(data.qvel[6:8]).sum())
    assert hand.observe().grip is GripState.MOVING
    hand.wait(0.3)
    assert hand.observe().grip is GripState.AT_POSITION and hand.observe().opening_m == pytest.approx(0.002, abs=1e-4)
    assert max(speeds) < 0.05


@pytest.mark.parametrize("force", gripper.FORCE_RANGE_N)
def test_fingers_whose_part_is_lost_do_not_pass_their_command(force):
    hand, _, data = make_robot(part=True)
    hand.grip(WIDTH_M - 0.0005, force_n=force, speed=0.03)
    data.joint("part").qpos[:3] += [0.0, 0.0, 0.5]
    hand.wait(0.4)
    assert hand.observe().grip is GripState.AT_POSITION
    assert hand.observe().opening_m == pytest.approx(WIDTH_M - 0.0005, abs=0.1e-3)


def test_a_grip_that_is_tightened_never_lets_go():
    hand, model, data = make_robot(part=True)
    hand.grip(0.002, force_n=20.0, speed=0.03)
    forces = []
    hand.on_step = lambda: forces.append(pad_forces(model, data).min())
    hand.grip(0.001, force_n=60.0, speed=0.03)
    assert min(forces) > 15.0 and forces[-1] == pytest.approx(60.0, rel=0.02)


def test_stop_halts_moving_fingers_and_keeps_a_grip():
    hand, model, data = make_robot(part=True)
    hand.grip(0.002, force_n=60.0, speed=0.03)
    hand.stop()
    hand.wait(0.2)
    np.testing.assert_allclose(pad_forces(model, data), 60.0, rtol=0.02)
    assert hand.observe().grip is GripState.CONTACT_CLOSING
    hand.grip(0.04, force_n=20.0, speed=0.15)
    for name in FINGER_JOINTS:
        data.joint(name).qpos[0] = 0.012
    hand.stop()
    hand.wait(0.1)
    assert hand.observe().opening_m == pytest.approx(0.024, abs=0.1e-3)


@pytest.mark.parametrize(("opening", "force", "speed"), [(0.06, 20, 0.1), (0.01, 19, 0.1), (0.01, 20, 0.16)])
def test_commands_outside_the_data_sheet_are_refused(opening, force, speed):
    hand, _, data = make_robot()
    with pytest.raises(MotionRefused, match="Hand-E's range"):
        hand.grip(opening, force_n=force, speed=speed)
    assert data.time == 0.0
