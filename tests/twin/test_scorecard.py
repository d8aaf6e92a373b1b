import json

import numpy as np
import pytest

from perception.bootstrap import clopper_pearson_lower
from twin.events import LookedAgain
from twin.scorecard import (
    FAILURES,
    PartResult,
    PoseError,
    SceneResult,
    build_scorecard,
    summarise,
    write_json,
)


def result(instance: int, *, succeeded: bool, failure: str | None = None, error: PoseError | None = None) -> PartResult:
    return PartResult(
        scene=0,
        instance=instance,
        part="main",
        stable_pose=0,
        attempted=failure not in ("detection", "declined"),
        attempts=1,
        picked=succeeded,
        placed=succeeded,
        succeeded=succeeded,
        failure=failure,
        note="",
        pose_error=error,
    )


def test_clopper_pearson_bounds_agree_with_published_values():
    assert clopper_pearson_lower(30, 30) == pytest.approx(0.05 ** (1 / 30))  # closed form when nothing failed
    assert clopper_pearson_lower(299, 299) >= 0.99 > clopper_pearson_lower(297, 297)
    assert clopper_pearson_lower(0, 10) == 0.0
    assert clopper_pearson_lower(8, 10) == pytest.approx(0.4931, abs=1e-4)


def test_a_part_that_was_skipped_counts_against_the_rate():
    scene = SceneResult(
        scene=0,
        parts=(
            result(0, succeeded=True),
            result(1, succeeded=True),
            result(2, succeeded=False, failure="declined"),
            result(3, succeeded=False, failure="detection"),
        ),
        cycle_s=(8.0, 10.0),
        retries=0,
    )
    card = build_scorecard([scene], config={})
    assert card["picks"]["presented"] == 4
    assert card["picks"]["attempted"] == 2
    assert card["picks"]["success_rate"] == 0.5
    assert card["failures"]["declined"] == card["failures"]["detection"] == 1
    assert set(card["failures"]) == set(FAILURES)
    assert card["picks_per_hour"] == pytest.approx(400.0)


def test_other_looks_are_counted_by_kind():
    exposure = LookedAgain(kind="exposure", unsure=2, accepted=1, seconds=1.1)
    nudge = LookedAgain(kind="nudge", unsure=1, accepted=0, seconds=5.0)
    scenes = [
        SceneResult(scene=0, parts=(), cycle_s=(), retries=0, looked_again=(exposure, nudge)),
        SceneResult(scene=1, parts=(), cycle_s=(), retries=0, looked_again=(exposure,)),
    ]
    assert build_scorecard(scenes, config={})["second_looks"] == {
        "exposure": {"looks": 2, "accepted": 2, "seconds": 2.2},
        "nudge": {"looks": 1, "accepted": 0, "seconds": 5.0},
    }


def test_every_failed_part_has_one_cause():
    parts = tuple(result(i, succeeded=False, failure=f) for i, f in enumerate(FAILURES))
    card = build_scorecard([SceneResult(scene=0, parts=parts, cycle_s=(), retries=0)], config={})
    assert sum(card["failures"].values()) == card["picks"]["presented"] - card["picks"]["succeeded"]


def test_errors_are_given_strictly_and_with_the_branch_right():
    def error(theta: float, right: bool) -> PoseError:
        return PoseError(e_x_mm=0.1, e_y_mm=0.2, e_z_mm=0.3, e_theta_deg=theta, branch_right=right, class_right=True)

    parts = (
        result(0, succeeded=True, error=error(1.0, True)),
        result(1, succeeded=False, failure="pose", error=error(180.0, False)),
    )
    card = build_scorecard([SceneResult(scene=0, parts=parts, cycle_s=(), retries=0)], config={})
    assert card["pose_error"]["all"]["e_theta_deg"]["mean"] == pytest.approx(90.5)
    assert card["pose_error"]["all"]["branch_right"] == 0.5
    assert card["pose_error_branch_right"]["main"]["e_theta_deg"]["mean"] == 1.0


def test_summary_of_nothing_is_no_number():
    assert summarise([]) == {"mean": None, "std": None, "median": None, "p95": None, "n": 0}
    assert summarise([1.0, 3.0])["mean"] == 2.0


def test_a_failed_write_keeps_the_file_that_was_there(tmp_path):
    path = tmp_path / "scorecard.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": np.array([1])})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["scorecard.json"]
