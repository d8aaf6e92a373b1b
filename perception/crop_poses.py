"""Poses of the parts in crops: the networks' hypotheses are refined by their contours and the best one is chosen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import planar
from cad.spatial import Array, Intrinsics, apply, wrap_angle
from perception.choice import FEATURES, ChoiceWeights, gate_evidence
from perception.contour import ContourConfig, Refinement, refine_all
from perception.faces import Face
from perception.gradients import EdgeImage, Image32, brightness
from perception.labels import ray_of_crop
from perception.planar import PlanarError, on_plane, solve_planar
from perception.posenets import CropKeypoints, CropReading, Hypothesis, PoseNets
from perception.region import region_scores
from perception.silhouette import render_view

CROP_PX = 256
HALF = 2
"""The networks see crops at half the camera's resolution."""


@dataclass(frozen=True, kw_only=True)
class CropPoseConfig:
    """Which hypotheses are refined: at most ``refined``, those within ``nats`` of the best network score.

    ``prior_weight`` scales how much the stable poses' probabilities count; 0 takes all faces as equally likely.
    Keypoints further than ``keypoint_limit_px`` camera pixels from where a hypothesis puts them all count alike.
    """

    refined: int = 3
    nats: float = 6.0
    prior_weight: float = 0.0
    keypoint_limit_px: float = 15.0
    same_yaw: float = float(np.radians(12.0))
    contour: ContourConfig = field(default_factory=ContourConfig)

    def __post_init__(self) -> None:
        if self.refined < 1 or self.nats <= 0 or self.prior_weight < 0:
            raise ValueError(f"refined {self.refined}, nats {self.nats}, prior_weight {self.prior_weight}: too small")


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A refined hypothesis: face, refinement, evidence (len(FEATURES),) and the keypoints voted for its face."""

    face: Face
    refinement: Refinement
    evidence: Array
    keypoints: CropKeypoints | None

    def T_cam_part(self, T_cam_table: Array) -> Array:
        """(4, 4) pose in the camera."""
        r = self.refinement
        return T_cam_table @ planar(r.x, r.y, r.yaw) @ self.face.stable_pose.T_table_part


@dataclass(frozen=True, kw_only=True, eq=False)
class CropPose:
    """The candidates of a crop with their scores (H,), the winner's index, the probability that the winner is right,
    its lead in nats, and the probability that the crop shows no part.
    """

    candidates: tuple[Candidate, ...]
    scores: Array
    best: int
    probability: float
    gate_evidence: Array
    not_a_part: float

    @property
    def winner(self) -> Candidate:
        """The chosen candidate."""
        return self.candidates[self.best]


class CropSolver:
    """Networks, refinement and choice for crops of one frame."""

    def __init__(self, nets: PoseNets, weights: ChoiceWeights, config: CropPoseConfig | None = None) -> None:
        self.nets, self.weights, self.config = nets, weights, config or CropPoseConfig()

    def solve(
        self,
        crops: NDArray[np.uint8],
        intrinsics: Sequence[Intrinsics],
        T_cam_table: Sequence[Array],
        seconds: dict[str, float] | None = None,
    ) -> list[CropPose]:
        """Poses in crops (N, 256, 256, 3) RGB at full resolution with their intrinsics and table frames.

        ``seconds`` is filled with the time each stage took.
        """
        spent = seconds if seconds is not None else {}
        started = time.perf_counter()
        halves = np.stack([_half(crop) for crop in crops]) if len(crops) else np.zeros((0, 128, 128, 3), np.uint8)
        small = [k.downscaled(HALF) for k in intrinsics]
        rays = np.array([ray_of_crop(k) for k in small]).reshape(-1, 2)
        readings = self.nets.verify(halves, rays, self.nets.hypotheses(halves, rays))
        kept = [self._shortlist(reading) for reading in readings]
        spent["networks"] = time.perf_counter() - started

        started = time.perf_counter()
        faces = [(i, face) for i, found in enumerate(kept) for face in sorted({(h.part, h.stable_pose) for h in found})]
        rows = [i for i, _ in faces]
        voted = self.nets.keypoints(halves[rows], rays[rows], [face for _, face in faces])
        votes = dict(zip(faces, voted, strict=True))
        spent["keypoints"] = time.perf_counter() - started

        started = time.perf_counter()
        out = []
        for i, (crop, reading) in enumerate(zip(crops, readings, strict=True)):
            mine = {face: votes[i, face] for row, face in faces if row == i}
            candidates = self._refined(brightness(crop), intrinsics[i], T_cam_table[i], kept[i], mine)
            out.append(self._choose(candidates, reading))
        spent["refinement"] = time.perf_counter() - started
        return out

    def _shortlist(self, reading: CropReading) -> list[Hypothesis]:
        best = reading.hypotheses[0].log_probability
        likely = [h for h in reading.hypotheses if best - h.log_probability < self.config.nats]
        return likely[: self.config.refined]

    def _refined(
        self,
        gray: Image32,
        intrinsics: Intrinsics,
        T_cam_table: Array,
        hypotheses: Sequence[Hypothesis],
        votes: dict[tuple[str, int], CropKeypoints],
    ) -> list[Candidate]:
        edges, small = EdgeImage.of(gray), intrinsics.downscaled(HALF)
        found: list[Candidate] = []
        for h in self._with_keypoint_yaws(hypotheses, votes, small, T_cam_table):
            face = self.nets.table[self.nets.table.index_of(h.part, h.stable_pose)]
            x, y = (float(c) for c in on_plane(h.centre_px, face.middle_m, small, T_cam_table)[:2])
            places = refine_all(
                edges, intrinsics, face.part, h.stable_pose, T_cam_table, x, y, h.yaw, self.config.contour
            )
            keypoints = votes.get((h.part, h.stable_pose))
            for r in places:
                candidate = Candidate(face=face, refinement=r, evidence=np.zeros(len(FEATURES)), keypoints=keypoints)
                if any(_same_pose(candidate, other) for other in found):
                    continue
                evidence = {
                    "classifier": h.classifier,
                    "verifier": h.verifier,
                    "matched_fraction": r.matched_fraction,
                    "matched_outline": r.matched_outline,
                    "correlation": r.correlation,
                    "explained": r.explained,
                    "keypoints": self._keypoint_agreement(candidate, small, T_cam_table),
                }
                found.append(replace(candidate, evidence=np.array([evidence.get(name, 0.0) for name in FEATURES])))
        views = [render_view(c.face.part, c.T_cam_part(T_cam_table), small).facet for c in found]
        half_gray = cv2.resize(gray, (small.width, small.height), interpolation=cv2.INTER_AREA).astype(np.float32)
        for candidate, region in zip(found, region_scores(half_gray, views), strict=True):
            candidate.evidence[FEATURES.index("region_fit")] = region.fit
            candidate.evidence[FEATURES.index("region_unexplained")] = region.unexplained
        return found

    def _with_keypoint_yaws(
        self,
        hypotheses: Sequence[Hypothesis],
        votes: dict[tuple[str, int], CropKeypoints],
        small: Intrinsics,
        T_cam_table: Array,
    ) -> list[Hypothesis]:
        """The hypotheses, and for the best one's face what its keypoints say when that is another yaw."""
        best = hypotheses[0]
        keypoints = votes.get((best.part, best.stable_pose))
        if keypoints is None:
            return list(hypotheses)
        face = self.nets.table[self.nets.table.index_of(best.part, best.stable_pose)]
        try:
            solved = solve_planar(
                face.part.keypoints, keypoints.pixels, keypoints.covariances, face.stable_pose, small, T_cam_table
            )
        except PlanarError:
            return list(hypotheses)
        known = [h.yaw for h in hypotheses if (h.part, h.stable_pose) == (best.part, best.stable_pose)]
        if min(abs(float(wrap_angle(solved.yaw - yaw))) for yaw in known) < self.config.same_yaw:
            return list(hypotheses)
        middle = apply(T_cam_table, [solved.x, solved.y, face.middle_m])
        centre = small.project(middle)
        worst = min(h.classifier for h in hypotheses) - 1.0, min(h.verifier for h in hypotheses) - 1.0
        extra = replace(
            best,
            yaw=solved.yaw,
            centre_px=(float(centre[0]), float(centre[1])),
            classifier=worst[0],
            verifier=worst[1],
        )
        return [*hypotheses, extra]

    def _keypoint_agreement(self, candidate: Candidate, small: Intrinsics, T_cam_table: Array) -> float:
        """Minus the mean distance, camera pixels, from the voted keypoints to those of the candidate."""
        if candidate.keypoints is None:
            return -self.config.keypoint_limit_px
        at = small.project(apply(candidate.T_cam_part(T_cam_table), candidate.face.part.keypoints))
        distance = HALF * np.linalg.norm(at - candidate.keypoints.pixels, axis=1)
        return -float(np.minimum(distance, self.config.keypoint_limit_px).mean())

    def _choose(self, candidates: Sequence[Candidate], reading: CropReading) -> CropPose:
        evidence = np.stack([c.evidence for c in candidates])
        prior = np.log([max(c.face.stable_pose.probability, 1e-2) for c in candidates])
        scores = self.weights.scores(evidence) + self.config.prior_weight * prior
        best = int(scores.argmax())
        gate = gate_evidence(scores, evidence, best, reading.not_a_part)
        return CropPose(
            candidates=tuple(candidates),
            scores=scores,
            best=best,
            probability=float(self.weights.probability_right(gate)),
            gate_evidence=gate,
            not_a_part=reading.not_a_part,
        )


def _half(crop: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if crop.shape[:2] != (CROP_PX, CROP_PX):
        raise ValueError(f"a crop of {crop.shape[1]} x {crop.shape[0]} pixels; expected {CROP_PX} x {CROP_PX}")
    side = CROP_PX // HALF
    return np.asarray(cv2.resize(crop, (side, side), interpolation=cv2.INTER_AREA), np.uint8)


def _same_pose(a: Candidate, b: Candidate) -> bool:
    """Whether two candidates are one pose, up to the part's symmetries: within 0.1 mm and 2 degrees."""
    if a.face.part is not b.face.part:
        return False
    pa = planar(a.refinement.x, a.refinement.y, a.refinement.yaw) @ a.face.stable_pose.T_table_part
    pb = planar(b.refinement.x, b.refinement.y, b.refinement.yaw) @ b.face.stable_pose.T_table_part
    distance, angle = a.face.part.symmetries.difference(pa, pb)
    return distance <= 1e-4 and angle < np.radians(2.0)
