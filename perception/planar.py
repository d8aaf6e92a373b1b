"""Poses of a part that rests on the table: with stable pose and plane known, x, y and yaw have a closed form.

The table frame is the one the camera sees: origin at the board's, z its normal, x the camera's x projected on the
plane, so that ``T_cam_part = T_cam_table @ planar(x, y, yaw) @ stable_pose.T_table_part``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cad.parts import StablePose, planar
from cad.spatial import Array, Intrinsics, apply, inverse, rotation_z, yaw_of
from perception.estimates import PerceptionError


class PlanarError(PerceptionError):
    """Keypoints or a table plane from which no planar pose can be computed."""


@dataclass(frozen=True, kw_only=True)
class PlanarPose:
    """Position (metres) and yaw (rad) in the table frame, with the covariance (3, 3) of (x, y, yaw) and the weighted
    RMS distance in metres between the keypoints and their places.
    """

    x: float
    y: float
    yaw: float
    covariance: Array
    rms_m: float

    def T_cam_part(self, T_cam_table: Array, stable_pose: StablePose) -> Array:
        """(4, 4) pose in the camera."""
        return T_cam_table @ planar(self.x, self.y, self.yaw) @ stable_pose.T_table_part


def planar_of(T_cam_part: Array, T_cam_table: Array, stable_pose: StablePose) -> tuple[float, float, float]:
    """(x, y, yaw) of the resting pose nearest to ``T_cam_part``: the inverse of ``PlanarPose.T_cam_part``."""
    T = inverse(T_cam_table) @ T_cam_part @ inverse(stable_pose.T_table_part)
    yaw = yaw_of(T[:3, :3])
    origin = T @ stable_pose.T_table_part[:, 3] - planar(0.0, 0.0, yaw) @ stable_pose.T_table_part[:, 3]
    return float(origin[0]), float(origin[1]), yaw


def on_plane(pixels: ArrayLike, heights_m: ArrayLike, intrinsics: Intrinsics, T_cam_table: Array) -> Array:
    """Points (..., 3) of the table frame seen at ``pixels`` (..., 2), ``heights_m`` (...) above the table.

    Raises PlanarError when a ray does not meet its plane in front of the camera.
    """
    T_table_cam = inverse(T_cam_table)
    ray = intrinsics.rays(pixels) @ T_table_cam[:3, :3].T
    eye = T_table_cam[:3, 3]
    depth = (np.asarray(heights_m, dtype=np.float64) - eye[2]) / ray[..., 2]
    if not (np.isfinite(depth) & (depth > 0)).all():
        raise PlanarError(f"rays from {eye} m do not meet the table plane: check T_cam_table")
    return eye + depth[..., None] * ray


def solve_planar(
    keypoints: ArrayLike,
    pixels: ArrayLike,
    covariances: ArrayLike,
    stable_pose: StablePose,
    intrinsics: Intrinsics,
    T_cam_table: Array,
) -> PlanarPose:
    """Planar pose from ``keypoints`` (K, 3) in ``part`` seen at ``pixels`` (K, 2) with ``covariances`` (K, 2, 2).

    Each pixel's ray is cut with the plane at its keypoint's known height; a weighted two-dimensional Procrustes fit
    (Umeyama, PAMI 1991, without scale) follows, reweighted twice so that a stray keypoint loses its weight.
    Raises PlanarError under 2 keypoints.
    """
    X = apply(stable_pose.T_table_part, keypoints)  # resting at x = y = yaw = 0
    uv, cov = np.asarray(pixels, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    if len(X) < 2 or uv.shape != (len(X), 2) or cov.shape != (len(X), 2, 2):
        raise PlanarError(f"keypoints {X.shape}, pixels {uv.shape}, covariances {cov.shape}: expected K >= 2 of each")
    seen = on_plane(uv, X[:, 2], intrinsics, T_cam_table)[:, :2]
    metres_per_px = inverse(T_cam_table)[2, 3] / intrinsics.fx
    sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2) * metres_per_px
    base = weight = 1.0 / sigma**2
    yaw, shift, error = 0.0, np.zeros(2), np.zeros(len(X))
    for _ in range(3):
        yaw, shift = _procrustes(X[:, :2], seen, weight)
        error = np.linalg.norm(X[:, :2] @ rotation_z(yaw)[:2, :2].T + shift - seen, axis=1)
        scale = max(float(np.median(error)), 1e-6)
        weight = base / (1.0 + (error / (2.0 * scale)) ** 2)
    rms = float(np.sqrt((base * error**2).sum() / base.sum()))
    covariance = _covariance(X[:, :2] @ rotation_z(yaw)[:2, :2].T, base, error)
    return PlanarPose(x=float(shift[0]), y=float(shift[1]), yaw=yaw, covariance=covariance, rms_m=rms)


def _procrustes(a: Array, b: Array, weight: Array) -> tuple[float, Array]:
    """Yaw and shift (2,) that best take ``a`` (K, 2) to ``b`` (K, 2)."""
    w = weight / weight.sum()
    mean_a, mean_b = w @ a, w @ b
    da, db = a - mean_a, b - mean_b
    yaw = float(np.arctan2((w * (da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0])).sum(), (w * (da * db).sum(axis=1)).sum()))
    return yaw, mean_b - rotation_z(yaw)[:2, :2] @ mean_a


def _covariance(turned: Array, weight: Array, error: Array) -> Array:
    """Covariance (3, 3) of (x, y, yaw): of the stated variances, or of the misfit when that is larger."""
    J = np.zeros((len(turned), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -turned[:, 1], turned[:, 0]
    information = np.einsum("kai,k,kaj->ij", J, weight, J)
    misfit = float((weight * error**2).sum()) / max(2 * len(turned) - 3, 1)
    return np.linalg.inv(information) * max(misfit, 1.0)
