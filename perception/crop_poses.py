"""Poses of the parts in crops: the networks' hypotheses are refined by their contours and the best one is chosen.

How many are refined depends on how sure the networks are. Where they agree by a large margin and the contour bears
them out it is one; else the readings next in line, the best one turned round, the best of the runner-up class and of
the segmenter's class are tried as well. Of what both networks call no part none is.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import planar
from cad.spatial import Array, Intrinsics, apply
from perception.alternatives import Placement, pose_alternatives, same_reading
from perception.choice import FEATURES, ChoiceWeights, CropContext, gate_evidence
from perception.contour import ContourConfig, Refinement, refine_all
from perception.crop_view import HALF, CropView, half_size
from perception.estimates import PoseAlternative
from perception.faces import Face
from perception.gradients import EdgeImage, brightness
from perception.labels import ray_of_crop
from perception.posenets import CropKeypoints, Hypothesis, PoseNets
from perception.region import region_scores
from perception.shortlist import Shortlist, ShortlistConfig, shortlist, turned_by_keypoints
from perception.sighting import Sighting
from perception.silhouette import render_view
from perception.threads import spread

SAME_PLACE_M = 3e-4
"""Candidates of one reading that lie nearer are no rivals: either would do for placing a part."""
LEAST_LOG = -10.0
LEAST_CLASS = 0.01
"""What the networks' log-probabilities, and the segmenter's probability of a class, count as at least."""


@dataclass(frozen=True, kw_only=True)
class CropPoseConfig:
    """How hypotheses are chosen for refinement, refined and weighed.

    ``prior_weight`` scales how much the stable poses' probabilities count; 0 takes all faces as equally likely.
    Keypoints further than ``keypoint_limit_px`` camera pixels from where a hypothesis puts them all count alike. A
    single hypothesis stands when its contour matches by ``sure_matched``, explains ``sure_explained`` (as fractions)
    and its silhouette overlaps the segmenter's mask by ``sure_overlap``.
    """

    shortlist: ShortlistConfig = field(default_factory=ShortlistConfig)
    prior_weight: float = 0.0
    keypoint_limit_px: float = 15.0
    sure_matched: float = 0.6
    sure_explained: float = 0.6
    sure_overlap: float = 0.5
    contour: ContourConfig = field(default_factory=ContourConfig)

    def __post_init__(self) -> None:
        if self.prior_weight < 0 or self.keypoint_limit_px <= 0:
            raise ValueError(
                f"prior_weight {self.prior_weight} must be at least 0, keypoint_limit_px {self.keypoint_limit_px} above"
            )
        for name in ("sure_matched", "sure_explained", "sure_overlap"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be from 0 to 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A refined hypothesis: face, refinement, evidence (len(FEATURES),), the keypoints voted for its face, and whether
    it came of the likeliest hypothesis. Its refinement is just the start when it was not worth refining.
    """

    face: Face
    refinement: Refinement
    evidence: Array
    keypoints: CropKeypoints | None
    first: bool

    @property
    def placement(self) -> Placement:
        """Face index, x, y and yaw in the table frame."""
        r = self.refinement
        return self.face.index, r.x, r.y, r.yaw

    def T_cam_part(self, T_cam_table: Array) -> Array:
        """(4, 4) pose in the camera."""
        r = self.refinement
        return T_cam_table @ planar(r.x, r.y, r.yaw) @ self.face.stable_pose.T_table_part


@dataclass(frozen=True, kw_only=True, eq=False)
class CropPose:
    """The candidates of a crop with their scores (H,) and the winner's index; the probability that the winner is right,
    that there is a part at all, and the evidence for both; what else is known of the crop; whether the networks were
    sure of the first hypothesis and its contour bore them out.
    """

    candidates: tuple[Candidate, ...]
    scores: Array
    best: int
    probability: float
    part_probability: float
    gate_evidence: Array
    context: CropContext
    sure: bool

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
        T_cam_table: Array,
        sightings: Sequence[Sighting],
        tag_rms_px: float,
        seconds: dict[str, float] | None = None,
    ) -> list[CropPose]:
        """Poses in crops (N, 256, 256, 3) RGB at full resolution with their intrinsics, of one frame.

        ``sightings`` are the segmenter's. ``seconds`` is filled with the time each stage took.
        """
        spent = seconds if seconds is not None else {}
        started = time.perf_counter()
        halves = np.stack([half_size(crop) for crop in crops]) if len(crops) else np.zeros((0, 128, 128, 3), np.uint8)
        small = [k.downscaled(HALF) for k in intrinsics]
        rays = np.array([ray_of_crop(k) for k in small]).reshape(-1, 2)
        readings = self.nets.verify(halves, rays, self.nets.hypotheses(halves, rays))
        config = self.config.shortlist
        short = [shortlist(r, s, self.nets.table, config) for r, s in zip(readings, sightings, strict=True)]
        views = [
            CropView(
                crop=crop,
                half=half,
                ray=ray,
                intrinsics=k,
                T_cam_table=T_cam_table,
                reading=reading,
                sighting=sighting,
                tag_rms_px=tag_rms_px,
            )
            for crop, half, ray, k, reading, sighting in zip(
                crops, halves, rays, intrinsics, readings, sightings, strict=True
            )
        ]
        spent.update({"networks": time.perf_counter() - started, "keypoints": 0.0, "refinement": 0.0})
        poses = self._solved(views, short, spent)
        # Whatever the networks were sure of, but its contour does not bear out, is tested under the other readings.
        doubtful = [i for i, pose in enumerate(poses) if short[i].sure and not pose.sure]
        wider = [replace(short[i], sure=False, wanted=short[i].others) for i in doubtful]
        for i, pose in zip(doubtful, self._solved([views[i] for i in doubtful], wider, spent), strict=True):
            poses[i] = pose
        return poses

    def alternatives(self, pose: CropPose, T_cam_table: Array) -> tuple[PoseAlternative, ...]:
        """The poses that the crop leaves open, the winner's first."""
        return pose_alternatives(
            self.nets.table,
            [candidate.placement for candidate in pose.candidates],
            pose.scores,
            T_cam_table,
            temperature=self.weights.temperature,
            mass=self.weights.set_mass,
            prior_weight=self.config.prior_weight,
        )

    def _solved(self, views: Sequence[CropView], short: Sequence[Shortlist], spent: dict[str, float]) -> list[CropPose]:
        started = time.perf_counter()
        faces = [
            (i, face)
            for i, found in enumerate(short)
            for face in sorted({(h.part, h.stable_pose) for h in found.wanted})
        ]
        halves = np.stack([views[i].half for i, _ in faces]) if faces else np.zeros((0, 128, 128, 3), np.uint8)
        rays = np.array([views[i].ray for i, _ in faces]).reshape(-1, 2)
        voted = dict(zip(faces, self.nets.keypoints(halves, rays, [face for _, face in faces]), strict=True))
        spent["keypoints"] += time.perf_counter() - started

        started = time.perf_counter()

        def chosen(i: int) -> CropPose:
            view, found = views[i], short[i]
            votes = {face: keypoints for (row, face), keypoints in voted.items() if row == i}
            candidates = self._refined(view, found.wanted, votes) if found.wanted else [self._unrefined(view)]
            return self._choose(candidates, view, found.sure)

        out = spread(chosen, range(len(views)))
        spent["refinement"] += time.perf_counter() - started
        return out

    def _refined(
        self, view: CropView, hypotheses: Sequence[Hypothesis], votes: dict[tuple[str, int], CropKeypoints]
    ) -> list[Candidate]:
        gray = brightness(view.crop)
        edges, small = EdgeImage.of(gray), view.small
        turned = turned_by_keypoints(
            hypotheses, votes, self.nets.table, small, view.T_cam_table, self.config.shortlist.same_yaw
        )
        found: list[Candidate] = []
        for k, h in enumerate([*hypotheses, *turned]):
            face = self.nets.table[self.nets.table.index_of(h.part, h.stable_pose)]
            x, y = view.place(h, face)
            places = refine_all(
                edges, view.intrinsics, face.part, h.stable_pose, view.T_cam_table, x, y, h.yaw, self.config.contour
            )
            keypoints = votes.get((h.part, h.stable_pose))
            for r in places:
                candidate = Candidate(
                    face=face, refinement=r, evidence=np.zeros(len(FEATURES)), keypoints=keypoints, first=k == 0
                )
                if not any(_same_pose(candidate, other) for other in found):
                    found.append(replace(candidate, evidence=self._evidence(view, h, candidate)))
        facets = [render_view(c.face.part, c.T_cam_part(view.T_cam_table), small).facet for c in found]
        half_gray = cv2.resize(gray, (small.width, small.height), interpolation=cv2.INTER_AREA).astype(np.float32)
        for candidate, facet, region in zip(found, facets, region_scores(half_gray, facets), strict=True):
            candidate.evidence[FEATURES.index("region_fit")] = region.fit
            candidate.evidence[FEATURES.index("region_unexplained")] = region.unexplained
            candidate.evidence[FEATURES.index("overlap")] = view.sighting.overlap(facet >= 0)
        return found

    def _evidence(self, view: CropView, h: Hypothesis, candidate: Candidate) -> Array:
        r = candidate.refinement
        known = {
            "classifier": max(h.classifier, LEAST_LOG),
            "verifier": max(h.verifier, LEAST_LOG),
            "matched_fraction": r.matched_fraction,
            "matched_outline": r.matched_outline,
            "correlation": r.correlation,
            "explained": r.explained,
            "keypoints": self._keypoint_agreement(candidate, view),
            "segmenter_class": float(np.log(max(view.sighting.class_probabilities.get(h.part, 0.0), LEAST_CLASS))),
        }
        return np.array([known.get(name, 0.0) for name in FEATURES])

    def _keypoint_agreement(self, candidate: Candidate, view: CropView) -> float:
        """Minus the mean distance, camera pixels, from the voted keypoints to those of the candidate."""
        if candidate.keypoints is None:
            return -self.config.keypoint_limit_px
        at = view.small.project(apply(candidate.T_cam_part(view.T_cam_table), candidate.face.part.keypoints))
        distance = HALF * np.linalg.norm(at - candidate.keypoints.pixels, axis=1)
        return -float(np.minimum(distance, self.config.keypoint_limit_px).mean())

    def _unrefined(self, view: CropView) -> Candidate:
        """The likeliest hypothesis as it stands, with the scores of a contour that is not there."""
        h = view.reading.hypotheses[0]
        face = self.nets.table[self.nets.table.index_of(h.part, h.stable_pose)]
        x, y = view.place(h, face)
        start = Refinement(
            x=x,
            y=y,
            yaw=h.yaw,
            covariance=np.diag(np.square([5e-4, 5e-4, 0.1])),
            matched_fraction=0.0,
            matched_outline=0.0,
            correlation=0.0,
            explained=0.0,
        )
        candidate = Candidate(face=face, refinement=start, evidence=np.zeros(len(FEATURES)), keypoints=None, first=True)
        return replace(candidate, evidence=self._evidence(view, h, candidate))

    def _choose(self, candidates: Sequence[Candidate], view: CropView, sure: bool) -> CropPose:
        evidence = np.stack([c.evidence for c in candidates])
        prior = np.log([max(c.face.stable_pose.probability, 1e-2) for c in candidates])
        scores = self.weights.scores(evidence) + self.config.prior_weight * prior
        best = int(scores.argmax())
        at = candidates[best].placement
        rivals = np.array([not same_reading(self.nets.table, at, c.placement, SAME_PLACE_M) for c in candidates])
        context = view.context
        gate = gate_evidence(scores, evidence, best, rivals, context)
        return CropPose(
            candidates=tuple(candidates),
            scores=scores,
            best=best,
            probability=float(self.weights.probability_right(gate)),
            part_probability=float(self.weights.probability_part(gate)),
            gate_evidence=gate,
            context=context,
            sure=sure and self._borne_out(candidates, scores),
        )

    def _borne_out(self, candidates: Sequence[Candidate], scores: Array) -> bool:
        """Whether the contour of the likeliest hypothesis is good enough to look at no other."""
        _, best = max(((score, c) for score, c in zip(scores, candidates, strict=True) if c.first), key=lambda p: p[0])
        r, config = best.refinement, self.config
        return bool(
            r.matched_fraction >= config.sure_matched
            and r.explained >= config.sure_explained
            and best.evidence[FEATURES.index("overlap")] >= config.sure_overlap
        )


def _same_pose(a: Candidate, b: Candidate) -> bool:
    """Whether two candidates are one pose, up to the part's symmetries: within 0.1 mm and 2 degrees."""
    if a.face.part is not b.face.part:
        return False
    pa = planar(a.refinement.x, a.refinement.y, a.refinement.yaw) @ a.face.stable_pose.T_table_part
    pb = planar(b.refinement.x, b.refinement.y, b.refinement.yaw) @ b.face.stable_pose.T_table_part
    distance, angle = a.face.part.symmetries.difference(pa, pb)
    return distance <= 1e-4 and angle < np.radians(2.0)
