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
from cad.spatial import Array, Intrinsics, apply
from cad.tagboard import TagboardConfig
from perception.calibration import camera_from_tags, table_from_board
from perception.choice import ChoiceWeights
from perception.crop_poses import CROP_PX, HALF, Candidate, CropPose, CropPoseConfig, CropSolver
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
from perception.silhouette import silhouette_mask
from perception.standard_view import frame_scale, standard_crop

WEIGHTS = Path(__file__).parent / "weights"
"""The weights that come with the package."""

WEIGHT_FILES = (
    "segmentation.safetensors",
    "classifier.safetensors",
    "verifier.safetensors",
    "keypoints.safetensors",
    "choice.json",
)


@dataclass(frozen=True, kw_only=True)
class EstimatorConfig:
    """``overlap`` is the share of the smaller silhouette from which two estimates are one part seen twice.

    ``plane_sigma_m`` and ``lean_sigma`` (rad) are standard deviations of what the resting pose takes as exact: the
    height of the table at the part, and the part's lean on it. They enter the covariance.
    """

    crop_poses: CropPoseConfig = field(default_factory=lambda: CropPoseConfig(prior_weight=1.0))
    overlap: float = 0.3
    plane_sigma_m: float = 3e-5
    lean_sigma: float = float(np.radians(0.15))

    def __post_init__(self) -> None:
        if not 0.0 < self.overlap <= 1.0:
            raise ValueError(f"overlap = {self.overlap}: must be above 0 and at most 1")


class LearnedEstimator:
    """See the module's text; implements ``PoseEstimator``."""

    def __init__(
        self,
        weights_dir: Path | None = None,
        tagboard: TagboardConfig | None = None,
        part_names: Sequence[str] | None = None,
        config: EstimatorConfig | None = None,
        parts_dir: Path | None = None,
    ) -> None:
        """Load the weights in ``weights_dir`` (those of the package by default).

        ``part_names`` are the parts that may be in a frame (default: all that the networks know); an estimate of
        another one is not accepted. Raises PerceptionError naming the folder and how to train when weights are missing,
        or do not fit the parts.
        """
        folder = weights_dir or WEIGHTS
        missing = [name for name in WEIGHT_FILES if not (folder / name).exists()]
        if missing:
            raise PerceptionError(f"no {', '.join(missing)} in {folder}; train the networks with `tagcell train`")
        self.config = config or EstimatorConfig()
        self.tagboard = tagboard or TagboardConfig()
        self.segmenter = Segmenter.load(folder, parts_dir)
        self.solver = CropSolver(
            PoseNets.load(folder, parts_dir), ChoiceWeights.load(folder / "choice.json"), self.config.crop_poses
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
        solved = self.solver.solve(crops, intrinsics, [T_cam_table] * len(crops), seconds)

        started = time.perf_counter()
        parts = [self._estimate(frame, pose, k, T_cam_table) for pose, k in zip(solved, intrinsics, strict=True)]
        distinct = drop_repeated(parts, self.config.overlap)
        seconds["outcome"] = time.perf_counter() - started
        return FrameEstimate(
            T_cam_board=tags.T_cam_board,
            parts=tuple(distinct),
            tags_seen=tags.tags_seen,
            tag_rms_px=tags.rms_px,
            seconds=seconds,
        )

    def _estimate(self, frame: Frame, pose: CropPose, intrinsics: Intrinsics, T_cam_table: Array) -> PartEstimate:
        winner = pose.winner
        T_cam_part = winner.T_cam_part(T_cam_table)
        mask, origin = silhouette_mask(winner.face.part, T_cam_part, frame.intrinsics)
        r = winner.refinement
        return PartEstimate(
            part=winner.face.part.name,
            T_cam_part=T_cam_part,
            stable_pose=winner.face.stable_pose.index,
            score=pose.probability,
            verdict=self._verdict(pose),
            covariance=self._covariance(winner, T_cam_table, T_cam_part),
            raw_T_cam_part=_raw_pose(winner, intrinsics.downscaled(HALF)),
            mask=mask,
            mask_origin=origin,
            details={
                "lead": float(pose.gate_evidence[1]),
                "not_a_part": pose.not_a_part,
                "matched_fraction": r.matched_fraction,
                "correlation": r.correlation,
                "explained": r.explained,
                "x_m": r.x,
                "y_m": r.y,
                "yaw": r.yaw,
            },
        )

    def _verdict(self, pose: CropPose) -> str:
        if pose.not_a_part > 0.5:
            return NOT_A_PART
        if pose.winner.face.part.name not in self.part_names:
            return OTHER_PART
        if pose.probability > self.solver.weights.accept_above:
            return ACCEPTED
        # What would have to be better: the lead over the other readings, or the contour itself?
        sure = pose.gate_evidence.copy()
        sure[1] = max(sure[1], 4.0)
        return (
            AMBIGUOUS
            if self.solver.weights.probability_right(sure) > self.solver.weights.accept_above
            else (POOR_CONTOUR)
        )

    def _covariance(self, winner: Candidate, T_cam_table: Array, T_cam_part: Array) -> Array:
        """Covariance (6, 6) of (translation, rotation vector) in ``cam`` from that of (x, y, yaw), height and lean."""
        R = T_cam_table[:3, :3]
        r = winner.refinement
        arm = T_cam_part[:3, 3] - apply(T_cam_table, [r.x, r.y, 0.0])  # from the footprint's centre to the origin
        J = np.zeros((6, 6))  # columns: x, y, yaw, height, lean about the table's x and y
        J[:3, 0], J[:3, 1], J[:3, 3] = R.T
        for column, axis in ((2, R[:, 2]), (4, R[:, 0]), (5, R[:, 1])):
            J[:3, column], J[3:, column] = np.cross(axis, arm), axis
        inner = np.zeros((6, 6))
        inner[:3, :3] = r.covariance
        inner[3, 3] = self.config.plane_sigma_m**2
        inner[4, 4] = inner[5, 5] = self.config.lean_sigma**2
        return J @ inner @ J.T


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
    for part in sorted(parts, key=lambda p: (not p.accepted, -p.score)):
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
