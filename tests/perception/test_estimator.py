from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from cad.parts import planar
from cad.spatial import BASLER, apply
from perception.choice import FEATURES, GATE_FEATURES, ChoiceWeights
from perception.crop_poses import CropPose, CropPoseConfig, CropSolver
from perception.estimates import ACCEPTED, AMBIGUOUS, NOT_A_PART, Frame, PartEstimate, PerceptionError
from perception.estimator import EstimatorConfig, LearnedEstimator, cut_crops, drop_repeated
from perception.faces import FaceTable
from perception.posenets import CropKeypoints, CropReading, Hypothesis, PoseNets
from perception.segmentation import Detection
from perception.sighting import Sighting
from perception.silhouette import render_view, silhouette_mask

WEIGHTS = ChoiceWeights(
    choice=dict.fromkeys(FEATURES, 0.0) | {"matched_fraction": 10.0, "region_unexplained": -80.0, "keypoints": 0.3},
    gate=dict.fromkeys(GATE_FEATURES, 0.0) | {"constant": -2.0, "lead": 1.5, "matched_fraction": 4.0},
    rivalry={"constant": 0.0, "lead": 1.0},
    part=dict.fromkeys(GATE_FEATURES, 0.0) | {"is_part": 1.0},
    accept_above=0.5,
)


class StubNets:
    """Proposes the truth, its half turn and the other face, equally likely, and votes the true keypoints."""

    def __init__(self, part, picture, not_a_part=0.01, order=(2, 1, 0)):
        self.table = FaceTable([part])
        self.part, self.picture, self.not_a_part, self.order = part, picture, not_a_part, order

    def hypotheses(self, crops, rays):
        p, small = self.picture, self.picture.intrinsics.downscaled(2)
        readings = [(0, p.yaw), (0, p.yaw + np.pi), (1, p.yaw)]
        found = []
        for i in self.order:
            face, yaw = readings[i]
            centre = small.project(apply(p.T_cam_table, [p.x + 1e-4, p.y - 1e-4, self.table[face].middle_m]))
            found.append(
                Hypothesis(
                    part=self.part.name,
                    stable_pose=face,
                    yaw=yaw + 0.03,
                    centre_px=(float(centre[0]), float(centre[1])),
                    classifier=-1.0,
                )
            )
        reading = CropReading(
            hypotheses=tuple(found), not_a_part=self.not_a_part, class_probabilities={self.part.name: 1.0}
        )
        return [reading] * len(crops)

    def verify(self, crops, rays, readings):
        return readings

    def keypoints(self, crops, rays, faces):
        p, small = self.picture, self.picture.intrinsics.downscaled(2)
        out = []
        for _, face in faces:
            T = p.T_cam_table @ planar(p.x, p.y, p.yaw) @ self.part.stable_poses[face].T_table_part
            pixels = small.project(apply(T, self.part.keypoints))
            covariances = np.tile(np.eye(2), (len(pixels), 1, 1))
            out.append(CropKeypoints(pixels=pixels, covariances=covariances, mask=np.zeros((64, 64))))
        return out


def solver_for(part, picture, **kwargs) -> CropSolver:
    return CropSolver(cast(PoseNets, StubNets(part, picture, **kwargs)), WEIGHTS, CropPoseConfig())


def colour(picture) -> Any:
    return np.repeat(picture.gray[..., None], 3, axis=2)


def sighting(part, picture) -> Sighting:
    T_cam_part = picture.T_cam_table @ planar(picture.x, picture.y, picture.yaw) @ part.stable_poses[0].T_table_part
    mask = render_view(part, T_cam_part, picture.intrinsics.downscaled(2)).mask
    return Sighting(score=0.9, class_probabilities={part.name: 1.0}, mask=mask, cut=False)


def solve(solver, picture, seconds=None) -> list[CropPose]:
    seen = sighting(solver.nets.part, picture)
    return solver.solve(colour(picture)[None], [picture.intrinsics], picture.T_cam_table, [seen], 0.1, seconds)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)])
def test_the_right_reading_is_chosen_whatever_their_order(stepped, picture_of, order) -> None:
    picture = picture_of(stepped, 0, seed=31)
    seconds: dict[str, float] = {}
    solver = solver_for(stepped, picture, order=order)
    (pose,) = solve(solver, picture, seconds)
    assert len(pose.candidates) >= 3
    winner = pose.winner
    assert winner.face.stable_pose.index == 0
    assert np.hypot(winner.refinement.x - picture.x, winner.refinement.y - picture.y) < 2e-5
    assert abs(winner.refinement.yaw - picture.yaw) < np.radians(0.1)
    assert pose.probability > 0.5
    assert set(seconds) == {"networks", "keypoints", "refinement"}


def test_no_crops_give_no_poses(stepped, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=32)
    assert solver_for(stepped, picture).solve(np.zeros((0, 256, 256, 3), np.uint8), [], np.eye(4), [], 0.1) == []


def test_crops_of_another_size_are_errors(stepped, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=32)
    with pytest.raises(ValueError, match="expected 256"):
        solver_for(stepped, picture).solve(
            np.zeros((1, 128, 128, 3), np.uint8), [picture.intrinsics], np.eye(4), [sighting(stepped, picture)], 0.1
        )


@pytest.fixture(scope="module")
def estimator(stepped, picture_of):
    """An estimator without networks, for what comes after them."""
    bare = object.__new__(LearnedEstimator)
    bare.config = EstimatorConfig()
    picture = picture_of(stepped, 0, seed=33)
    bare.solver = solver_for(stepped, picture)
    bare.part_names = (stepped.name,)
    (pose,) = solve(bare.solver, picture)
    return bare, pose, picture


def test_outcome_carries_pose_covariance_mask_and_raw_pose(estimator) -> None:
    bare, pose, picture = estimator
    frame = Frame(image=np.zeros((8, 8, 3), np.uint8), intrinsics=BASLER, time_s=0.0)
    found = bare._estimate(frame, pose, picture.intrinsics, picture.T_cam_table)
    part = pose.winner.face.part
    truth = picture.T_cam_table @ planar(picture.x, picture.y, picture.yaw) @ part.stable_poses[0].T_table_part
    np.testing.assert_allclose(found.T_cam_part, truth, atol=2e-3)
    assert np.linalg.norm(found.T_cam_part[:3, 3] - truth[:3, 3]) < 3e-5
    assert found.accepted
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert found.raw_T_cam_part is not None
    assert np.linalg.norm(found.raw_T_cam_part[:3, 3] - truth[:3, 3]) < 1e-3  # the stub's keypoints are exact
    mask, origin = silhouette_mask(part, truth, BASLER)
    assert origin == pytest.approx(found.mask_origin, abs=1)
    assert found.mask is not None and found.mask.sum() == pytest.approx(mask.sum(), rel=0.01)


def test_verdicts_name_the_reason(estimator) -> None:
    bare, pose, _ = estimator
    assert bare._verdict(pose, 1) == ACCEPTED
    assert bare._verdict(pose, 2) == AMBIGUOUS
    assert bare._verdict(replace(pose, part_probability=0.1), 1) == NOT_A_PART
    close = pose.gate_evidence.copy()
    close[GATE_FEATURES.index("lead")] = 0.0
    doubtful = replace(pose, gate_evidence=close, probability=float(WEIGHTS.probability_right(close)) * 0.1)
    assert bare._verdict(doubtful, 1) == AMBIGUOUS
    bare.part_names = ("another",)
    assert bare._verdict(pose, 1) == "unexpected part"
    bare.part_names = ("stepped",)


def estimate_at(u: int, v: int, score: float, verdict: str = "accepted") -> PartEstimate:
    mask = np.ones((40, 60), bool)
    return PartEstimate(
        part="a", T_cam_part=np.eye(4), stable_pose=0, score=score, verdict=verdict, mask=mask, mask_origin=(u, v)
    )


def test_a_part_seen_twice_is_reported_once() -> None:
    found = [estimate_at(100, 100, 0.6), estimate_at(110, 105, 0.9), estimate_at(300, 100, 0.2, "ambiguous")]
    kept = drop_repeated(found, 0.3)
    assert [e.score for e in kept] == [0.9, 0.2]
    declined_first = drop_repeated([estimate_at(0, 0, 0.99, "ambiguous"), estimate_at(5, 5, 0.7)], 0.3)
    assert [e.score for e in declined_first] == [0.7]
    assert len(drop_repeated([estimate_at(0, 0, 0.9), estimate_at(55, 35, 0.8)], 0.3)) == 2


def test_crops_stay_inside_the_frame() -> None:
    image = np.zeros((600, 800, 3), np.uint8)
    cv2.circle(image, (5, 590), 3, (255, 255, 255), -1)
    frame = Frame(image=image, intrinsics=replace(BASLER, width=800, height=600), time_s=0.0)
    detections = [
        Detection(
            centre_px=np.array(c),
            score=1.0,
            class_probabilities=np.ones(1),
            mask=np.ones((2, 2), bool),
            mask_origin=(0, 0),
        )
        for c in ([4.0, 592.0], [400.4, 300.0])
    ]
    crops, intrinsics = cut_crops(frame, detections)
    assert crops.shape == (2, 256, 256, 3)
    assert crops[0, 590 - 344, 5].max() == 255
    assert intrinsics[1].cx == pytest.approx(BASLER.cx - (400 - 128))
    with pytest.raises(PerceptionError, match="too small"):
        cut_crops(replace(frame, image=image[:100]), detections)


def test_missing_weights_name_the_folder_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match=r"choice.json in .*tagcell train"):
        LearnedEstimator(tmp_path)


def test_settings_that_make_no_sense_are_errors() -> None:
    with pytest.raises(ValueError, match="overlap"):
        EstimatorConfig(overlap=0.0)
    with pytest.raises(ValueError, match="sure_matched"):
        CropPoseConfig(sure_matched=1.5)
