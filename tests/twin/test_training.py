"""``tagcell train``: which data and how long for which network, what is kept, and how lanes fail."""

from __future__ import annotations

from pathlib import Path
from typing import get_type_hints

import pytest

from perception.train import trainer
from scenes.recipes import load_recipe
from twin.robot import TwinError
from twin.training import LANES, TRAINING_DATA, VALIDATION_DATA, TrainPlan, settings
from twin.training_lanes import run_lanes


def plan(tmp_path: Path, minutes: float = 60.0, seed: int = 0, threads: int = 2) -> TrainPlan:
    return TrainPlan(data=tmp_path / "data", out=tmp_path / "out", minutes=minutes, seed=seed, threads=threads)


@pytest.mark.parametrize(
    ("wrong", "told"), [({"minutes": 0.0}, "minutes"), ({"seed": -1}, "seed"), ({"threads": 0}, "threads")]
)
def test_wrong_values_are_named(tmp_path: Path, wrong: dict[str, float], told: str) -> None:
    with pytest.raises(TwinError, match=told):
        plan(tmp_path, **wrong)  # type: ignore[arg-type]


def test_splits_never_mix() -> None:
    """Networks learn from the split train alone, and are validated, chosen and gated on val alone."""
    assert {load_recipe(name).split for name in TRAINING_DATA} == {"train"}
    assert {load_recipe(name).split for name in VALIDATION_DATA} == {"val"}
    for lane in LANES:
        for job in lane:
            assert set(job.data) <= set(TRAINING_DATA)
            assert set(job.val) <= set(VALIDATION_DATA)


def test_recipes_have_seeds_of_their_own() -> None:
    seeds = [load_recipe(name).seed for name in (*TRAINING_DATA, *VALIDATION_DATA)]
    assert len(set(seeds)) == len(seeds)


def test_a_short_run_renders_less_to_learn_from_and_as_much_to_judge_by(tmp_path: Path) -> None:
    long, short = plan(tmp_path), plan(tmp_path, minutes=30.0)
    for name in TRAINING_DATA:
        full, half = long.dataset(name).count, short.dataset(name).count
        assert full == load_recipe(name).count
        assert half is not None and full is not None and half == round(full / 2)
    for name in VALIDATION_DATA:
        assert long.dataset(name) == short.dataset(name)


def test_the_seed_changes_all_data(tmp_path: Path) -> None:
    one, other = plan(tmp_path), plan(tmp_path, seed=1)
    for name in (*TRAINING_DATA, *VALIDATION_DATA):
        assert one.dataset(name).seed != other.dataset(name).seed


def test_lanes_share_time_and_threads(tmp_path: Path) -> None:
    """On two threads both lanes take all of the time; on one they share it."""
    for threads in (1, 2):
        wanted = plan(tmp_path, minutes=40.0, threads=threads)
        minutes = [sum(settings(wanted, job)["minutes"] for job in lane) for lane in LANES]
        assert minutes == pytest.approx([40.0, 40.0] if threads == 2 else [20.0, 20.0])
        assert all(settings(wanted, job)["threads"] == 1 for lane in LANES for job in lane)


def test_every_network_takes_its_settings(tmp_path: Path) -> None:
    for lane in LANES:
        for job in lane:
            said = settings(plan(tmp_path), job)
            config = get_type_hints(trainer(job.network))["config"](**said)
            assert config.minutes == said["minutes"]


def test_a_lane_that_fails_says_why(tmp_path: Path) -> None:
    job = LANES[1][2]
    with pytest.raises(TwinError, match=r"training keypoints: no dataset\.json in .*train_crops"):
        run_lanes([[(job.network, settings(plan(tmp_path), job))]], at_once=1)
