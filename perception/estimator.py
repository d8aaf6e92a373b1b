"""The learned estimator: one frame in, the poses of all parts in it out.

The tags give the table's frame, the segmentation finds the parts, the crop networks propose, contours refine and the
choice decides. Whatever is not sure enough is returned with the reason instead of being passed off as a pose.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cad.parts import part_names as all_part_names
from cad.spatial import Array, Intrinsics
from cad.tagboard import TagboardConfig
from perception.calibration import TagPose, camera_from_tags, table_from_board
from perception.choice import GATE_FEATURES, MAX_LEAD, ChoiceWeights
from perception.covariance import pose_covariance
from perception.crop_poses import Candidate, CropPose, CropPoseConfig, CropSolver
from perception.crop_view import CROP_PX, HALF
from perception.estimates import (
    ACCEPTED,
    AMBIGUOUS,
    NOT_A_PART,
    OTHER_PART,
    POOR_CONTOUR,
    Frame,
    FrameEstimate,
    PartEstimate,
    PerceptionError,
)
from perception.pnp import PnpError, solve_pnp
from perception.posenets import PoseNets
from perception.segmentation import Detection, Segmenter
from perception.sighting import sighting_of
from perception.silhouette import silhouette_mask
from perception.standard_view import frame_scale, standard_crop

LEAD = GATE_FEATURES.index("lead")
WEIGHTS = Path(__file__).parent / "weights"
"""The weights that come with the package."""

NETWORK_FILES = (
    "segmentation.safetensors",
    "classifier.safetensors",
    "verifier.safetensors",
    "keypoints.safetensors",
)
CHOICE_FILE = "choice.json"
WEIGHT_FILES = (*NETWORK_FILES, CHOICE_FILE)


@dataclass(frozen=True, kw_only=True)
class EstimatorConfig:
    """``overlap`` is the share of the smaller silhouette from which two estimates are one part seen twice."""

    crop_poses: CropPoseConfig = field(default_factory=CropPoseConfig)
    overlap: float = 0.3

    def __post_init__(self) -> None:
        if not 0.0 < self.overlap <= 1.0:
            raise ValueError(f"overlap = {self.overlap}: must be above 0 and at most 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """A frame's tags and table, the segmenter's detections, and of each the camera of its crop and what it may be."""

    tags: TagPose
    T_cam_table: Array
    detections: tuple[Detection, ...]
    intrinsics: tuple[Intrinsics, ...]
    poses: tuple[CropPose, ...]
    seconds: dict[str, float]


class LearnedEstimator:
    """See the module's text; implements ``PoseEstimator``."""

    def __init__(
        self,
        weights_dir: Path | None = None,
        tagboard: TagboardConfig | None = None,
        part_names: Sequence[str] | None = None,
        config: EstimatorConfig | None = None,
        parts_dir: Path | None = None,
        choice: ChoiceWeights | None = None,
    ) -> None:
        """Load the weights in ``weights_dir`` (those of the package by default).

        ``part_names`` are the parts that may be in a frame (default: all that the networks know); an estimate of
        another one is not accepted. ``choice`` replaces what ``choice.json`` says. Raises PerceptionError naming the
        folder and how to train when weights are missing, or do not fit the parts.
        """
        folder = weights_dir or WEIGHTS
        wanted = WEIGHT_FILES if choice is None else NETWORK_FILES
        missing = [name for name in wanted if not (folder / name).exists()]
        if missing:
            raise PerceptionError(f"no {', '.join(missing)} in {folder}; train the networks with `tagcell train`")
        self.config = config or EstimatorConfig()
        self.tagboard = tagboard or TagboardConfig()
        self.segmenter = Segmenter.load(folder, parts_dir)
        self.solver = CropSolver(
            PoseNets.load(folder, parts_dir), choice or ChoiceWeights.load(folder / CHOICE_FILE), self.config.crop_poses
        )
        known = [part.name for part in self.solver.nets.table.parts]
        self.part_names = tuple(part_names or known)
        for name in self.part_names:
            if name not in known:
                raise PerceptionError(
                    f"the weights in {folder} know {', '.join(known)} but not {name!r}; parts there are: "
                    f"{', '.join(all_part_names(parts_dir))}. Use weights that were trained on {name!r}, or pick it "
                    "with `--estimator oracle`"
                )

    def estimate(self, frame: Frame) -> FrameEstimate:
        """Poses of every part in the frame, accepted ones first, best first.

        Raises PerceptionError when the frame shows too few tags or is smaller than a crop.
        """
        seen = self.look(frame)
        started = time.perf_counter()
        parts = [
            self._estimate(frame, pose, k, seen.T_cam_table)
            for pose, k in zip(seen.poses, seen.intrinsics, strict=True)
        ]
        distinct = drop_repeated(parts, self.config.overlap)
        seen.seconds["outcome"] = time.perf_counter() - started
        return FrameEstimate(
            T_cam_board=seen.tags.T_cam_board,
            parts=tuple(distinct),
            tags_seen=seen.tags.tags_seen,
            tag_rms_px=seen.tags.rms_px,
            seconds=seen.seconds,
        )

    def look(self, frame: Frame) -> Look:
        """What is seen in a frame before it is decided what of it to report; raises as ``estimate`` does."""
        seconds: dict[str, float] = {}
        started = time.perf_counter()
        tags = camera_from_tags(frame, self.tagboard)
        T_cam_table = table_from_board(tags.T_cam_board)
        seconds["tags"] = time.perf_counter() - started

        started = time.perf_counter()
        scale = frame_scale(frame.intrinsics, T_cam_table)
        detections = self.segmenter.detect(frame, scale)
        seconds["segmentation"] = time.perf_counter() - started

        crops, intrinsics = cut_crops(frame, detections, scale)
        sightings = [
            sighting_of(detection, self.segmenter.part_names, frame.intrinsics, k.downscaled(HALF))
            for detection, k in zip(detections, intrinsics, strict=True)
        ]
        poses = self.solver.solve(crops, intrinsics, T_cam_table, sightings, tags.rms_px, seconds)
        return Look(
            tags=tags,
            T_cam_table=T_cam_table,
            detections=tuple(detections),
            intrinsics=tuple(intrinsics),
            poses=tuple(poses),
            seconds=seconds,
        )

    def _estimate(self, frame: Frame, pose: CropPose, intrinsics: Intrinsics, T_cam_table: Array) -> PartEstimate:
        winner = pose.winner
        T_cam_part = winner.T_cam_part(T_cam_table)
        mask, origin = silhouette_mask(winner.face.part, T_cam_part, frame.intrinsics)
        r = winner.refinement
        alternatives = self.solver.alternatives(pose, T_cam_table)
        noise = self.solver.weights.noise_of(winner.face.part.name, winner.face.stable_pose.index)
        return PartEstimate(
            part=winner.face.part.name,
            T_cam_part=T_cam_part,
            stable_pose=winner.face.stable_pose.index,
            score=pose.probability,
            verdict=self._verdict(pose, len(alternatives)),
            covariance=pose_covariance(r, pose.probability, noise, T_cam_table, T_cam_part),
            raw_T_cam_part=_raw_pose(winner, intrinsics.downscaled(HALF)),
            mask=mask,
            mask_origin=origin,
            details={
                "lead": float(pose.gate_evidence[LEAD]),
                "not_a_part": 1.0 - pose.part_probability,
                "matched_fraction": r.matched_fraction,
                "correlation": r.correlation,
                "explained": r.explained,
                "x_m": r.x,
                "y_m": r.y,
                "yaw": r.yaw,
            },
            alternatives=alternatives,
        )

    def _verdict(self, pose: CropPose, open_poses: int) -> str:
        weights = self.solver.weights
        if pose.part_probability < weights.part_above:
            return NOT_A_PART
        if pose.winner.face.part.name not in self.part_names:
            return OTHER_PART
        if pose.probability > weights.accept_above:
            return ACCEPTED if open_poses == 1 else AMBIGUOUS
        # What would have to be better: the lead over the other readings, or the contour itself?
        sure = pose.gate_evidence.copy()
        sure[LEAD] = MAX_LEAD
        return AMBIGUOUS if weights.probability_right(sure) > weights.accept_above else POOR_CONTOUR


def _raw_pose(winner: Candidate, small: Intrinsics) -> Array | None:
    """EPnP on the voted keypoints, before anything is known of tables; None where it finds no pose."""
    if winner.keypoints is None:
        return None
    try:
        voted = winner.keypoints
        return solve_pnp(winner.face.part.keypoints, voted.pixels, voted.covariances, small).T_cam_part
    except PnpError:
        return None


def cut_crops(
    frame: Frame, detections: Sequence[Detection], scale: float = 1.0
) -> tuple[NDArray[np.uint8], list[Intrinsics]]:
    """Windows (N, 256, 256, 3) of the frame round the detections at the standard scale, and their intrinsics.

    ``scale`` is the frame's (see :func:`perception.standard_view.frame_scale`).
    """
    cut = [standard_crop(frame.image, frame.intrinsics, d.centre_px, CROP_PX, scale) for d in detections]
    crops = np.stack([crop for crop, _ in cut]) if cut else np.empty((0, CROP_PX, CROP_PX, 3), np.uint8)
    return crops, [intrinsics for _, intrinsics in cut]


def drop_repeated(parts: Sequence[PartEstimate], overlap: float) -> list[PartEstimate]:
    """Estimates sorted with the accepted first and by score, without those that lie on a better one's silhouette."""
    kept: list[PartEstimate] = []
    for part in sorted(parts, key=lambda p: (not p.accepted, p.verdict == NOT_A_PART, -p.score)):
        if not any(_overlap(part, other) > overlap for other in kept):
            kept.append(part)
    return kept


def _overlap(a: PartEstimate, b: PartEstimate) -> float:
    """Pixels that two estimates share over those of the smaller silhouette."""
    if a.mask is None or b.mask is None or not a.mask.any() or not b.mask.any():
        return 0.0
    low = np.maximum(a.mask_origin, b.mask_origin)
    high = np.minimum(np.add(a.mask_origin, a.mask.shape[::-1]), np.add(b.mask_origin, b.mask.shape[::-1]))
    if (high <= low).any():
        return 0.0
    views = []
    for e in (a, b):
        assert e.mask is not None
        (u0, v0), (u1, v1) = low - e.mask_origin, high - e.mask_origin
        views.append(e.mask[v0:v1, u0:u1])
    return float((views[0] & views[1]).sum()) / min(a.mask.sum(), b.mask.sum())
