import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh

from cad.spatial import rotation_x, transform
from twin.grasp_search import find_grasps
from twin.grasp_trial import TrialBench, TrialConfig


@pytest.fixture(scope="module")
def bench(planned_brick):
    return TrialBench(planned_brick)


@pytest.fixture(scope="module")
def grasp(planned_brick):
    return find_grasps(planned_brick, planned_brick.stable_poses[0]).grasps[0]


def test_a_brick_held_by_its_faces_neither_shifts_nor_slips(bench, grasp):
    trial = bench.run(grasp)
    assert trial.held and not trial.why
    assert max(trial.shift_m, trial.slip_m, trial.place_m) < 30e-6
    assert max(trial.shift_rad, trial.place_rad) < np.deg2rad(0.5)


def test_the_same_trial_ends_the_same(bench, grasp):
    assert bench.run(grasp, whole=False) == bench.run(grasp, whole=False)


def test_slippery_pads_lose_the_part(planned_brick, grasp):
    trial = TrialBench(planned_brick, TrialConfig(pad_friction=1e-4)).run(grasp)
    assert not trial.held and trial.why


def test_a_hand_far_off_fails_and_one_a_little_off_does_not(bench, grasp):
    along = bench.run(grasp, (0.0, 9e-3, 0.0))
    assert not along.held and "without a grip" in along.why
    across = bench.run(grasp, (4.0e-3, 0.0, 0.0))
    assert not across.held and "on the way down" in across.why
    with ThreadPoolExecutor(1) as pool:
        assert bench.margin(grasp, pool) == 1.0


def test_closing_centres_the_part_across_the_pads_only(bench, grasp):
    across = bench.run(grasp, (0.3e-3, 0.0, 0.0), whole=False)
    along = bench.run(grasp, (0.0, 0.3e-3, 0.0), whole=False)
    assert across.held and across.shift_m < 50e-6
    assert along.held and along.shift_m == pytest.approx(0.3e-3, abs=50e-6)


@pytest.mark.parametrize("turn_deg", [0.5, 1.0, 3.0])
def test_closing_askew_turns_the_part_square_without_throwing_it(bench, grasp, turn_deg):
    turned = bench.run(grasp, (0.0, 0.0, np.deg2rad(turn_deg)), whole=False)
    assert turned.held and turned.shift_m < 0.2e-3 and turned.shift_rad < np.deg2rad(2.0)


def test_a_grasp_for_another_width_is_not_taken_for_a_grip(bench, grasp):
    trial = bench.run(dataclasses.replace(grasp, width_m=grasp.width_m - 1e-3))
    assert not trial.held and "without a grip" in trial.why


def test_a_lying_rod_is_held_and_put_down(make_part):
    rod = trimesh.creation.cylinder(radius=1e-3, height=6e-3, sections=64)
    rod.apply_transform(transform(rotation_x(np.pi / 2)))
    roll = {"axis": [0, 1, 0], "offset": [0, 0, 0]}
    pose = {"R_table_part": np.eye(3).tolist(), "t_table_part_m": [0, 0, 1e-3], "probability": 1.0, "roll": roll}
    part = make_part(rod, "rod", poses=[pose])
    lines = [g for g in find_grasps(part, part.stable_poses[0]).grasps if g.contact.roll > 0.5]
    trial = TrialBench(part).run(lines[0])
    assert trial.held, trial.why
    assert trial.slip_m < 0.1e-3


def test_settings_that_make_no_sense_are_named():
    with pytest.raises(ValueError, match=r"pad_friction -1"):
        TrialConfig(pad_friction=-1.0)
