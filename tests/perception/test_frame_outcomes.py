"""Which estimate belongs to which part, and what is said about it."""

from dataclasses import replace

import numpy as np
import pytest
from made_frames import LAYOUT, estimate_of, frame_of, moved, pose_of, seen

from perception.estimates import NOT_A_PART, PoseAlternative
from perception.faces import FaceTable
from perception.frame_outcomes import Judge
from perception.outcomes import COMPARISONS

JUDGE = Judge(method="m", domain="classic", table=FaceTable.load())
IMAGE = np.full((700, 1000, 3), 90, np.uint8)
CUT = ("top", 0, 0.0, 0.0245, 0.0)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return frame_of(tmp_path_factory.mktemp("frame") / "data", LAYOUT)


@pytest.fixture(scope="module")
def with_cut(tmp_path_factory):
    return frame_of(tmp_path_factory.mktemp("cut") / "data", [*LAYOUT, CUT])


def rows(truth, *estimates):
    return JUDGE.outcomes(truth, IMAGE, seen(*estimates))


def test_right_estimates_have_no_errors(truth) -> None:
    found = rows(truth, *(estimate_of(part) for part in reversed(truth.parts)))
    assert [(o.part, o.stable_pose, o.instance) for o in found] == [("inserted", 0, 0), ("main", 1, 1), ("main", 2, 2)]
    for o, placed in zip(found, LAYOUT, strict=True):
        assert o.detected and o.accepted and o.whole and o.is_part and o.iou > 0.999
        assert o.class_right and o.face_right and o.branch_right and o.branch_right_equivalent and not o.flipped
        assert o.errors is not None and o.raw_errors is not None
        for comparison in COMPARISONS:
            assert max(o.errors[comparison].values()) < 1e-6
            assert o.raw_errors[comparison]["e_z_mm"] == pytest.approx(20.0)
        assert o.mssd_mm == pytest.approx(0.0, abs=1e-9) and o.yaw_error_deg == pytest.approx(0.0, abs=1e-6)
        assert o.brightness == 90.0 and np.hypot(o.x_board_mm - 1e3 * placed[2], o.y_board_mm - 1e3 * placed[3]) < 3.0


def test_errors_are_those_made(truth) -> None:
    part = truth.parts[1]
    (o,) = [o for o in rows(truth, estimate_of(part, moved(part, 4e-4, -3e-4, np.radians(2.0)))) if o.detected]
    assert o.errors is not None
    assert o.errors["symmetric"] == pytest.approx(
        {"e_x_mm": 0.4, "e_y_mm": 0.3, "e_z_mm": 0.0, "e_theta_deg": 2.0}, abs=1e-9
    )
    assert o.branch_right and abs(o.yaw_error_deg or 0.0) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("yaw_deg", "branch", "flipped"), [(5.9, True, False), (-6.1, False, False), (170, False, True)]
)
def test_the_branch_is_the_yaw_within_six_degrees(truth, yaw_deg, branch, flipped) -> None:
    name, stable_pose, x, y, yaw = LAYOUT[0]
    turned = pose_of((name, stable_pose, x, y, yaw + np.radians(yaw_deg)))
    o = rows(truth, estimate_of(truth.parts[0], turned))[0]
    assert o.detected and o.face_right and o.branch_right is branch and o.flipped is flipped
    assert abs(o.yaw_error_deg or 0.0) == pytest.approx(abs(yaw_deg))


def test_another_face_and_another_class_are_wrong_branches(truth) -> None:
    part = truth.parts[1]
    face = rows(truth, estimate_of(part, stable_pose=0))[1]
    assert face.class_right and not face.face_right and not face.branch_right and face.yaw_error_deg is None
    other = rows(truth, replace(estimate_of(part), part="top"))[1]
    assert other.detected and other.estimated_part == "top"
    assert not (other.class_right or other.face_right or other.branch_right or other.branch_right_equivalent)
    assert other.mssd_mm is None and other.errors is not None and other.errors["strict"] == other.errors["equivalent"]


def test_missed_parts_say_so_and_tell_a_rejected_estimate(truth) -> None:
    found = rows(truth, estimate_of(truth.parts[0], verdict=NOT_A_PART))
    assert [o.verdict for o in found] == [NOT_A_PART, "missed", "missed"]
    assert not any(o.detected or o.accepted for o in found) and len(found) == 3


def test_a_detection_of_nothing_is_a_row_of_its_own(truth) -> None:
    part = truth.parts[0]
    found = rows(truth, estimate_of(part), estimate_of(part, moved(part, 0.02, 0.0)))
    assert len(found) == 4
    stray = found[-1]
    assert not stray.is_part and stray.instance == -1 and stray.part == "" and stray.accepted and stray.whole
    assert stray.estimated_part == "inserted" and stray.errors is None


def test_a_second_estimate_of_a_part_belongs_to_none_and_the_best_score_is_first(truth) -> None:
    part = truth.parts[0]
    off = moved(part, 2e-4, 0.0)
    found = rows(truth, estimate_of(part, off, score=0.5), estimate_of(part, score=0.8))
    assert found[0].errors is not None and found[0].errors["strict"]["e_x_mm"] < 1e-6
    assert [o.score for o in found if not o.is_part] == [0.5]


@pytest.mark.parametrize(("off_m", "belongs"), [(1.9e-3, True), (2.1e-3, False)])
def test_without_a_mask_the_centre_decides(truth, off_m, belongs) -> None:
    part = truth.parts[2]
    o = rows(truth, estimate_of(part, moved(part, off_m), mask=None))[2]
    assert o.detected is belongs and o.iou == 0.0


def test_a_pose_on_the_line_of_sight_belongs_whatever_its_depth(truth) -> None:
    part = truth.parts[0]
    T = part.T_cam_part.copy()
    T[:3, 3] *= 1.2  # 140 mm too far, 4 mm off across
    assert rows(truth, estimate_of(part, T, mask=None))[0].detected


def test_parts_that_the_border_cuts_are_apart(with_cut) -> None:
    cut = with_cut.parts[3]
    assert cut.visible_share < 1.0 and not cut.whole and all(part.whole for part in with_cut.parts[:3])
    found = rows(with_cut, estimate_of(cut), estimate_of(cut, moved(cut, 5e-4), score=0.3))
    assert found[3].detected and not found[3].whole
    assert not found[4].is_part and not found[4].whole


def test_raw_poses_that_are_not_known_have_no_errors(truth) -> None:
    assert rows(truth, estimate_of(truth.parts[0], raw_T_cam_part=None))[0].raw_errors is None


def test_details_that_are_no_numbers_are_left_out(truth) -> None:
    o = rows(truth, estimate_of(truth.parts[0], details={"lead": np.float32(2.0), "lost": float("nan")}))[0]
    assert o.details == {"lead": 2.0}


def test_a_view_that_leaves_the_right_pose_open_is_not_lost(truth) -> None:
    name, stable_pose, x, y, yaw = LAYOUT[1]
    turned = pose_of((name, stable_pose, x, y, yaw + np.pi))
    part = truth.parts[1]
    wrong = PoseAlternative(part=name, stable_pose=stable_pose, T_cam_part=turned, probability=0.6)
    right = replace(wrong, T_cam_part=part.T_cam_part, probability=0.4)
    o = rows(truth, estimate_of(part, turned, alternatives=(wrong, right)))[1]
    assert (o.readings, o.reading_right, o.branch_right) == (2, True, False)
    o = rows(truth, estimate_of(part, turned, alternatives=(wrong,)))[1]
    assert (o.readings, o.reading_right) == (1, False)
    assert rows(truth, estimate_of(part))[1].reading_right
