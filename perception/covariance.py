"""A covariance that holds: how far poses of resting parts are off, as seen on validation frames.

An error has six parts, one for each thing that goes wrong on its own. In the table's plane, x, y and yaw of the
contour: the covariance of Gauss-Newton, scaled, since neighbouring profiles are not independent, and a floor, since
chamfers and shadows pull edges the same way. Off the plane, what a resting pose takes as exact: the height of the table
below the part, read from the tags, and the part's lean on it. A wrong height moves a part along the ray to the camera,
because its image stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from cad.spatial import Array, apply, rotvec_from_rotation

GROSS = 80.0
"""Normalised error squared, of six degrees, beyond which an estimate counts as an outlier when the noise is fitted."""
FEWEST = 20
"""Estimates of a part that are needed to fit its noise."""


@dataclass(frozen=True, kw_only=True)
class NoiseModel:
    """Standard deviations that the contour's own covariance does not know of.

    ``scale`` multiplies the covariance of Gauss-Newton; ``floor_m`` (x and y) and ``floor_rad`` (yaw) are added to it
    in squares. ``height_m`` is that of the table's height at the part, ``lean_rad`` that of the part's lean.
    """

    scale: float = 4.0
    floor_m: float = 1.6e-5
    floor_rad: float = float(np.radians(0.05))
    height_m: float = 3e-5
    lean_rad: float = float(np.radians(0.15))

    def __post_init__(self) -> None:
        for name in ("scale", "floor_m", "floor_rad", "height_m", "lean_rad"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be above 0")

    def inner(self, planar: Array) -> Array:
        """Covariance (6, 6) of (x, y, yaw, height, lean, lean) from Gauss-Newton's (3, 3) of (x, y, yaw)."""
        out = np.zeros((6, 6))
        out[:3, :3] = self.scale * planar
        out += np.diag(np.square([self.floor_m, self.floor_m, self.floor_rad, self.height_m, *[self.lean_rad] * 2]))
        return out


def pose_jacobian(T_cam_table: Array, T_cam_part: Array, x: float, y: float) -> Array:
    """Derivative (6, 6) of (translation, rotation vector) in ``cam`` by (x, y, yaw, height, lean about x, about y).

    ``x``, ``y`` is the footprint's centre in the table frame, about which yaw and lean turn.
    """
    R = T_cam_table[:3, :3]
    foot = apply(T_cam_table, [x, y, 0.0])
    arm = T_cam_part[:3, 3] - foot
    J = np.zeros((6, 6))
    J[:3, 0], J[:3, 1] = R[:, 0], R[:, 1]
    J[:3, 3] = foot / float(R[:, 2] @ foot)  # along the ray, by one unit of height
    for column, axis in ((2, R[:, 2]), (4, R[:, 0]), (5, R[:, 1])):
        J[:3, column], J[3:, column] = np.cross(axis, arm), axis
    return J


def pose_covariance(
    planar: Array, noise: NoiseModel, T_cam_table: Array, T_cam_part: Array, x: float, y: float
) -> Array:
    """Covariance (6, 6) of (translation m, rotation vector rad) in ``cam`` from Gauss-Newton's (3, 3) of x, y, yaw."""
    J = pose_jacobian(T_cam_table, T_cam_part, x, y)
    return J @ noise.inner(planar) @ J.T


def inner_error(T_cam_part_true: Array, T_cam_part: Array, T_cam_table: Array, x: float, y: float) -> Array:
    """What is wrong (6,) with an estimate, as (x, y, yaw, height, lean about x, lean about y): truth minus estimate."""
    turn = rotvec_from_rotation(T_cam_part_true[:3, :3] @ T_cam_part[:3, :3].T)
    apart = np.concatenate([T_cam_part_true[:3, 3] - T_cam_part[:3, 3], turn])
    return np.asarray(np.linalg.solve(pose_jacobian(T_cam_table, T_cam_part, x, y), apart), np.float64)


def normalised_squares(errors: Array, planars: Array, noise: NoiseModel) -> tuple[Array, Array]:
    """Normalised errors squared (N,) of x, y, yaw (3 degrees of freedom) and of the whole pose (6).

    ``errors`` (N, 6) as from :func:`inner_error`, ``planars`` (N, 3, 3) Gauss-Newton's covariances.
    """
    flat = noise.scale * planars + np.diag(np.square([noise.floor_m, noise.floor_m, noise.floor_rad]))
    planar = np.einsum("ni,ni->n", errors[:, :3], np.linalg.solve(flat, errors[:, :3, None])[..., 0])
    rest = (errors[:, 3:] / [noise.height_m, noise.lean_rad, noise.lean_rad]) ** 2
    return planar, planar + rest.sum(axis=1)


def fit_noise(errors: Array, planars: Array) -> NoiseModel:
    """The noise of greatest likelihood for errors (N, 6) and Gauss-Newton's covariances (N, 3, 3).

    Gross outliers are left out: it is for the gate to find them. With fewer than 20 estimates the usual figures.
    """
    if len(errors) < FEWEST:
        return NoiseModel()
    middle = 1.5 * np.median(np.abs(errors), axis=0) + 1e-9
    noise = NoiseModel(
        scale=1.0,
        floor_m=float(middle[:2].mean()),
        floor_rad=float(middle[2]),
        height_m=float(middle[3]),
        lean_rad=float(middle[4:].mean()),
    )
    for _ in range(2):
        kept = normalised_squares(errors, planars, noise)[1] < GROSS
        noise = _likeliest(errors[kept], planars[kept], noise)
    return noise


def _likeliest(errors: Array, planars: Array, start: NoiseModel) -> NoiseModel:
    unit = np.array([1e-5, 1e-5, 1e-3])  # so that all is near one
    e, C = errors[:, :3] / unit, planars / np.outer(unit, unit)

    def loss(log: Array) -> float:
        floors = np.exp(2 * log[[1, 1, 2]])
        S = np.exp(log[0]) * C + np.diag(floors)
        squares = np.einsum("ni,ni->n", e, np.linalg.solve(S, e[..., None])[..., 0])
        # A weak pull to the start decides where scale and floor can stand for each other.
        return float(np.mean(np.linalg.slogdet(S)[1] + squares) + 1e-3 * np.sum((log - first) ** 2))

    first = np.log([start.scale, start.floor_m / unit[0], start.floor_rad / unit[2]])
    found = minimize(loss, first, method="L-BFGS-B", bounds=[(f - 7.0, f + 7.0) for f in first])
    scale, floor_m, floor_rad = np.exp(found.x) * [1.0, unit[0], unit[2]]
    return NoiseModel(
        scale=float(scale),
        floor_m=float(floor_m),
        floor_rad=float(floor_rad),
        height_m=float(np.sqrt(np.mean(errors[:, 3] ** 2)) + 1e-7),
        lean_rad=float(np.sqrt(np.mean(errors[:, 4:] ** 2)) + 1e-6),
    )
