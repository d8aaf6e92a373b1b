"""Errors of poses and of detections, as the field defines them.

Pose errors follow the paper's Table 2 (absolute differences of translation in the camera frame and the geodesic angle)
and the BOP benchmark's MSSD (Hodan et al. 2020), both modulo a part's proper symmetries. Detection scores follow the
paper's Table 1 and COCO's interpolated average precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.equivalence import Symmetries
from cad.spatial import Array, apply, rotation_angle

COCO_THRESHOLDS = tuple(np.round(np.arange(0.5, 1.0, 0.05), 2).tolist())
"""Intersection-over-union thresholds that COCO and BOP average over."""


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """Absolute translation differences in metres along the camera's axes, and rotation angle in rad."""

    e_x_m: float
    e_y_m: float
    e_z_m: float
    e_theta_rad: float

    def as_mm_deg(self) -> dict[str, float]:
        """The four errors under the names that reports use."""
        return {
            "e_x_mm": 1e3 * self.e_x_m,
            "e_y_mm": 1e3 * self.e_y_m,
            "e_z_mm": 1e3 * self.e_z_m,
            "e_theta_deg": float(np.degrees(self.e_theta_rad)),
        }


def pose_error(T_cam_part_true: Array, T_cam_part: Array, symmetries: Symmetries) -> PoseError:
    """Error of a pose modulo the part's symmetries, of the equivalent pose that is turned least from the truth."""
    nearest = symmetries.nearest(T_cam_part_true, T_cam_part)
    e_x, e_y, e_z = np.abs(nearest[:3, 3] - T_cam_part_true[:3, 3])
    angle = rotation_angle(T_cam_part_true[:3, :3], nearest[:3, :3])
    return PoseError(e_x_m=float(e_x), e_y_m=float(e_y), e_z_m=float(e_z), e_theta_rad=angle)


def mssd(T_cam_part_true: Array, T_cam_part: Array, vertices: ArrayLike, symmetries: Symmetries) -> float:
    """Maximum symmetry-aware surface distance in metres over vertices (V, 3) in frame ``part``."""
    vertices = np.asarray(vertices, np.float64)
    estimated = apply(T_cam_part, vertices)
    distances = [
        np.linalg.norm(apply(T_cam_part_true @ S, vertices) - estimated, axis=1).max() for S in symmetries.sampled()
    ]
    return float(min(distances))


def summary(values: ArrayLike) -> dict[str, float]:
    """Mean, standard deviation, median, 95th percentile and number of values; NaN where there are none."""
    v = np.asarray(values, np.float64).ravel()
    if not v.size:
        return {"mean": np.nan, "std": np.nan, "median": np.nan, "p95": np.nan, "n": 0}
    return {
        "mean": float(v.mean()),
        "std": float(v.std()),
        "median": float(np.median(v)),
        "p95": float(np.percentile(v, 95)),
        "n": int(v.size),
    }


def mask_iou(
    mask_a: NDArray[np.bool_],
    mask_b: NDArray[np.bool_],
    origin_a: tuple[int, int] = (0, 0),
    origin_b: tuple[int, int] = (0, 0),
) -> float:
    """Intersection over union of two masks (h, w), each placed with its first pixel at ``origin`` (u, v)."""
    u0, v0 = max(origin_a[0], origin_b[0]), max(origin_a[1], origin_b[1])
    u1 = min(origin_a[0] + mask_a.shape[1], origin_b[0] + mask_b.shape[1])
    v1 = min(origin_a[1] + mask_a.shape[0], origin_b[1] + mask_b.shape[0])
    shared = 0
    if u1 > u0 and v1 > v0:
        a = mask_a[v0 - origin_a[1] : v1 - origin_a[1], u0 - origin_a[0] : u1 - origin_a[0]]
        b = mask_b[v0 - origin_b[1] : v1 - origin_b[1], u0 - origin_b[0] : u1 - origin_b[0]]
        shared = int(np.count_nonzero(a & b))
    union = int(np.count_nonzero(mask_a)) + int(np.count_nonzero(mask_b)) - shared
    return shared / union if union else 0.0


def match_detections(iou: Array, scores: ArrayLike, threshold: float) -> NDArray[np.int64]:
    """For each detection (D,) the ground-truth instance it takes, or -1, from overlaps (D, G).

    Greedy: the detection with the highest score chooses first, each instance is taken once (COCO's rule).
    """
    iou = np.asarray(iou, np.float64)
    taken = np.full(iou.shape[0], -1, np.int64)
    free = np.ones(iou.shape[1], bool)
    for d in np.argsort(-np.asarray(scores, np.float64), kind="stable"):
        overlaps = np.where(free, iou[d], -1.0)
        if overlaps.size and overlaps.max() >= threshold:
            taken[d] = int(overlaps.argmax())
            free[taken[d]] = False
    return taken


@dataclass(kw_only=True)
class DetectionScores:
    """Collects detections image by image and scores them all.

    Instances whose ``ignore`` flag is set (too small to count) are neither wanted nor punished.
    """

    images: list[tuple[Array, Array, NDArray[np.bool_]]] = field(default_factory=list)

    def add(self, iou: ArrayLike, scores: Sequence[float], ignore: ArrayLike | None = None) -> None:
        """Overlaps (D, G) of one image's detections with its instances, and the detections' scores (D,)."""
        overlaps = np.asarray(iou, np.float64)
        if overlaps.ndim != 2 or overlaps.shape[0] != len(scores):
            raise ValueError(f"overlaps of shape {overlaps.shape} for {len(scores)} detections: must be (D, G)")
        flags = np.zeros(overlaps.shape[1], bool) if ignore is None else np.asarray(ignore, bool)
        self.images.append((overlaps, np.asarray(scores, np.float64), flags))

    def _outcomes(self, threshold: float) -> tuple[Array, NDArray[np.bool_], int]:
        """Scores and true-positive flags of all detections that count, and the number of wanted instances."""
        all_scores, hits, wanted = [], [], 0
        for iou, scores, ignore in self.images:
            taken = match_detections(iou, scores, threshold)
            counts = (taken < 0) | ~ignore[np.maximum(taken, 0)] if ignore.size else np.ones(len(taken), bool)
            all_scores.append(scores[counts])
            hits.append(taken[counts] >= 0)
            wanted += int(np.count_nonzero(~ignore))
        if not all_scores:
            return np.zeros(0), np.zeros(0, bool), 0
        return np.concatenate(all_scores), np.concatenate(hits), wanted

    def precision_recall(self, threshold: float = 0.5) -> tuple[float, float]:
        """TP / (TP + FP) and TP / (TP + FN) at an overlap threshold; NaN without detections or instances."""
        _, hits, wanted = self._outcomes(threshold)
        true = int(np.count_nonzero(hits))
        return (true / len(hits) if len(hits) else np.nan), (true / wanted if wanted else np.nan)

    def average_precision(self, threshold: float = 0.5) -> float:
        """Area under the precision-recall curve, precision made monotone, at COCO's 101 recall levels."""
        scores, hits, wanted = self._outcomes(threshold)
        if not wanted:
            return float("nan")
        order = np.argsort(-scores, kind="stable")
        true = np.cumsum(hits[order])
        recall = true / wanted
        precision = true / np.arange(1, len(true) + 1)
        precision = np.maximum.accumulate(precision[::-1])[::-1]
        at = np.searchsorted(recall, np.linspace(0.0, 1.0, 101) - 1e-12, side="left")
        return float(np.append(precision, 0.0)[np.minimum(at, len(precision))].mean())

    def mean_iou(self) -> float:
        """Mean over wanted instances of the best overlap that a detection has with each, 0 for a missed one."""
        best = [
            iou.max(axis=0)[~ignore] if iou.shape[0] else np.zeros(np.count_nonzero(~ignore))
            for iou, _, ignore in self.images
        ]
        values = np.concatenate(best) if best else np.zeros(0)
        return float(values.mean()) if values.size else float("nan")

    def report(self) -> dict[str, float]:
        """All figures under the names of ``evaluation.json``: miou, ap, ap50, ap75, ar, precision50, recall50."""
        precision50, recall50 = self.precision_recall(0.5)
        return {
            "miou": self.mean_iou(),
            "ap": float(np.mean([self.average_precision(t) for t in COCO_THRESHOLDS])),
            "ap50": self.average_precision(0.5),
            "ap75": self.average_precision(0.75),
            "ar": float(np.mean([self.precision_recall(t)[1] for t in COCO_THRESHOLDS])),
            "precision50": precision50,
            "recall50": recall50,
        }
