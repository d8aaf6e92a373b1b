"""The controller against a robot of plain arithmetic: parts are boxes that the hand takes along or misses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fake_cell import BOARD, CELL, IK, NESTS, PLACES, FakeCamera, FakeEstimator, FakeRobot, World

from cad.spatial import inverse, rotation_angle, rotation_x, transform
from twin.attempts import OUTCOMES, Calibration, ControllerConfig
from twin.controller import ControllerError, PickController
from twin.events import AttemptFinished, AttemptStarted, Looked
from twin.grasp_config import GraspError
from twin.robot import RobotError
from twin.second_look import SecondLookConfig


def test_every_part_ends_in_a_nest_of_its_own(brick):
    world = World(brick)
    attempts = world.run()
    assert [a.outcome for a in attempts] == ["placed"] * 3
    assert [len(n) for n in world.in_nests()] == [1, 1, 1, 0]
    assert sorted(a.nest for a in attempts) == [0, 1, 2]
    assert min(world.robot.carry_heights) > 0.06
    np.testing.assert_allclose(world.robot.q, CELL.home_q)


def test_an_error_across_the_pads_is_squeezed_out(brick):
    def off_across(estimate):  # the best grasp closes along the part's y
        return replace(estimate, T_cam_part=estimate.T_cam_part @ transform(t=[0.0, 0.8e-3, 0.0]))

    world = World(brick, change=off_across)
    assert [a.outcome for a in world.run()] == ["placed"] * 3
    assert [len(n) for n in world.in_nests()] == [1, 1, 1, 0]


def test_height_and_tilt_come_from_the_board_not_from_the_estimate(brick):
    def off_plane(estimate):
        wrong = transform(rotation_x(0.05), [0.0, 0.0, 0.8e-3])
        return replace(estimate, T_cam_part=estimate.T_cam_part @ wrong)

    world = World(brick, change=off_plane)
    for attempt in world.run():
        assert attempt.outcome == "placed"
        lying = inverse(BOARD) @ attempt.T_base_part
        np.testing.assert_allclose(lying[2], brick.stable_poses[0].T_table_part[2], atol=1e-12)


def test_an_estimate_far_off_the_plane_is_a_pose_failure(brick):
    world = World(
        brick, PLACES[:1], lambda e: replace(e, T_cam_part=e.T_cam_part @ transform(rotation_x(0.5), [0, 0, 0]))
    )
    attempts = world.run()
    assert [(a.outcome, a.tried) for a in attempts] == [("pose", False)]
    assert "stable pose" in attempts[0].note


def test_a_missed_grip_is_tried_again_after_another_look(brick):
    world = World(brick, PLACES[:1])
    world.robot.misses = 2
    attempts = world.run()
    assert [(a.outcome, a.number) for a in attempts] == [("grasp", 1), ("grasp", 2), ("placed", 3)]
    looks = [e for e in world.events if isinstance(e, Looked)]
    assert len(looks) >= 4


def test_after_the_last_try_a_part_is_left(brick):
    world = World(brick, PLACES[:2], tries_per_region=2)
    world.robot.misses = 100
    attempts = world.run()
    assert [a.outcome for a in attempts if a.tried] == ["grasp"] * 4
    left = [a for a in attempts if not a.tried]
    assert len(left) == 2 and all(a.outcome == "grasp" and "gave up" in a.note for a in left)


def test_a_part_lost_on_the_way_is_a_transport_failure(brick):
    world = World(brick, PLACES[:1])
    world.robot.drop_on_carry = 1
    world.parts[0].T_base_part[0, 3] += 0.0
    attempts = world.run()
    assert attempts[0].outcome == "transport"
    assert not any(world.in_nests()[0])


def test_what_is_declined_is_not_touched(brick):
    world = World(brick, change=lambda e: replace(e, verdict="too blurred"), second_look=SecondLookConfig(looks=()))
    attempts = world.run()
    assert [(a.outcome, a.note, a.tried) for a in attempts] == [("declined", "too blurred", False)] * 3
    assert all(T[2, 3] > 0.06 for T in world.robot.moves)


def test_full_trays_are_said(brick):
    world = World(brick, places=[(x, y, 0.0) for x in (-0.05, 0.0, 0.05) for y in (-0.02, 0.02)])
    attempts = world.run()
    assert [a.outcome for a in attempts] == ["placed"] * 4 + ["place"] * 2
    assert "4 nests" in attempts[-1].note


def test_a_frame_that_cannot_be_used_is_taken_again(brick):
    world = World(brick, PLACES[:1], idle_looks=2)
    world.estimator.failures = 1
    assert [a.outcome for a in world.run()] == ["placed"]
    blind = World(brick, PLACES[:1], idle_looks=2)
    blind.estimator.failures = 100
    assert blind.run() == []


def test_a_refused_motion_ends_the_attempt_and_a_stopped_robot_the_run(brick):
    world = World(brick, PLACES[:1], tries_per_region=1)
    world.robot.refuse = True
    assert [(a.outcome, a.tried) for a in world.run()] == [("ik", True), ("grasp", False)]
    stopped = World(brick, PLACES[:1])
    stopped.robot.stuck = True
    with pytest.raises(RobotError, match="protective stop"):
        stopped.run()
    assert stopped.controller.attempts[-1].outcome == "collision"


def test_events_tell_the_story_in_order(brick):
    world = World(brick, PLACES[:1])
    attempts = world.run()
    kinds = [type(e) for e in world.events]
    assert kinds[:3] == [Looked, AttemptStarted, AttemptFinished] and set(kinds[3:]) == {Looked}
    started, finished = world.events[1].attempt, world.events[2].attempt
    assert finished is attempts[0] and started.outcome is None
    assert started.look_time_s <= started.start_s < finished.end_s
    assert finished.opening_m == pytest.approx(finished.grasp.width_m, abs=1e-4)
    np.testing.assert_allclose(finished.T_base_tcp[:3, 2], [0, 0, -1], atol=1e-9)
    assert set(a.outcome for a in attempts) <= set(OUTCOMES)


def test_the_nearest_turn_of_the_hand_keeps_the_wrist_inside(brick):
    for yaw in np.linspace(-3, 3, 7):
        world = World(brick, [(0.0, 0.0, yaw)])
        assert world.run()[0].outcome == "placed"
        nest = NESTS[0] @ brick.stable_poses[0].T_table_part
        assert rotation_angle(world.parts[0].T_base_part[:3, :3], nest[:3, :3]) < 1e-6


def test_a_pose_that_cannot_be_gripped_is_left_with_the_stored_reason(brick):
    path = brick.folder / "grasps.json"
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"grasps": [], "reasons": [["wider than the gripper opens: 51.2 mm"]]}))
    attempts = World(replace(brick)).run()
    assert [a.outcome for a in attempts] == ["grasp"] * 3 and not any(a.tried for a in attempts)
    assert all("face 0" in a.note and "51.2 mm" in a.note for a in attempts)


def test_what_is_missing_is_named_before_anything_moves(brick):
    calibration = Calibration(T_base_board=BOARD, T_base_nests={}, q_park=np.zeros(6), board_half_m=(0.1, 0.1))
    robot = FakeRobot([])
    with pytest.raises(ControllerError, match="brick"):
        PickController(
            robot, FakeCamera(robot), FakeEstimator([]), ik=IK, parts={"brick": brick}, calibration=calibration
        )
    path = brick.folder / "grasps.json"
    path.write_text(json.dumps({"made_for": "old", "grasps": []}))
    with pytest.raises(GraspError, match="old"):
        World(replace(brick))
    with pytest.raises(ValueError, match=r"grip_force_n 500"):
        ControllerConfig(grip_force_n=500)
    with pytest.raises(ValueError, match=r"joint_speed 9"):
        ControllerConfig(joint_speed=9.0)
