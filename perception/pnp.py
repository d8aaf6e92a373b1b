"""Pose from keypoints alone: EPnP, then Levenberg-Marquardt on the whitened reprojection error.

This is the pose before anything is known about stable poses or the table (the raw row of the paper's Table 2). From one
view at 0.7 m its depth is weak by nature: about 10 mm for a part of 9 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from cad.spatial import Array, Intrinsics, rotation_from_rotvec, rotvec_from_rotation, transform
from perception.estimates import PerceptionError

MINIMUM_POINTS = 4


class PnpError(PerceptionError):
    """Keypoints from which no pose can be computed."""


@dataclass(frozen=True, kw_only=True)
class PnpPose:
    """``T_cam_part`` (4, 4), the covariance (6, 6) of (translation m, rotation vector rad) in ``cam`` and the RMS
    reprojection error in pixels.
    """

    T_cam_part: Array
    covariance: Array
    rms_px: float


def solve_pnp(points: ArrayLike, pixels: ArrayLike, covariances: ArrayLike, intrinsics: Intrinsics) -> PnpPose:
    """Pose of a part from ``points`` (K, 3) in ``part`` seen at ``pixels`` (K, 2) with ``covariances`` (K, 2, 2).

    EPnP (Lepetit et al., IJCV 2009) starts the refinement, which minimises the sum of squared Mahalanobis distances
    (PVNet, equation 4). Raises PnpError under 4 points or when EPnP finds no pose in front of the camera.
    """
    X, uv, cov = (np.asarray(a, dtype=np.float64) for a in (points, pixels, covariances))
    if X.shape[0] < MINIMUM_POINTS or uv.shape != (len(X), 2) or cov.shape != (len(X), 2, 2):
        raise PnpError(f"points {X.shape}, pixels {uv.shape}, covariances {cov.shape}: expected K >= 4 of each")
    start = _epnp(X, uv, intrinsics)
    whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), dtype=np.float64)  # whiten @ cov @ whiten.T = 1

    def residual(pose: Array) -> Array:
        return _reproject(pose, X, uv, whiten, intrinsics)[0]

    def jacobian(pose: Array) -> Array:
        return _reproject(pose, X, uv, whiten, intrinsics)[1]

    solution = least_squares(residual, start, jac=jacobian, method="lm", x_scale=[1e-3, 1e-3, 1e-2, 0.1, 0.1, 0.1])  # pyright: ignore[reportArgumentType]
    T = transform(rotation_from_rotvec(solution.x[3:]), solution.x[:3])
    if not (np.isfinite(solution.x).all() and solution.x[2] > 0):
        raise PnpError(f"refinement ended at translation {solution.x[:3]} m, which is not in front of the camera")
    J = _reproject_spatial(T, X, whiten, intrinsics)
    seen = intrinsics.project(X @ T[:3, :3].T + T[:3, 3])
    rms = float(np.sqrt(((seen - uv) ** 2).sum(axis=1).mean()))
    return PnpPose(T_cam_part=T, covariance=np.asarray(np.linalg.pinv(J.T @ J), dtype=np.float64), rms_px=rms)


def _epnp(X: Array, uv: Array, intrinsics: Intrinsics) -> Array:
    """Translation and rotation vector (6,) by EPnP. Lengths go in as millimetres, which conditions it better."""
    found, rvec, tvec = cv2.solvePnP(X * 1e3, uv, intrinsics.matrix, None, flags=cv2.SOLVEPNP_EPNP)
    if not found or not np.isfinite(tvec).all() or tvec[2, 0] <= 0:
        raise PnpError("EPnP finds no pose in front of the camera for these keypoints")
    R, _ = cv2.Rodrigues(rvec)
    return np.concatenate([np.asarray(tvec, dtype=np.float64).ravel() * 1e-3, rotvec_from_rotation(R)])


def _reproject(pose: Array, X: Array, uv: Array, whiten: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Whitened residuals (2K,) and their Jacobian (2K, 6) with respect to (translation, rotation vector)."""
    seen, J = cv2.projectPoints(X, pose[3:], pose[:3], intrinsics.matrix, None)
    J = np.concatenate([J[:, 3:6], J[:, :3]], axis=1).reshape(-1, 2, 6)
    return (whiten @ (seen.reshape(-1, 2) - uv)[..., None]).ravel(), (whiten @ J).reshape(-1, 6)


def _reproject_spatial(T: Array, X: Array, whiten: Array, intrinsics: Intrinsics) -> Array:
    """Whitened Jacobian (2K, 6) with respect to (translation, small rotation applied on the left about the part)."""
    offset = X @ T[:3, :3].T
    p = offset + T[:3, 3]
    zero = np.zeros(len(X))
    d_uv = np.stack(
        [
            np.stack([intrinsics.fx / p[:, 2], zero, -intrinsics.fx * p[:, 0] / p[:, 2] ** 2], axis=-1),
            np.stack([zero, intrinsics.fy / p[:, 2], -intrinsics.fy * p[:, 1] / p[:, 2] ** 2], axis=-1),
        ],
        axis=1,
    )  # (K, 2, 3)
    turn = -np.cross(offset[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)  # columns e_i x offset
    return (whiten @ np.concatenate([d_uv, d_uv @ turn], axis=-1)).reshape(-1, 6)
