"""Faked success must be caught: each cheat below is carried out by the real arm in physics."""

from __future__ import annotations

import numpy as np
import pytest

from cad.parts import load_part, planar
from cad.robot import JOINT_NAMES
from cad.spatial import rotation_x, transform
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.grasp_search import find_grasps
from twin.referee import Referee
from twin.robot import RobotError
from twin.sim_robot import SimRobot

CELL = CellConfig()
NAMES = ["top", "main"]
PARTS = [load_part(name) for name in NAMES]
TARGET, NEIGHBOUR = 0, 1
POSE = PARTS[TARGET].stable_poses[0]
GRASP = find_grasps(PARTS[TARGET], POSE).grasps[0]


class Stage:
    """A cell with one part to pick and a neighbour 40 mm beside it."""

    def __init__(self) -> None:
        self.model = build_workcell(CELL, NAMES).compile()
        self.data = mujoco.MjData(self.model)
        start = [
            CELL.T_world_board @ planar(0.04 * i, 0.0, 0.0) @ p.stable_poses[0].T_table_part
            for i, p in enumerate(PARTS)
        ]
        set_parts(self.model, self.data, np.array(start))
        for name, q in zip(JOINT_NAMES, CELL.home_q, strict=True):
            self.data.joint(name).qpos[0] = q
        mujoco.mj_forward(self.model, self.data)
        self.T_start = start[TARGET]
        self.robot = SimRobot(self.model, self.data, CELL, on_step=lambda: self.referee.watch())
        self.referee = Referee(self.model, self.data, CELL, PARTS)
        self.robot.grip(GRASP.opening_m, force_n=20.0, speed=0.15)
        self.referee.begin_attempt()

    def line(self, T_base_tcp, speed=0.25):
        self.robot.move_l(T_base_tcp, speed=speed, acceleration=1.2)

    def over(self, T_base_part, height):
        """Tool pose of the grasp with the part ``height`` above ``T_base_part``."""
        return transform(t=[0.0, 0.0, height]) @ T_base_part @ GRASP.T_part_tcp

    def jump(self, T_base_tcp):
        self.robot.move_j(self.robot.ik.solve(T_base_tcp), speed=1.0, acceleration=2.5)

    def take(self, lift):
        self.jump(self.over(self.T_start, 0.03))
        self.line(self.over(self.T_start, 0.0), 0.06)
        self.robot.grip(GRASP.width_m - 0.004, force_n=20.0, speed=0.03)
        self.line(self.over(self.T_start, lift), 0.1)

    def release(self):
        self.robot.grip(GRASP.width_m + 0.002, force_n=20.0, speed=0.02)
        self.robot.grip(GRASP.opening_m, force_n=20.0, speed=0.15)
        self.line(transform(t=[0.0, 0.0, 0.06]) @ self.robot.observe().T_base_tcp)

    def finish(self):
        return self.referee.finish()

    def nest(self, name="top", index=0):
        return CELL.nest_frames(name)[index] @ POSE.T_table_part


def test_an_honest_pick_succeeds():
    stage = Stage()
    stage.take(lift=0.08)
    stage.jump(stage.over(stage.nest(), 0.08))
    stage.line(stage.over(stage.nest(), 0.15e-3), 0.06)
    stage.release()
    records = stage.finish()
    record = records[TARGET]
    assert record.picked and record.placed and record.nest == 0 and record.attempts == 1
    assert record.succeeded, (record.collisions, record.disturbed)
    assert record.T_tcp_part is not None
    # a part that was never tried is presented all the same, and has not succeeded
    assert not records[NEIGHBOUR].succeeded and records[NEIGHBOUR].attempts == 0


def test_a_part_dropped_at_the_last_moment_is_no_success():
    stage = Stage()
    stage.take(lift=0.08)
    stage.jump(transform(t=[0.0, -0.01, 0.0]) @ stage.over(stage.nest(), 0.08))
    stage.robot.grip(GRASP.opening_m, force_n=20.0, speed=0.15)
    record = stage.finish()[TARGET]
    assert record.picked and not record.placed and not record.succeeded


def test_a_part_dragged_low_over_the_board_was_not_picked():
    stage = Stage()
    stage.take(lift=0.025)
    stage.line(stage.over(stage.nest(), 0.025), 0.2)
    stage.line(stage.over(stage.nest(), 0.15e-3), 0.06)
    stage.release()
    record = stage.finish()[TARGET]
    assert record.gripped and record.placed and not record.picked and not record.succeeded


def test_the_wrong_nest_does_not_count():
    stage = Stage()
    stage.take(lift=0.08)
    stage.jump(stage.over(stage.nest("main", 1), 0.08))
    stage.line(stage.over(stage.nest("main", 1), 0.15e-3), 0.06)
    stage.release()
    record = stage.finish()[TARGET]
    assert record.picked and not record.placed and record.nest is None


def test_a_part_that_appears_in_its_nest_was_not_picked():
    stage = Stage()
    T = stage.referee.poses()
    T[TARGET] = stage.nest()
    set_parts(stage.model, stage.data, T)
    record = stage.finish()[TARGET]
    assert record.placed and not record.picked and not record.succeeded


def test_a_neighbour_knocked_away_spoils_the_pick():
    stage = Stage()
    beside = transform(rotation_x(np.pi), stage.referee.poses()[NEIGHBOUR, :3, 3] + [0.0, 0.0, 0.001])
    stage.robot.grip(0.0, force_n=20.0, speed=0.15)
    stage.jump(transform(t=[0.0, 0.02, 0.03]) @ beside)
    stage.line(transform(t=[0.0, 0.02, 0.0]) @ beside)
    stage.line(transform(t=[0.0, -0.004, 0.0]) @ beside, 0.1)
    stage.line(transform(t=[0.0, -0.004, 0.05]) @ beside)
    stage.robot.grip(GRASP.opening_m, force_n=20.0, speed=0.15)
    stage.take(lift=0.08)
    stage.jump(stage.over(stage.nest(), 0.08))
    stage.line(stage.over(stage.nest(), 0.15e-3), 0.06)
    stage.release()
    records = stage.finish()
    record = records[TARGET]
    assert record.picked and record.placed
    assert record.disturbed == ["part_01"] and "part_01" in record.collisions
    assert not record.succeeded
    assert records[NEIGHBOUR].moved_by_others


def test_striking_the_board_elsewhere_is_a_collision():
    stage = Stage()
    far = CELL.T_world_board[:3, 3] + [0.03, 0.03, 0.0]
    down = transform(rotation_x(np.pi), far)
    stage.robot.grip(0.0, force_n=20.0, speed=0.15)
    stage.jump(transform(t=[0.0, 0.0, 0.03]) @ down)
    with pytest.raises(RobotError, match="in its way"):
        stage.line(transform(t=[0.0, 0.0, -0.3e-3]) @ down, 0.05)
    stage.line(transform(t=[0.0, 0.0, 0.05]) @ down)
    stage.robot.grip(GRASP.opening_m, force_n=20.0, speed=0.15)
    stage.take(lift=0.08)
    record = stage.finish()[TARGET]
    assert "board" in record.collisions and not record.succeeded
