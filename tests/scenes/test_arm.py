"""The compiled arm and hand against the closed form and the published tables, nominal and calibrated."""

import numpy as np
import pytest

from cad import gripper, robot
from cad.robot_calibration import table_from_axes
from cad.spatial import rotation_from_rotvec, transform
from scenes.arm import FORCE_NUMERIC, GRIPPER_ACTUATOR, SPEED_NUMERIC, arm_inputs, hand_inputs
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm, build_workcell


def calibrated_table(seed=0):
    """The table of an arm whose joint axes are off by half a millimetre and two milliradians."""
    rng, axes = np.random.default_rng(seed), robot.forward_kinematics(np.zeros(6)).copy()
    for i in range(1, 6):
        axes[i] = axes[i] @ transform(rotation_from_rotvec(rng.normal(0, 2e-3, 3)), rng.normal(0, 0.5e-3, 3))
    axes[6] = axes[5] @ transform(t=[0.0, 0.0, robot.UR5E.d[5]])
    return table_from_axes(axes)


TABLES = {"nominal": robot.UR5E, "calibrated": calibrated_table()}


@pytest.fixture(scope="module", params=TABLES)
def arm(request):
    return TABLES[request.param], build_arm(CellConfig(arm=TABLES[request.param])).compile()


@pytest.fixture(scope="module")
def nominal():
    return build_arm(CellConfig()).compile()


def flange(model, q):
    data = mujoco.MjData(model)
    data.qpos[:6] = q
    mujoco.mj_kinematics(model, data)
    return data, transform(data.site("flange").xmat.reshape(3, 3), data.site("flange").xpos)


def test_forward_kinematics_are_the_closed_form(arm):
    """Flange and TCP at 1,000 joint vectors over the whole range, to 1e-9 m and rad."""
    table, model = arm
    for q in np.random.default_rng(0).uniform(*robot.JOINT_RANGE_RAD, (1000, 6)):
        data, T = flange(model, q)
        exact = robot.forward_kinematics(q, table)[6]
        np.testing.assert_allclose(T, exact, rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.site("tcp").xpos, (exact @ gripper.T_FLANGE_TCP)[:3, 3], rtol=0, atol=1e-9)


def test_bodies_are_where_the_links_are(arm):
    """Every body in its link's frame, and within millimetres of the nominal arm's however large the table's d are."""
    table, model = arm
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (50, 6)):
        data, _ = flange(model, q)
        for name, T, near in zip(
            robot.BODY_NAMES, robot.link_frames(q, table), robot.forward_kinematics(q), strict=True
        ):
            np.testing.assert_allclose(data.body(name).xpos, T[:3, 3], atol=1e-9)
            np.testing.assert_allclose(data.body(name).xmat.reshape(3, 3), T[:3, :3], atol=1e-9)
            assert np.linalg.norm(data.body(name).xpos - near[:3, 3]) < 0.015


def test_a_calibration_moves_the_whole_cell_s_arm():
    cell = CellConfig(arm=TABLES["calibrated"])
    _, T = flange(build_workcell(cell, []).compile(), cell.home_q)
    np.testing.assert_allclose(T, robot.forward_kinematics(cell.home_q, cell.arm)[6], atol=1e-9)
    apart = np.linalg.norm((T - robot.forward_kinematics(cell.home_q)[6])[:3, 3])
    assert 0.1e-3 < apart < 10e-3


def test_jacobian_of_the_compiled_arm_is_the_closed_form(arm):
    table, model = arm
    for q in np.random.default_rng(2).uniform(-np.pi, np.pi, (20, 6)):
        data = mujoco.MjData(model)
        data.qpos[:6] = q
        mujoco.mj_forward(model, data)
        J = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], model.site("flange").id)
        np.testing.assert_allclose(J[:, :6], robot.jacobian(q, table), atol=1e-9)


def test_masses_and_centres_are_the_published_ones(arm):
    """Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR5e, links 1 to 6."""
    _, model = arm
    published = {
        "ur5e_shoulder": (3.761, (0.0, -0.02561, 0.00193)),
        "ur5e_upper_arm": (8.058, (0.2125, 0.0, 0.11336)),
        "ur5e_forearm": (2.846, (0.15, 0.0, 0.0265)),
        "ur5e_wrist_1": (1.37, (0.0, -0.0018, 0.01634)),
        "ur5e_wrist_2": (1.3, (0.0, 0.0018, 0.01634)),
        "ur5e_wrist_3": (0.365, (0.0, 0.0, -0.001159)),
    }
    for link, (name, (mass, com)) in enumerate(published.items()):
        body = model.body(name)
        assert body.mass[0] == mass
        np.testing.assert_allclose(body.ipos, com, atol=1e-12)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(robot.LINK_INERTIAS[link].moments_kg_m2))
    hand = sum(model.body(name).mass[0] for name in ("hande_base", "hande_left", "hande_right"))
    assert hand == pytest.approx(gripper.HAND_MASS_KG)


def test_joint_limits_are_the_data_sheet_s(nominal):
    """+-360 degrees and 180 degrees/s on every joint; 150 N m on the big joints, 28 N m on the wrists."""
    for name, torque in zip(robot.JOINT_NAMES, (150, 150, 150, 28, 28, 28), strict=True):
        joint, actuator = nominal.joint(name), nominal.actuator(name)
        assert nominal.jnt_limited[joint.id] and actuator.forcelimited[0] and actuator.ctrllimited[0]
        np.testing.assert_allclose(joint.range, np.radians([-360, 360]))
        np.testing.assert_allclose(actuator.forcerange, [-torque, torque])
        np.testing.assert_allclose(actuator.ctrlrange, [*np.radians([[-360, 360], [-180, 180]]), [-torque, torque]])


def test_the_hand_s_limits_are_the_manual_s(nominal):
    """Stroke 50 mm, 20 to 130 N on each finger, 20 to 150 mm/s."""
    actuator = nominal.actuator(GRIPPER_ACTUATOR)
    np.testing.assert_allclose(actuator.ctrlrange, [[0.0, 0.050], [-0.150, 0.150], [-130.0, 130.0]])
    np.testing.assert_allclose(nominal.numeric(FORCE_NUMERIC).data, [20.0, 130.0])
    np.testing.assert_allclose(nominal.numeric(SPEED_NUMERIC).data, [0.020, 0.150])
    for name in ("hande_left", "hande_right"):
        np.testing.assert_allclose(nominal.joint(name).range, [0.0, 0.025])


def test_servos_clamp_speed_and_torque_to_the_limits(nominal):
    """A set point beyond the limits drives no harder than one at the limits."""
    forces = []
    for speed in (np.pi, 50.0):
        data = mujoco.MjData(nominal)
        data.ctrl[arm_inputs(nominal)[1]] = speed
        mujoco.mj_forward(nominal, data)
        forces.append(data.qfrc_actuator[:6].copy())
    np.testing.assert_array_equal(forces[0], forces[1])
    assert (np.abs(forces[0]) <= robot.TORQUE_LIMIT_NM).all() and (forces[0] > 0).all()


def test_a_servo_s_force_is_what_its_inputs_say(nominal):
    data = mujoco.MjData(nominal)
    position, speed, torque = arm_inputs(nominal)
    data.ctrl[position], data.ctrl[speed], data.ctrl[torque] = 1e-4, 1e-3, 2.0
    data.ctrl[hand_inputs(nominal)] = 1e-4, 0.01, 5.0
    mujoco.mj_forward(nominal, data)
    np.testing.assert_allclose(data.qfrc_actuator[:6], [4.8, 4.8, 4.8, 2.6, 2.6, 2.6])
    kp, kv = -nominal.actuator(GRIPPER_ACTUATOR).biasprm[1:3]
    np.testing.assert_allclose(data.qfrc_actuator[6:8], kp * 1e-4 + kv * 0.01 + 5.0)
