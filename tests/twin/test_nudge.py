"""Pushes in the simulated cell: they move the part that they are meant for and nothing else, and the referee agrees."""

from dataclasses import replace

import numpy as np
import pytest
from looked_at_cell import CELL, LookedAtCell

from cad.equivalence import Symmetries
from cad.parts import load_part, planar
from cad.spatial import apply, inverse
from perception.estimates import AMBIGUOUS, NOT_A_PART, PartEstimate
from twin.candidates import Candidate
from twin.events import LookedAgain, NudgeFinished, NudgeStarted
from twin.grasp_choice import PlacedPart
from twin.ik import IkError
from twin.nominal import nominal_calibration
from twin.nudge import FINGERS_M, NudgeConfig, plan_nudge
from twin.park_pose import park_elsewhere, room_beside_board
from twin.robot import top_down
from twin.second_look import SecondLookConfig

PART = load_part("main")
CALIBRATION = nominal_calibration(CELL, ["main"])
NUDGES = SecondLookConfig(looks=("nudge",))


def lying(x, y, yaw=0.0):
    T = CELL.T_world_board @ planar(x, y, yaw) @ PART.stable_poses[0].T_table_part
    estimate = PartEstimate(part="main", T_cam_part=T, stable_pose=0, score=0.5, verdict=AMBIGUOUS)
    placed = PlacedPart(part=PART, T_base_part=T)
    return Candidate(estimate=estimate, placed=placed, readings=(), problem=("declined", AMBIGUOUS))


def plan(target, others=(), solve=lambda T: np.zeros(6), **config):
    return plan_nudge(
        target,
        [other.centre for other in others],
        radius_m=PART.radius_m,
        solve=solve,
        calibration=CALIBRATION,
        config=NudgeConfig(**config),
    )


def ring(radius, count=6):
    angles = 2 * np.pi * np.arange(count) / count
    return [lying(radius * np.cos(a), radius * np.sin(a)) for a in angles]


def test_a_push_keeps_its_distance_or_is_refused():
    rng = np.random.default_rng(0)
    made = 0
    for _ in range(60):
        others = [lying(*rng.uniform(-0.05, 0.05, 2)) for _ in range(5)]
        nudge = plan(lying(0.0, 0.0), others)
        if isinstance(nudge, str):
            assert "neighbour" in nudge
            continue
        made += 1
        way = np.linspace(nudge.T_base_start[:2, 3], nudge.T_base_end[:2, 3], 50)
        for other in others:
            apart = np.linalg.norm(way[:, None] - other.placed.outline, axis=-1).min()
            assert apart > FINGERS_M + NudgeConfig().margin_m - 1e-9
    assert 10 < made < 60


def test_a_part_among_near_neighbours_is_not_pushed():
    assert "neighbour" in plan(lying(0.0, 0.0), ring(0.015))
    assert not isinstance(plan(lying(0.0, 0.0), ring(0.040)), str)


def test_a_push_stays_in_the_pick_area_above_the_board_and_within_reach():
    edge = lying(0.079, 0.0)
    after = apply(inverse(CALIBRATION.T_base_board), [*plan(edge).centre_after, 0.0])
    assert abs(after[0]) <= CALIBRATION.board_half_m[0]
    assert "leave the pick area" in plan(lying(0.2, 0.0))
    for T in (plan(edge).T_base_start, plan(edge).T_base_end, plan(edge).T_base_back):
        assert T[2, 3] > CALIBRATION.T_base_board[2, 3] + 0.4e-3

    def unreachable(T_base_tcp):
        raise IkError("too far")

    assert "reach" in plan(edge, solve=unreachable)


def test_distances_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="push_m -1"):
        NudgeConfig(push_m=-1.0)


def unsure(estimate):
    return replace(estimate, score=0.6, verdict=AMBIGUOUS)


def moved(T_before, T_after):
    distance, angle = Symmetries().difference(T_before, T_after)
    return 1e3 * distance, np.degrees(angle)


def test_a_pushed_part_moves_a_little_alone_and_is_then_picked():
    cell = LookedAtCell(
        [("main", 0, 0.0, 0.0, 0.3), ("top", 0, 0.030, 0.005, 1.0)],
        lambda e, exposure: e if e.part == "top" or finished(cell) else unsure(e),
    )
    before, poses = cell.poses(), {}
    cell.on_event = lambda event: poses.setdefault(type(event), cell.poses())
    attempts, (main, top) = cell.run()
    assert [(a.part, a.outcome) for a in attempts] == [("top", "placed"), ("main", "placed")]
    distance, angle = moved(poses[NudgeStarted][0], poses[NudgeFinished][0])
    assert 1.0 < distance < 6.0 and angle > 3.0
    assert moved(poses[NudgeStarted][1], poses[NudgeFinished][1])[0] < 0.01
    assert moved(before[0], poses[NudgeStarted][0])[0] < 0.01
    assert main.succeeded and (main.nudges, main.attempts) == (1, 1)
    assert top.succeeded and (top.nudges, top.attempts) == (0, 1)
    assert [e.kind for e in cell.events if isinstance(e, LookedAgain)] == ["exposure"] * 3 + ["nudge"]


def finished(cell):
    return any(isinstance(e, NudgeFinished) for e in cell.events)


def test_the_second_exposure_settles_it_without_a_touch():
    cell = LookedAtCell([("top", 0, 0.01, 0.0, 2.0)], lambda e, exposure: e if exposure == 1.6 else unsure(e))
    (attempt,), (record,) = cell.run()
    assert attempt.outcome == "placed" and attempt.view == "exposure 1.6"
    assert record.succeeded and (record.nudges, record.attempts) == (0, 1)
    again = [e for e in cell.events if isinstance(e, LookedAgain)]
    assert [(e.kind, e.accepted) for e in again] == [("exposure", 0), ("exposure", 1)]
    assert all(e.seconds == pytest.approx(0.4, abs=0.01) for e in again)  # a changed exposure time and a look
    assert attempt.look_time_s < attempt.start_s - sum(e.seconds for e in again)  # they count in the cycle


def test_what_stays_unsure_is_declined_and_other_things_are_not_touched():
    cell = LookedAtCell(
        [("main", 0, 0.0, 0.0, 0.3), ("inserted", 0, 0.016, 0.0, 0.0), ("top", 0, -0.05, 0.02, 1.0)],
        lambda e, exposure: unsure(e) if e.part == "top" else replace(e, score=0.1, verdict=NOT_A_PART),
        NUDGES,
    )
    before = cell.poses()
    attempts, records = cell.run()
    assert {a.part: (a.outcome, a.tried) for a in attempts}["top"] == ("declined", False)
    assert [r.nudges for r in records] == [0, 0, 2] and not any(r.attempts for r in records)
    assert not any(r.collisions or r.disturbed or r.moved_by_others for r in records)
    for T_before, T_after in zip(before[:2], cell.poses()[:2], strict=True):
        assert moved(T_before, T_after)[0] < 0.01
    assert moved(before[2], cell.poses()[2])[0] > 1.0


def test_an_unsure_part_in_a_crowd_is_left_alone():
    around = [("top", 0, 0.013 * np.cos(a), 0.013 * np.sin(a), 0.0) for a in np.arange(6) * np.pi / 3]
    cell = LookedAtCell([("top", 0, 0.0, 0.0, 0.0), *around], lambda e, exposure: unsure(e), NUDGES)
    before = cell.poses()
    _, records = cell.run()
    assert moved(before[0], cell.poses()[0])[0] < 0.01 and records[0].nudges == 0
    assert not any(r.collisions or r.disturbed for r in records)


def test_the_referee_charges_a_push_with_what_it_shoves_unseen():
    cell = LookedAtCell(
        [("top", 0, 0.0, 0.0, 0.0), ("main", 0, 0.0095, 0.0, 0.0)],
        lambda e, exposure: unsure(e),
        replace(NUDGES, nudges=1),
    )
    oracle = cell.oracle.estimate
    cell.oracle.estimate = lambda frame: replace(e := oracle(frame), parts=e.parts[:1])
    _, records = cell.run()
    assert records[0].nudges == 1 and records[0].disturbed == ["part_01"] and not records[0].succeeded


def test_an_arm_in_view_is_parked_elsewhere():
    def over_the_board(calibration):
        q = calibration_ik().solve(top_down(0.40, 0.05, 0.25, 0.0))
        return replace(calibration, q_park=q)

    def beside_the_arm(e, exposure):
        return e if room_beside_board(cell.robot.observe().q, cell.robot.ik, cell.calibration) >= 0 else unsure(e)

    cell = LookedAtCell([("top", 0, 0.01, 0.0, 0.0)], beside_the_arm, calibrated=over_the_board)
    (attempt,), (record,) = cell.run()
    assert attempt.view == "arm elsewhere" and record.succeeded and record.nudges == 0
    assert [e.kind for e in cell.events if isinstance(e, LookedAgain)] == ["exposure", "exposure", "park"]
    low, high = cell.robot.ik.joint_limits
    q = park_elsewhere(cell.robot.ik, cell.calibration)
    assert q is not None and ((q >= low) & (q <= high)).all()
    assert park_elsewhere(cell.robot.ik, CALIBRATION) is None  # as drawn the arm is nowhere near


def calibration_ik():
    from scenes.workcell import build_arm
    from twin.ik import ArmIk

    return ArmIk(build_arm(CELL).compile(), np.array(CELL.home_q))
