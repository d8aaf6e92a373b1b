"""What is unsure is looked at again: the policy by itself, and with a controller in a cell of plain arithmetic."""

from dataclasses import replace

import numpy as np
import pytest
from fake_cell import BOARD, PLACES, World

from cad.parts import planar
from cad.spatial import inverse
from perception.estimates import ACCEPTED, AMBIGUOUS, NOT_A_PART, PartEstimate, PoseAlternative
from twin.attempts import Calibration, ControllerConfig
from twin.candidates import Candidate, Reading, bring_down
from twin.events import Looked, LookedAgain, NudgeFinished, NudgeStarted
from twin.evidence import agreement, same_reading
from twin.grasp_choice import PlacedPart
from twin.nudge import Nudge
from twin.second_look import SecondLookConfig, SecondLooks
from twin.views import USUAL, View

DARK, BRIGHT, AWAY = View(exposure=0.6), View(exposure=1.6), View(elsewhere=True)


def candidate(part, x=0.0, yaw=0.0, score=0.6, verdict=AMBIGUOUS):
    T = BOARD @ planar(x, 0.0, yaw) @ part.stable_poses[0].T_table_part
    estimate = PartEstimate(part=part.name, T_cam_part=T, stable_pose=0, score=score, verdict=verdict)
    problem = None if verdict == ACCEPTED else ("declined", verdict)
    return Candidate(
        estimate=estimate,
        placed=PlacedPart(part=part, T_base_part=T),
        readings=(Reading(part=part, stable_pose=0, T_base_part=T, probability=score),),
        problem=problem,
    )


def reading(part, yaw=0.0, probability=0.7):
    return candidate(part, yaw=yaw, score=probability).readings[0]


def push(target, others=(), free_m=0.01):
    T = np.eye(4)
    return Nudge(
        part="brick",
        centre=target.centre,
        centre_after=target.centre + np.array([0.004, 0.0]),
        T_base_start=T,
        T_base_end=T,
        T_base_back=T,
        free_m=free_m,
    )


def test_cheap_looks_come_first_and_each_is_taken_once(brick):
    looks = SecondLooks(SecondLookConfig(), elsewhere=True)
    taken, view = [], USUAL
    x = 0.0
    for _ in range(20):
        doubtful = [candidate(brick, x)]
        looks.take_in(view, doubtful)
        step = looks.next(view, doubtful, push)
        taken.append(step)
        if step is None:
            break
        if isinstance(step, Nudge):
            looks.pushed(step)
            x += 0.004
        view = step if isinstance(step, View) else USUAL
    kinds = ["nudge" if isinstance(step, Nudge) else step for step in taken]
    assert kinds == [DARK, BRIGHT, AWAY, USUAL, "nudge", "nudge", None]


def test_the_configured_order_holds_and_no_place_elsewhere_means_no_look_from_there(brick):
    looks = SecondLooks(SecondLookConfig(looks=("park", "nudge", "exposure"), exposures=(0.5,)), elsewhere=False)
    doubtful = [candidate(brick)]
    looks.take_in(USUAL, doubtful)
    assert looks.next(USUAL, doubtful, push) == View(exposure=0.5)


def test_looks_are_bounded_in_number_and_in_time(brick):
    doubtful = [candidate(brick)]
    for config, spent in ((SecondLookConfig(max_looks=2), 1.0), (SecondLookConfig(max_s=10.0), 5.0)):
        looks = SecondLooks(config, elsewhere=False)
        looks.take_in(USUAL, doubtful)
        for _ in range(2):
            assert looks.next(USUAL, doubtful, push) is not None
            looks.looked(spent)
        assert looks.next(USUAL, doubtful, push) is None


def test_what_is_not_a_part_or_sure_asks_for_no_look(brick):
    looks = SecondLooks(SecondLookConfig(), elsewhere=False)
    seen = [candidate(brick, verdict=NOT_A_PART), candidate(brick, 0.03, score=0.99, verdict=ACCEPTED)]
    looks.take_in(USUAL, seen)
    assert looks.unsure == 0 and looks.next(USUAL, seen, push) is None


def test_a_push_that_is_refused_is_not_made_and_the_one_with_most_room_comes_first(brick):
    looks = SecondLooks(SecondLookConfig(looks=("nudge",)), elsewhere=False)
    doubtful = [candidate(brick, 0.0), candidate(brick, 0.03)]
    looks.take_in(USUAL, doubtful)
    assert looks.next(USUAL, doubtful, lambda target, others: "a neighbour is too near for a push") is None
    chosen = looks.next(USUAL, doubtful, lambda target, others: push(target, free_m=1.0 - target.centre[1]))
    assert chosen.centre == pytest.approx(max(doubtful, key=lambda c: -c.centre[1]).centre)


def test_pushes_keep_clear_of_what_any_view_has_shown_and_of_nothing_that_has_gone(brick):
    looks = SecondLooks(SecondLookConfig(looks=("exposure", "nudge")), elsewhere=False)
    doubtful, hidden, picked = candidate(brick), candidate(brick, 0.02), candidate(brick, 0.04)
    foreign = np.array([0.3, 0.0])
    for view, seen in ((USUAL, [doubtful]), (DARK, [doubtful, hidden, picked]), (BRIGHT, []), (USUAL, [doubtful])):
        looks.take_in(view, seen, [foreign] if view == BRIGHT else [])
    looks.forget(picked.centre)
    asked = []
    looks.next(USUAL, [doubtful], lambda target, others: asked.append((target, others)) or "no")
    ((target, others),) = asked
    assert target is doubtful
    np.testing.assert_array_equal(others, [hidden.centre, foreign])


def test_log_probabilities_of_a_reading_add_over_looks(brick):
    there, turned = reading(brick), reading(brick, yaw=1.0)
    assert same_reading(there, reading(brick, yaw=0.1)) and not same_reading(there, turned)
    assert agreement(there, [[there]]) == 1.0  # nothing speaks for anything else
    assert agreement(there, [[there], [turned]]) == pytest.approx(0.5)
    assert agreement(there, [[there], [there], [turned]]) == pytest.approx(0.7)
    sure = reading(brick, probability=0.97)
    assert agreement(sure, [[sure], [turned]]) == pytest.approx(0.97 * 0.3 / (0.97 * 0.3 + 0.03 * 0.7))
    both = [reading(brick, probability=0.6), reading(brick, yaw=1.0, probability=0.4)]
    assert agreement(there, [both]) == pytest.approx(0.6)
    assert agreement(there, [both, both]) == pytest.approx(0.36 / (0.36 + 0.16))


def test_alternatives_of_an_estimate_are_readings_on_the_board(brick):
    T_cam_part, T_base_cam = planar(0.01, 0.0, 0.5), planar(0.4, 0.0, 1.0)
    T_base_part = BOARD @ brick.stable_poses[0].T_table_part
    T_cam = inverse(T_base_cam) @ T_base_part
    others = (("brick", T_cam @ T_cam_part, 0.25), ("unknown", T_cam, 0.05))
    estimate = PartEstimate(
        part="brick",
        T_cam_part=T_cam,
        stable_pose=0,
        score=0.3,
        alternatives=tuple(
            PoseAlternative(part=name, stable_pose=0, T_cam_part=T, probability=p)
            for name, T, p in (("brick", T_cam, 0.7), *others)
        ),
    )
    calibration = Calibration(T_base_board=BOARD, T_base_nests={}, q_park=np.zeros(6), board_half_m=(0.1, 0.1))
    seen = bring_down(estimate, {"brick": brick}, T_base_cam, calibration, ControllerConfig())
    assert [r.probability for r in seen.readings] == pytest.approx([0.3, 0.25 * 0.3 / 0.7])
    np.testing.assert_allclose(seen.readings[0].T_base_part, seen.placed.T_base_part, atol=1e-12)
    np.testing.assert_allclose(seen.readings[1].T_base_part, T_base_part @ T_cam_part, atol=1e-12)


def test_an_accepted_estimate_that_other_looks_contradict_is_declined(brick):
    looks = SecondLooks(SecondLookConfig(), elsewhere=False)
    looks.take_in(USUAL, [candidate(brick, yaw=1.0, score=0.9)])
    (seen,) = looks.take_in(DARK, [candidate(brick, score=0.95, verdict=ACCEPTED)])
    assert seen.problem[0] == "declined" and "disagree" in seen.problem[1]
    assert looks.unsure == 1 and looks.accepted == 0
    (seen,) = looks.take_in(BRIGHT, [candidate(brick, score=0.97, verdict=ACCEPTED)])
    assert seen.problem is None and looks.unsure == 0 and looks.accepted == 1


def test_after_a_push_what_was_seen_before_no_longer_counts(brick):
    looks = SecondLooks(SecondLookConfig(), elsewhere=False)
    before = candidate(brick, yaw=1.0, score=0.9)
    looks.take_in(USUAL, [before])
    looks.pushed(push(before))
    after = candidate(brick, 0.001, score=0.95, verdict=ACCEPTED)
    (seen,) = looks.take_in(USUAL, [after])
    assert seen.problem is None and looks.accepted == 1


def accept_when(condition):
    """A change of estimates that declines them unless ``condition(world)`` holds."""

    def change(estimate):
        return estimate if condition(change.world) else replace(estimate, score=0.6, verdict=AMBIGUOUS)

    return change


def world_that_accepts(brick, condition, places=PLACES[:1], **config):
    change = accept_when(condition)
    change.world = World(brick, places, change, **config)
    return change.world


def kinds(world):
    return [event.kind for event in world.events if isinstance(event, LookedAgain)]


def test_the_second_exposure_settles_it_and_later_parts_are_looked_at_like_that(brick):
    world = world_that_accepts(brick, lambda world: world.camera.exposures[-1] == 1.6, PLACES)
    attempts = world.run()
    assert [(a.outcome, a.view) for a in attempts] == [("placed", "exposure 1.6")] * 3
    assert world.camera.exposures == [1.0, 0.6, 1.6, 1.6, 1.6, 1.6]
    assert [(e.kind, e.unsure, e.accepted) for e in world.events if isinstance(e, LookedAgain)] == [
        ("exposure", 3, 0),
        ("exposure", 3, 3),
    ]
    assert attempts[0].look_time_s == next(e.frame.time_s for e in world.events if isinstance(e, Looked))


def test_a_push_settles_it(brick):
    world = world_that_accepts(brick, lambda world: any(isinstance(e, NudgeFinished) for e in world.events))
    attempts = world.run()
    assert [(a.outcome, a.view) for a in attempts] == [("placed", "usual")]
    assert kinds(world) == ["exposure", "exposure", "exposure", "nudge"]
    (nudge,) = [e.nudge for e in world.events if isinstance(e, NudgeStarted)]
    assert any(np.allclose(T, nudge.T_base_end, atol=1e-6) for T in world.robot.moves)


def test_what_stays_unsure_is_declined_after_all_looks(brick):
    world = world_that_accepts(brick, lambda world: False)
    assert [(a.outcome, a.note, a.tried) for a in world.run()] == [("declined", AMBIGUOUS, False)]
    assert kinds(world) == ["exposure", "exposure", "exposure", "nudge", "nudge"]
    again = [e for e in world.events if isinstance(e, LookedAgain)]
    assert all(e.seconds > 0 and e.accepted == 0 for e in again)
    assert world.camera.exposures[-1] == 1.0


def test_what_is_not_a_part_is_never_pushed(brick):
    world = World(brick, PLACES, lambda e: replace(e, score=0.1, verdict=NOT_A_PART))
    assert [a.note for a in world.run()] == [NOT_A_PART] * 3
    assert kinds(world) == [] and all(T[2, 3] > 0.06 for T in world.robot.moves)


def test_a_push_that_the_robot_refuses_is_told_and_the_run_goes_on(brick):
    world = world_that_accepts(brick, lambda world: False, second_look=SecondLookConfig(looks=("nudge",), nudges=1))
    world.robot.refuse = True
    assert [a.outcome for a in world.run()] == ["declined"]
    (finished,) = [e for e in world.events if isinstance(e, NudgeFinished)]
    assert finished.note == "refused for the test"


def test_accepted_parts_cost_no_other_look(brick):
    world, plain = World(brick), World(brick, second_look=SecondLookConfig(looks=()))
    world.run(), plain.run()
    assert world.camera.exposures == plain.camera.exposures == [1.0] * 4
    assert world.robot.time_s == plain.robot.time_s


def test_configurations_that_make_no_sense_are_refused():
    for values, message in (
        ({"exposures": (1.0,)}, "exposure 1.0"),
        ({"exposures": (-2.0,)}, "exposure -2.0"),
        ({"looks": ("nudge", "nudge")}, "nudge, nudge"),
        ({"nudges": -1}, "nudges -1"),
        ({"agree_above": 1.0}, "agree_above 1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            SecondLookConfig(**values)
