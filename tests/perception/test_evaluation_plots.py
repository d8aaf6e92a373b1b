"""Plots of an evaluation: what they are drawn from is right, and each is written whatever happened."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_outcomes import made_outcomes

from perception.evaluation_curves import risk_coverage
from perception.evaluation_maps import confusion
from perception.evaluation_plots import PLOTS, write_plots
from perception.failure_kinds import FALSE, FLIP, KINDS, MISSED, WRONG_CLASS, failure_kind, worst_failures
from perception.outcomes import Outcome


def part(score: float, right: bool = True, **changes: object) -> Outcome:
    about = {"method": "tagcell", "domain": "classic", "image": 0, "instance": 0, "part": "top", "stable_pose": 1}
    seen = {"detected": True, "estimated_part": "top", "estimated_stable_pose": 1, "class_right": True}
    seen |= {"face_right": True, "branch_right": right, "branch_right_equivalent": right, "score": score}
    return Outcome(**(about | seen | {"yaw_error_deg": 0.0 if right else 179.0} | changes))  # type: ignore[arg-type]


def stray(score: float, **changes: object) -> Outcome:
    return replace(part(score), instance=-1, part="", stable_pose=-1, detected=False, **changes)  # type: ignore[arg-type]


def test_risk_is_counted_down_the_scores_over_all_whole_parts():
    missed = replace(part(0.0), detected=False, class_right=False)
    rows = [part(0.9), part(0.8, right=False), part(0.7), missed, stray(0.75), part(0.95, right=False, whole=False)]
    coverage, bad, wrong = risk_coverage(rows)
    np.testing.assert_allclose(coverage, [0.25, 0.5, 0.5, 0.75])
    np.testing.assert_allclose(wrong, [0, 1 / 2, 1 / 2, 1 / 3])
    np.testing.assert_allclose(bad, [0, 1 / 2, 2 / 3, 2 / 4])


def test_equal_scores_are_accepted_together():
    coverage, _, wrong = risk_coverage([part(0.5, right=False), part(0.5), part(0.5), part(0.2)])
    np.testing.assert_allclose(coverage, [0.75, 1.0])
    np.testing.assert_allclose(wrong, [1 / 3, 1 / 4])
    assert all(a.size == 0 for a in risk_coverage([]))


def test_every_part_is_in_one_place_of_the_confusion_matrix():
    rows = [
        part(0.9),
        part(0.9, right=False),
        replace(part(0.1), detected=False, estimated_part="", class_right=False),
        part(0.8, right=False, estimated_part="main", estimated_stable_pose=2, class_right=False, face_right=False),
        stray(0.3),
        stray(0.3, whole=False),
    ]
    true, found, counts = confusion(rows)
    assert true == ["main 2", "top 1", "no part"] and found == ["main 2", "top 1", "turned", "missed"]
    np.testing.assert_array_equal(counts, [[0, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 0]])
    many = made_outcomes("tagcell", 300, 3)
    counted = confusion(many)[2]
    assert counted[:-1].sum() == sum(o.whole and o.is_part for o in many)
    assert counted[-1].sum() == sum(not o.is_part for o in many)


def test_failures_have_kinds_and_what_is_right_or_cut_has_none():
    assert failure_kind(part(0.9)) is None
    assert failure_kind(part(0.9, right=False)) == FLIP
    assert failure_kind(part(0.9, right=False, yaw_error_deg=-20.0)) == "turned"
    assert failure_kind(part(0.9, right=False, face_right=False)) == "wrong face"
    assert failure_kind(part(0.9, right=False, class_right=False)) == WRONG_CLASS
    assert failure_kind(part(0.9, right=False, whole=False)) is None
    assert failure_kind(replace(part(0.9), detected=False)) == MISSED
    assert failure_kind(stray(0.9)) is None
    assert failure_kind(stray(0.9, accepted=True)) == FALSE
    assert failure_kind(part(0.9, right=False, branch_right_equivalent=True)) is None


def test_the_worst_failures_show_every_kind_and_the_accepted_first():
    rows = [replace(part(0.0), image=i, detected=False, class_right=False) for i in range(50)]
    rows += [part(0.3, right=False, image=7), part(0.2, right=False, image=8, accepted=True), stray(0.9, accepted=True)]
    kept = worst_failures(rows, 10)
    assert [kind for kind, _ in kept] == [FLIP, FLIP, FALSE] + [MISSED] * 7
    assert [o.image for _, o in kept[:2]] == [8, 7]
    assert [kind for kind, _ in worst_failures(rows, 3)] == [FLIP, FALSE, MISSED]
    assert [KINDS.index(k) for k, _ in kept] == sorted(KINDS.index(k) for k, _ in kept)


@pytest.mark.parametrize("case", ["several methods", "nothing found"])
def test_all_plots_are_written_as_pictures(tmp_path, case):
    rows = {
        "several methods": made_outcomes("tagcell", 60, 1) + made_outcomes("pvnet", 60, 1),
        "nothing found": [replace(part(0.0), detected=False, estimated_part="", class_right=False)],
    }[case]
    written = write_plots(rows, tmp_path / "plots")
    methods = {o.method for o in rows}
    assert {p.name for p in written} == {f"{n}.png" for n in [*PLOTS, *(f"confusion_{m}" for m in methods)]}
    assert sorted(p.name for p in (tmp_path / "plots").iterdir()) == sorted(p.name for p in written)
    for path in written:
        image = cv2.imread(str(path))
        assert image is not None and image.std() > 1


def test_no_outcomes_are_an_error(tmp_path):
    with pytest.raises(ValueError, match="nothing to draw"):
        write_plots([], tmp_path)
