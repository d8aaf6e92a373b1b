import numpy as np
import pytest

from cad.gripper import T_FLANGE_TCP
from cad.robot import JOINT_RANGE_RAD, UR5E, forward_kinematics
from cad.robot_calibration import table_from_axes
from cad.spatial import apply, rotation_angle, rotation_from_rotvec, transform
from scenes.workcell import CellConfig, build_arm
from twin.ik import ArmIk, IkError
from twin.robot import top_down

CELL = CellConfig()


@pytest.fixture(scope="module")
def ik():
    return ArmIk(build_arm(CELL).compile(), np.array(CELL.home_q))


def test_forward_agrees_with_the_published_table(ik):
    rng = np.random.default_rng(0)
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        np.testing.assert_allclose(ik.forward(q), forward_kinematics(q)[6] @ T_FLANGE_TCP, atol=1e-9)


def random_targets(rng, count):
    half = np.array(CELL.pick_area_half_m)
    for _ in range(count):
        x, y = apply(CELL.T_world_board, [*rng.uniform(-half, half), 0.0])[:2]
        yield top_down(x, y, rng.uniform(0.005, 0.1), rng.uniform(-np.pi, np.pi))
        nests = CELL.nest_frames(CELL.tray.classes[int(rng.integers(3))])
        x, y = nests[int(rng.integers(len(nests))), :2, 3]
        yield top_down(x, y, rng.uniform(0.012, 0.1), rng.uniform(-np.pi, np.pi))


def test_calibrated_arm_reaches_the_pose_by_its_own_kinematics():
    """The closed form of the nominal arm only starts the search; a flange 3 mm off would otherwise miss by as much."""
    rng, axes = np.random.default_rng(9), forward_kinematics(np.zeros(6)).copy()
    for i in range(1, 6):
        axes[i] = axes[i] @ transform(rotation_from_rotvec(rng.normal(0, 3e-3, 3)), rng.normal(0, 1e-3, 3))
    axes[6] = axes[5] @ transform(t=[0.0, 0.0, UR5E.d[5]])
    cell = CellConfig(arm=table_from_axes(axes))
    solver, missed = ArmIk(build_arm(cell).compile(), np.array(CELL.home_q)), []
    for T in random_targets(rng, 25):
        q = solver.solve(T)
        reached = forward_kinematics(q, cell.arm)[6] @ T_FLANGE_TCP
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 2e-7
        assert rotation_angle(reached[:3, :3], T[:3, :3]) < 2e-6
        missed.append(np.linalg.norm((forward_kinematics(q)[6] @ T_FLANGE_TCP - T)[:3, 3]))
    assert min(missed) > 0.2e-3


def test_model_of_another_arm_or_tool_is_refused():
    spec = build_arm(CELL)
    spec.body("ur5e_base").pos = [0.0, 0.0, 0.05]
    with pytest.raises(IkError, match="base is not at the origin"):
        ArmIk(spec.compile(), np.array(CELL.home_q))
    spec = build_arm(CELL)
    spec.site("tcp").pos = [0.0, 0.0, 0.140]
    with pytest.raises(IkError, match="another tool"):
        ArmIk(spec.compile(), np.array(CELL.home_q))


def test_top_down_targets_over_board_and_tray_converge(ik):
    for T in random_targets(np.random.default_rng(1), 25):
        reached = forward_kinematics(ik.solve(T))[6] @ T_FLANGE_TCP
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 1e-5
        assert rotation_angle(reached[:3, :3], T[:3, :3]) < np.deg2rad(0.01)


def test_mink_alone_converges_from_a_start_far_off(ik):
    rng = np.random.default_rng(2)
    for T in random_targets(rng, 10):
        q = ik.refine(T, ik.solve(T) + rng.normal(0.0, 0.1, 6))
        assert np.linalg.norm(ik.forward(q)[:3, 3] - T[:3, 3]) < 1e-5
        assert rotation_angle(ik.forward(q)[:3, :3], T[:3, :3]) < np.deg2rad(0.01)


def test_solution_is_the_branch_nearest_to_the_asked_joints(ik):
    rng = np.random.default_rng(3)
    for T in random_targets(rng, 5):
        q = ik.solve(T)
        np.testing.assert_allclose(ik.solve(T, q + rng.normal(0.0, 0.02, 6)), q, atol=1e-5)


def test_arm_keeps_its_shape_over_board_and_tray(ik):
    q = np.array([ik.solve(T) for T in random_targets(np.random.default_rng(4), 25)])
    assert (np.abs(q - CELL.home_q)[:, :5] < 1.3).all()


def test_jacobian_is_the_derivative(ik):
    q, h = np.array(CELL.home_q), 1e-6
    J = ik.jacobian(q)
    for i in range(6):
        step = np.eye(6)[i] * h
        slope = (ik.forward(q + step)[:3, 3] - ik.forward(q - step)[:3, 3]) / (2 * h)
        np.testing.assert_allclose(J[:3, i], slope, atol=1e-8)


def test_joints_stay_within_half_a_turn_of_home_and_inside_the_arms_range(ik):
    low, high = ik.joint_limits
    home = np.array(CELL.home_q)
    np.testing.assert_allclose(low, np.maximum(home - np.pi, JOINT_RANGE_RAD[0]))
    np.testing.assert_allclose(high, np.minimum(home + np.pi, JOINT_RANGE_RAD[1]))


def test_out_of_reach_is_said_with_the_pose(ik):
    with pytest.raises(IkError, match=r"1\.5000.*out of the arm's reach"):
        ik.solve(top_down(1.5, 0.0, 0.1, 0.0))
    with pytest.raises(IkError, match="not finite"):
        ik.solve(top_down(np.nan, 0.0, 0.1, 0.0))


def test_no_convergence_is_said_with_the_residual(ik):
    with pytest.raises(IkError, match=r"not reached.*mm and .* degrees are left"):
        ik.refine(top_down(1.5, 0.0, 0.1, 0.0), np.array(CELL.home_q))
