"""Sub-pixel refinement of a part's place on the table from its contour: x, y and yaw with the resting face known.

The CAD's visible edges are laid over the image. A coarse grid over contrast-normalised gradients finds the basin (thin
walls give parallel edges, and a local search would lock on the wrong one), then Gauss-Newton moves x, y and yaw until
edges found along the normals of the projected ones coincide with them. Everything is in the table frame; the camera's
pose is taken as exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, Intrinsics
from perception.edges import EdgeSamples, visible_edges
from perception.gradients import EdgeImage, Image32, across
from perception.table_camera import TableCamera


@dataclass(frozen=True, kw_only=True)
class ContourConfig:
    """How a contour is searched for. Lengths in pixels of the full-resolution crop, angles in radians."""

    grid_px: float = 8.0
    grid_step_px: float = 2.0
    grid_yaw: float = float(np.radians(5.0))
    grid_yaw_step: float = float(np.radians(1.67))
    reach_px: tuple[float, ...] = (4.0, 3.0, 2.0, 1.5)
    final_reach_px: tuple[float, ...] = (1.5, 1.5, 1.5)
    sample_step_px: float = 0.5
    inlier_px: float = 1.0
    samples_per_degree_of_freedom: float = 4.0

    def __post_init__(self) -> None:
        if min(self.reach_px + self.final_reach_px) < 2 * self.sample_step_px:
            raise ValueError(
                f"reach {self.reach_px} {self.final_reach_px} must be at least twice the step {self.sample_step_px}"
            )
        if self.grid_px < self.grid_step_px or self.grid_yaw < self.grid_yaw_step:
            raise ValueError("the grid must be at least one step wide")


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """A contour laid on the image.

    ``x``, ``y`` m and ``yaw`` rad in the table frame with ``covariance`` (3, 3); ``matched_fraction`` of the weighted
    contour has an edge within a pixel, ``matched_outline`` the same for outlines alone; ``correlation`` in [0, 1] is the
    mean contrast-normalised gradient across the contour; ``rms_px`` of the matched edges' distances.
    """

    x: float
    y: float
    yaw: float
    covariance: Array
    matched_fraction: float
    matched_outline: float
    correlation: float
    rms_px: float


@dataclass(kw_only=True)
class _Fit:
    pose: Array
    covariance: Array = field(default_factory=lambda: np.eye(3))
    fraction: float = 0.0
    outline: float = 0.0
    rms: float = 9.0
    correlation: float = 0.0


def refine(
    image: NDArray[np.uint8] | EdgeImage,
    intrinsics: Intrinsics,
    part: Part,
    stable_pose: int,
    T_cam_table: Array,
    x: float,
    y: float,
    yaw: float,
    config: ContourConfig | None = None,
) -> Refinement:
    """Lay the contour of a part resting on ``stable_pose`` on a gray crop (H, W), or its EdgeImage, near (x, y, yaw).

    ``intrinsics`` are the crop's at its own resolution, ``T_cam_table`` (4, 4). Finds contours within the grid of the
    config, at full resolution 8 pixels and 5 degrees. Always returns the best fit found: the caller judges it by its
    scores, since a covariance stays small at a wrong optimum.
    """
    config = config or ContourConfig()
    edges = image if isinstance(image, EdgeImage) else EdgeImage.of(image)
    camera = TableCamera(intrinsics=intrinsics, T_cam_table=T_cam_table)
    start = np.array([x, y, yaw])
    samples = visible_edges(part, stable_pose, camera.direction(start))
    sparse, half = samples.every(3), samples.every(2)

    near = _grid(edges.coarse, camera, sparse, start, *_steps(config))
    near = _grid(edges.fine, camera, sparse, near, np.arange(-2, 2.1, 1.0), np.radians([-1.2, -0.6, 0, 0.6, 1.2]))
    starts = ((near, config.reach_px[2:]), (near, config.reach_px), (start, (6.0, 5.0, *config.reach_px)))
    fits = [_gauss_newton(edges, camera, half, at, reach, config) for at, reach in starts]
    best = max(fits, key=lambda fit: fit.correlation)
    fit = _gauss_newton(edges, camera, samples, best.pose, config.final_reach_px, config)
    return Refinement(
        x=float(fit.pose[0]),
        y=float(fit.pose[1]),
        yaw=float(fit.pose[2]),
        covariance=fit.covariance,
        matched_fraction=fit.fraction,
        matched_outline=fit.outline,
        correlation=fit.correlation,
        rms_px=fit.rms,
    )


def _steps(config: ContourConfig) -> tuple[Array, Array]:
    shifts = np.arange(-config.grid_px, config.grid_px + 0.1, config.grid_step_px)
    return shifts, np.arange(-config.grid_yaw, config.grid_yaw + 1e-6, config.grid_yaw_step)


def _grid(
    field_uv: tuple[Image32, Image32],
    camera: TableCamera,
    samples: EdgeSamples,
    pose: Array,
    shifts: Array,
    yaws: Array,
) -> Array:
    """The pose among shifts (px, both ways) and turns (rad) of ``pose`` whose contour lies on the strongest gradients."""
    du, dv = (d.ravel() for d in np.meshgrid(shifts, shifts, indexing="ij"))
    scores = []
    for turn in yaws:
        pixels, normals, _ = camera.project(samples, pose + [0.0, 0.0, turn])
        u = (pixels[None, :, 0] + du[:, None]).astype(np.float32)
        v = (pixels[None, :, 1] + dv[:, None]).astype(np.float32)
        scores.append(np.abs(across(field_uv, u, v, normals)) @ samples.weights)
    best_turn, best_shift = np.unravel_index(np.argmax(scores), (len(yaws), len(du)))
    scale = camera.metres_per_pixel(pose)
    shift_cam = np.array([du[best_shift], dv[best_shift], 0.0]) * scale
    shift = camera.T_cam_table[:3, :3].T @ shift_cam
    return pose + [shift[0], shift[1], yaws[best_turn]]


def _gauss_newton(
    edges: EdgeImage,
    camera: TableCamera,
    samples: EdgeSamples,
    pose: Array,
    reaches: tuple[float, ...],
    config: ContourConfig,
) -> _Fit:
    """Move ``pose`` so that image edges within each reach (px) fall on the contour; one Gauss-Newton step a reach."""
    pose = pose.copy()
    fit = _Fit(pose=pose)
    for i, reach in enumerate(reaches):
        last = i >= len(reaches) - 3
        pixels, normals, jacobian = camera.project(samples, fit.pose)
        distance, strength = _nearest_edges(edges, pixels, normals, reach, config.sample_step_px)
        weight = samples.weights * np.minimum(strength / (3 * edges.threshold), 1.0)
        weight[(strength < edges.threshold) | ~normals.any(axis=1)] = 0.0
        step, hessian, robust, residual = _solve(jacobian, distance, weight, 0.8 if last else max(1.0, 0.7 * reach))
        fit.pose = fit.pose + np.clip(step, [-6e-4, -6e-4, -0.15], [6e-4, 6e-4, 0.15])

        inlier = (weight > 0) & (np.abs(residual) < config.inlier_px)
        shown = samples.weights * normals.any(axis=1)
        mass = robust.sum() + 1e-12
        variance = float((robust * residual**2).sum() / mass) + 1e-4
        effective = max(float(inlier.sum()) / config.samples_per_degree_of_freedom, 4.0)
        fit.covariance = np.linalg.inv(hessian / mass) * variance / effective
        fit.fraction = float(shown[inlier].sum() / (shown.sum() + 1e-12))
        fit.outline = float(shown[inlier & samples.outline].sum() / (shown[samples.outline].sum() + 1e-12))
        fit.rms = float(np.sqrt(variance))
    pixels, normals, _ = camera.project(samples, fit.pose)
    p = pixels.astype(np.float32)
    response = np.abs(across(edges.fine, p[None, :, 0], p[None, :, 1], normals))[0]
    fit.correlation = float(response @ samples.weights / (samples.weights @ normals.any(axis=1) + 1e-12))
    return fit


def _nearest_edges(edges: EdgeImage, pixels: Array, normals: Array, reach: float, step: float) -> tuple[Array, Array]:
    """Signed distance (N,) px along the normals to the best edge within reach, and its strength (N,), 0 for none."""
    s = np.arange(-reach, reach + 1e-6, step)
    u = (pixels[:, 0] + s[:, None] * normals[:, 0]).astype(np.float32)  # (S, N)
    v = (pixels[:, 1] + s[:, None] * normals[:, 1]).astype(np.float32)
    profile = np.abs(across(edges.gradient, u, v, normals)).astype(np.float64)
    is_peak = (profile[1:-1] >= profile[:-2]) & (profile[1:-1] > profile[2:])
    favoured = np.where(is_peak, profile[1:-1], 0.0) * np.exp(-(s[1:-1, None] ** 2) / (2 * (0.6 * reach) ** 2))
    j = favoured.argmax(axis=0) + 1
    n = np.arange(profile.shape[1])
    before, at, after = profile[j - 1, n], profile[j, n], profile[j + 1, n]
    curvature = before - 2 * at + after
    peak = 0.5 * (before - after) / np.where(curvature < -1e-6, curvature, -1e-6)
    return s[j] + step * np.clip(peak, -1.0, 1.0), np.where(is_peak[j - 1, n], at, 0.0)


def _solve(jacobian: Array, distance: Array, weight: Array, scale: float) -> tuple[Array, Array, Array, Array]:
    """Robust (Tukey) least squares for the step (3,): also the Hessian (3, 3), weights (N,) and residuals (N,)."""
    step, residual = np.zeros(3), distance
    unit = np.array([1e-4, 1e-4, 1e-2])  # about a pixel each, so that the ridge below is even
    hessian, robust = np.eye(3), weight
    for _ in range(3):
        robust = weight * np.clip(1 - (residual / (2.2 * scale)) ** 2, 0.0, 1.0) ** 2
        scaled = jacobian * unit
        normal = (scaled * robust[:, None]).T @ scaled
        ridge = 1e-6 * (np.trace(normal) + 1e-3) * np.eye(3)
        step = np.linalg.solve(normal + ridge, (scaled * robust[:, None]).T @ distance) * unit
        residual = distance - jacobian @ step
        hessian = (normal + ridge) / np.outer(unit, unit)
    return step, hessian, robust, residual
