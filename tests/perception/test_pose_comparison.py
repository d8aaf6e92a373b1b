"""Poses against the truth modulo symmetries and equal views, and whether normalised errors are chi-square."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose, ViewEquivalent, planar
from cad.spatial import Array, rotation_from_rotvec, rotation_x, rotation_z, transform
from perception.estimates import PartEstimate, PerceptionError
from perception.faces import FaceTable
from perception.ground_truth import TruePart
from perception.pose_comparison import (
    as_raw,
    choice_of,
    errors_by_comparison,
    normalised_errors_squared,
    same_views,
    surface_error_mm,
)

T_CAM_BOARD = transform(rotation_x(np.pi - 0.02), [0.01, 0.0, 0.7])
HALF_TURN = ViewEquivalent(stable_pose=0, yaw=np.pi, shift_m=(1e-3, 0.0))


def true_part(part: Part, yaw: float = 0.4) -> TruePart:
    T = T_CAM_BOARD @ planar(0.02, -0.01, yaw) @ part.stable_poses[0].T_table_part
    return TruePart(number=0, part=part, stable_pose=0, T_cam_part=T, runs={}, visible_share=1.0, whole=True)


def with_views(part: Part, *views: ViewEquivalent) -> Part:
    poses: list[StablePose] = [replace(p, view_equivalents=views if p.index == 0 else ()) for p in part.stable_poses]
    return replace(part, stable_poses=tuple(poses))


def estimate(part: Part, T: Array, stable_pose: int = 0, covariance: Array | None = None) -> PartEstimate:
    given = np.zeros((6, 6)) if covariance is None else covariance
    return PartEstimate(part=part.name, T_cam_part=T, stable_pose=stable_pose, score=1.0, covariance=given)


def test_a_symmetric_pose_is_only_strictly_wrong(plain_box) -> None:
    part = with_views(replace(plain_box, symmetries=Symmetries(discrete=transform(rotation_z(np.pi))[None])))
    truth = true_part(part)
    turned = truth.T_cam_part @ transform(rotation_z(np.pi))
    views = same_views(truth, FaceTable([part]))
    errors = errors_by_comparison(truth, views, part.name, turned)
    assert errors["strict"]["e_theta_deg"] == pytest.approx(180.0)
    assert errors["symmetric"]["e_theta_deg"] == errors["equivalent"]["e_theta_deg"] == pytest.approx(0.0, abs=1e-6)
    choice = choice_of(truth, views, estimate(part, turned), T_CAM_BOARD)
    assert choice.branch_right and choice.branch_right_equivalent
    assert surface_error_mm(truth, estimate(part, turned)) == pytest.approx(0.0, abs=1e-9)


def test_a_pose_that_looks_the_same_is_right_only_modulo_the_view(plain_box) -> None:
    part = with_views(plain_box, HALF_TURN)
    truth = true_part(part)
    views = same_views(truth, FaceTable([part]))
    assert len(views) == 2
    twin = T_CAM_BOARD @ planar(0.02, -0.01, 0.4) @ planar(1e-3, 0.0, np.pi) @ part.stable_poses[0].T_table_part
    errors = errors_by_comparison(truth, views, part.name, twin)
    assert errors["symmetric"]["e_theta_deg"] == pytest.approx(180.0)
    assert max(errors["equivalent"].values()) < 1e-6
    choice = choice_of(truth, views, estimate(part, twin), T_CAM_BOARD)
    assert choice.face_right and not choice.branch_right and choice.branch_right_equivalent
    assert abs(choice.yaw_error_deg or 0.0) == pytest.approx(180.0)


def test_another_face_may_look_the_same(stepped) -> None:
    part = with_views(stepped, ViewEquivalent(stable_pose=1, yaw=0.5, shift_m=(0.0, 0.0)))
    truth = true_part(part)
    views = same_views(truth, FaceTable([part]))
    other = T_CAM_BOARD @ planar(0.02, -0.01, 0.9) @ part.stable_poses[1].T_table_part
    choice = choice_of(truth, views, estimate(part, other, stable_pose=1), T_CAM_BOARD)
    assert not choice.face_right and not choice.branch_right and choice.branch_right_equivalent


def test_parts_must_say_what_looks_alike(plain_box) -> None:
    untold = replace(plain_box, stable_poses=tuple(replace(p, view_equivalents=None) for p in plain_box.stable_poses))
    with pytest.raises(PerceptionError, match="which poses look alike"):
        same_views(true_part(untold), FaceTable([untold]))


def test_normalised_errors_are_chi_square_when_the_covariance_holds(plain_box) -> None:
    truth, rng, n = true_part(plain_box), np.random.default_rng(1), 600
    spread = np.diag([2e-5, 3e-5, 1e-5, 1e-3, 2e-3, 4e-3]) @ rng.normal(size=(6, 6))
    covariance = spread @ spread.T
    found = []
    for error in rng.multivariate_normal(np.zeros(6), covariance, n):
        T = truth.T_cam_part.copy()
        T[:3, :3] = rotation_from_rotvec(error[3:]) @ T[:3, :3]
        T[:3, 3] += error[:3]
        found.append(normalised_errors_squared(truth, estimate(plain_box, T, covariance=covariance), T_CAM_BOARD))
    for values, freedom in zip(np.array(found, float).T, (6, 3), strict=True):
        low, high = chi2.ppf([0.001, 0.999], freedom * n) / n
        assert low < values.mean() < high


def test_no_covariance_no_normalised_error(plain_box) -> None:
    truth = true_part(plain_box)
    assert normalised_errors_squared(truth, estimate(plain_box, truth.T_cam_part), T_CAM_BOARD) == (None, None)
    indefinite = np.eye(6)
    indefinite[0, 1] = indefinite[1, 0] = 2.0
    stated = estimate(plain_box, truth.T_cam_part, covariance=indefinite)
    assert normalised_errors_squared(truth, stated, T_CAM_BOARD)[0] is None


def test_the_raw_pose_takes_the_place_of_the_refined_one(plain_box) -> None:
    truth = true_part(plain_box)
    raw = np.eye(4)
    found = as_raw(replace(estimate(plain_box, truth.T_cam_part, covariance=np.eye(6)), raw_T_cam_part=raw))
    assert found is not None and (found.T_cam_part == raw).all() and not found.covariance.any()
    assert as_raw(estimate(plain_box, truth.T_cam_part)) is None
