import numpy as np
import pytest

from cad import gripper
from cad.parts import planar
from cad.spatial import apply, rotation_z
from twin.grasp_choice import PlacedPart, choose_grasp
from twin.grasp_config import GraspConfig
from twin.grasp_geometry import convex_gap, footprint
from twin.grasps import read_grasps
from twin.robot import TwinError, top_down

NEST = planar(0.40, 0.25, 0.0)


def choose(brick, neighbours=(), nest_neighbours=(), solve=lambda T: np.zeros(6), at=(0.45, 0.0, 0.3)):
    resting = brick.stable_poses[0].T_table_part
    target = PlacedPart(part=brick, T_base_part=planar(*at) @ resting)
    others = [PlacedPart(part=brick, T_base_part=planar(*n) @ resting) for n in neighbours]
    in_tray = [PlacedPart(part=brick, T_base_part=planar(*n) @ resting) for n in nest_neighbours]
    grasps = read_grasps(brick)[0]
    return (
        target,
        others,
        choose_grasp(target, others, NEST @ resting, in_tray, grasps, solve, np.zeros(6), GraspConfig()),
    )


def fingers_hit(target, choice, others):
    """Whether a finger at the opening, or anywhere on its way to the part, overlaps an outline."""
    T = target.T_base_part @ choice.T_part_tcp
    for half in np.linspace(choice.grasp.width_m / 2, choice.openings_m[0] / 2, 10):
        for side in (-1, 1):
            x = np.array([half, half + gripper.PAD_THICKNESS_M]) * side
            y = np.array([-0.5, 0.5]) * gripper.PAD_WIDTH_M
            corners = apply(T, np.array([[x[0], y[0], 0], [x[1], y[0], 0], [x[1], y[1], 0], [x[0], y[1], 0]]))[:, :2]
            if any(convex_gap(corners, footprint(o.part.mesh, o.T_base_part)) <= 0 for o in others):
                return True
    return False


def test_alone_the_best_grasp_is_taken_with_full_clearance(brick):
    _, _, choice = choose(brick)
    assert choice.grasp.width_m == pytest.approx(6e-3)
    assert choice.openings_m == (pytest.approx(12e-3), pytest.approx(12e-3))


def test_neighbours_are_spared(brick):
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(20):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(9e-3, 14e-3)
        beside = (0.45 + distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-3, 3))
        target, others, choice = choose(brick, neighbours=[beside])
        if isinstance(choice, str):
            continue
        found += 1
        assert not fingers_hit(target, choice, others)
    assert found >= 10


def test_a_part_walled_in_says_why(brick):
    ring = [(0.45 + 8.5e-3 * np.cos(a), 8.5e-3 * np.sin(a), a) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
    assert "neighbour" in choose(brick, neighbours=ring)[2]
    around_nest = [(0.40 + 8.5e-3 * np.cos(a), 0.25 + 8.5e-3 * np.sin(a), a) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
    assert "tray" in choose(brick, nest_neighbours=around_nest)[2]


def test_out_of_reach_says_why(brick):
    def solve(T):
        raise TwinError("no")

    assert "reach" in choose(brick, solve=solve)[2]


def test_the_wrist_turns_at_most_a_quarter_from_zero(brick):
    def solve(T):
        x = T[:3, 0]
        return np.array([0, 0, 0, 0, 0, np.arctan2(x[1], x[0])])

    for yaw in np.linspace(-np.pi, np.pi, 13):
        target, _, choice = choose(brick, solve=solve, at=(0.45, 0.0, yaw))
        T = target.T_base_part @ choice.T_part_tcp
        c, s = T[:2, 0]
        np.testing.assert_allclose(T, top_down(*T[:3, 3], np.arctan2(s, c)), atol=1e-9)
        assert abs(choice.q_place[5] - choice.q_pick[5]) <= np.pi


def test_gap_between_convex_outlines():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert convex_gap(square, square + np.array([1.5, 0.0])) == pytest.approx(0.5)
    assert convex_gap(square, square + np.array([0.9, 0.2])) == pytest.approx(-0.1)
    turned = (square - 0.5) @ rotation_z(np.pi / 4)[:2, :2].T + [0.5, 2.0]
    assert convex_gap(square, turned) == pytest.approx(1.5 - np.sqrt(0.5) - 0.5 + 0.0, abs=1e-9)
