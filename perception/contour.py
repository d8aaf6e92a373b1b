"""Sub-pixel refinement of a part's place on the table from its contour: x, y and yaw with the resting face known.

Four steps, coarse to fine. A grid over contrast-normalised gradients finds where the CAD's visible edges may lie; edges
are then searched along their normals (iterated closest points, Gauss-Newton). Thin walls give parallel edges, so the
neighbourhood of each result is scanned with the profile model and the candidate that explains the image best is kept,
and the same model gives the final, sub-pixel step. Everything is in the table frame; the camera's pose is taken as
exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from cad.parts import Part
from cad.spatial import Array, Intrinsics
from perception.edges import EdgeSamples, visible_edges
from perception.gradients import EdgeImage, Image32, across
from perception.profiles import ProfileConfig, ProfileFit, ProfileModel
from perception.table_camera import TableCamera


@dataclass(frozen=True, kw_only=True)
class ContourConfig:
    """How a contour is searched for. Lengths in pixels of the full-resolution crop, angles in radians.

    ``starts`` peaks of the grid are followed, each by one Gauss-Newton step for every entry of ``reach_px``; of the
    scanned neighbourhoods the best ``candidates`` are fitted. ``stride`` thins the samples until the last step.
    A start is taken to be right within ``start_sigma_m``: a candidate at that distance must explain ``stray_cost`` more
    of the brightness than one at the start. ``places`` that are ``apart_m`` and explain ``nearly`` as much are told.
    """

    grid_px: float = 8.0
    grid_step_px: float = 2.0
    grid_yaw: float = float(np.radians(5.0))
    grid_yaw_step: float = float(np.radians(1.67))
    starts: int = 5
    reach_px: tuple[float, ...] = (4.0, 3.0, 2.0)
    edge_step_px: float = 0.5
    scan_px: float = 4.0
    candidates: int = 6
    stride: int = 4
    rounds: int = 3
    inlier_px: float = 1.0
    start_sigma_m: float = 3.5e-4
    stray_cost: float = 0.005
    places: int = 3
    apart_m: float = 1.5e-4
    nearly: float = 0.15
    profile: ProfileConfig = field(default_factory=ProfileConfig)

    def __post_init__(self) -> None:
        if min(self.reach_px) < 2 * self.edge_step_px:
            raise ValueError(f"reach {self.reach_px} must be at least twice the step {self.edge_step_px}")
        if self.grid_px < self.grid_step_px or self.grid_yaw < self.grid_yaw_step:
            raise ValueError("the grid must be at least one step wide")
        if min(self.starts, self.candidates, self.stride, self.rounds) < 1:
            raise ValueError("starts, candidates, stride and rounds must be at least 1")


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """A contour laid on the image.

    ``x``, ``y`` m and ``yaw`` rad in the table frame with ``covariance`` (3, 3), as of independent noise (see
    ``perception.covariance`` for what errors really are); ``matched_fraction`` of the weighted
    contour has an edge within a pixel, ``matched_outline`` the same for outlines alone; ``correlation`` in [0, 1] is
    the mean contrast-normalised gradient across the contour; ``explained`` in [0, 1] the share of the brightness
    variance along profiles across it that the CAD's patches explain.
    """

    x: float
    y: float
    yaw: float
    covariance: Array
    matched_fraction: float
    matched_outline: float
    correlation: float
    explained: float


def refine_all(
    image: NDArray[np.uint8] | Image32 | EdgeImage,
    intrinsics: Intrinsics,
    part: Part,
    stable_pose: int,
    T_cam_table: Array,
    x: float,
    y: float,
    yaw: float,
    config: ContourConfig | None = None,
) -> list[Refinement]:
    """Lay the contour of a part resting on ``stable_pose`` on a gray crop (H, W), or its EdgeImage, near (x, y, yaw).

    ``intrinsics`` are the crop's at its own resolution, ``T_cam_table`` (4, 4). Finds contours within the grid of the
    config, at full resolution 8 pixels and 5 degrees, and returns every place that explains the image about as well as
    the best, best first and at least one: the caller judges them by their scores, since a covariance stays small at a
    wrong optimum.

    The outline of a shadow, or the inner edge of a rim, can look like the part's own outline; what lies inside of it
    tells them apart (see ``region``), which is for the caller to weigh.
    """
    config = config or ContourConfig()
    edges = image if isinstance(image, EdgeImage) else EdgeImage.of(image)
    camera = TableCamera(intrinsics=intrinsics, T_cam_table=T_cam_table)
    start = np.array([x, y, yaw])
    samples = visible_edges(part, stable_pose, camera.eye(start))
    sparse = samples.every(config.stride)
    metres_per_pixel = camera.metres_per_pixel(start)

    near = [_follow_edges(edges, camera, sparse, at, config) for at in _grid(edges, camera, sparse, start, config)]
    rough = ProfileModel(sparse, camera, metres_per_pixel, config.profile)
    rougher = ProfileModel(sparse.every(2), camera, metres_per_pixel, config.profile)
    pool = [scanned for pose in near for scanned in _scan(edges, rougher, pose, config)]
    best = sorted(pool, key=lambda scored: _strayed(start, scored[1], config) - scored[0])[: config.candidates]
    fits = [rough.fit(edges.gray, pose, config.rounds) for _, pose in best]
    exact = ProfileModel(samples, camera, metres_per_pixel, config.profile)
    return [
        _result(edges, exact, exact.fit(edges.gray, fit.pose, config.rounds), config)
        for fit in _distinct(start, fits, config)
    ]


def _result(edges: EdgeImage, model: ProfileModel, fit: ProfileFit, config: ContourConfig) -> Refinement:
    matched, matched_outline, correlation = _agreement(edges, model.camera, model.samples, fit.pose, config)
    return Refinement(
        x=float(fit.pose[0]),
        y=float(fit.pose[1]),
        yaw=float(fit.pose[2]),
        covariance=fit.covariance,
        matched_fraction=matched,
        matched_outline=matched_outline,
        correlation=correlation,
        explained=fit.explained,
    )


def _distinct(start: Array, fits: Sequence[ProfileFit], config: ContourConfig) -> list[ProfileFit]:
    """The best fit, and others in a different place that explain nearly as much; ``places`` in all."""
    ranked = sorted(fits, key=lambda fit: _strayed(start, fit.pose, config) - fit.explained)
    kept = ranked[:1]
    for fit in ranked[1:]:
        close = ranked[0].explained - fit.explained < config.nearly
        apart = all(np.hypot(*(fit.pose - other.pose)[:2]) > config.apart_m for other in kept)
        if close and apart and len(kept) < config.places:
            kept.append(fit)
    return kept


def _grid(
    edges: EdgeImage, camera: TableCamera, samples: EdgeSamples, pose: Array, config: ContourConfig
) -> list[Array]:
    """The best local maxima of the gradient across the contour, over shifts and turns of ``pose``."""
    shifts = np.arange(-config.grid_px, config.grid_px + 0.1, config.grid_step_px)
    yaws = np.arange(-config.grid_yaw, config.grid_yaw + 1e-6, config.grid_yaw_step)
    du, dv = (d.ravel() for d in np.meshgrid(shifts, shifts, indexing="ij"))
    scores = np.empty((len(yaws), len(shifts), len(shifts)))
    for i, turn in enumerate(yaws):
        pixels, normals, _ = camera.project(samples, pose + np.array([0.0, 0.0, turn]))
        u = (pixels[None, :, 0] + du[:, None]).astype(np.float32)
        v = (pixels[None, :, 1] + dv[:, None]).astype(np.float32)
        response = np.abs(across(edges.coarse, u, v, normals)) @ samples.weights
        scores[i] = response.reshape(len(shifts), len(shifts))
    peaks = np.argwhere(scores == maximum_filter(scores, size=3))
    peaks = peaks[np.argsort(-scores[tuple(peaks.T)], kind="stable")][: config.starts]
    return [
        camera.shifted(pose, float(shifts[j]), float(shifts[k])) + np.array([0.0, 0.0, yaws[i]]) for i, j, k in peaks
    ]


def _follow_edges(
    edges: EdgeImage, camera: TableCamera, samples: EdgeSamples, pose: Array, config: ContourConfig
) -> Array:
    """Move ``pose`` towards the image edges within each reach along the contour's normals, one step a reach."""
    for reach in config.reach_px:
        pixels, normals, jacobian = camera.project(samples, pose)
        distance, strength = _nearest_edges(edges, pixels, normals, reach, config.edge_step_px)
        weight = samples.weights * np.minimum(strength / (3 * edges.threshold), 1.0)
        weight[(strength < edges.threshold) | ~normals.any(axis=1)] = 0.0
        step = _robust_step(jacobian, distance, weight, max(1.0, 0.7 * reach))
        pose = pose + np.clip(step, [-6e-4, -6e-4, -0.15], [6e-4, 6e-4, 0.15])
    return pose


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


def _robust_step(jacobian: Array, distance: Array, weight: Array, scale: float) -> Array:
    """Robust (Tukey) least squares for the step (3,) that removes the distances (N,)."""
    unit = np.array([1e-4, 1e-4, 1e-2])  # about a pixel each, so that the ridge is even
    scaled, residual, step = jacobian * unit, distance, np.zeros(3)
    for _ in range(3):
        robust = weight * np.clip(1 - (residual / (2.2 * scale)) ** 2, 0.0, 1.0) ** 2
        normal = (scaled * robust[:, None]).T @ scaled
        ridge = 1e-6 * (np.trace(normal) + 1e-3) * np.eye(3)
        step = np.linalg.solve(normal + ridge, (scaled * robust[:, None]).T @ distance)
        residual = distance - scaled @ step
    return step * unit


def _scan(edges: EdgeImage, model: ProfileModel, pose: Array, config: ContourConfig) -> list[tuple[float, Array]]:
    """Local maxima of the explained share over whole-pixel shifts of ``pose``, each with the shifted pose."""
    shifts = np.arange(-config.scan_px, config.scan_px + 0.1)
    du, dv = (d.ravel() for d in np.meshgrid(shifts, shifts, indexing="ij"))
    explained = model.explained_at(edges.gray, pose, np.stack([du, dv], axis=1)).reshape(len(shifts), -1)
    peaks = np.argwhere(explained == maximum_filter(explained, size=3))
    return [(float(explained[j, k]), model.camera.shifted(pose, float(shifts[j]), float(shifts[k]))) for j, k in peaks]


def _strayed(start: Array, pose: Array, config: ContourConfig) -> float:
    """What a candidate's distance from the start costs, in units of the explained share."""
    return config.stray_cost * float(((pose - start)[:2] ** 2).sum()) / config.start_sigma_m**2


def _agreement(
    edges: EdgeImage, camera: TableCamera, samples: EdgeSamples, pose: Array, config: ContourConfig
) -> tuple[float, float, float]:
    """Matched fraction of the contour, of its outlines, and correlation with the gradients at ``pose``."""
    pixels, normals, _ = camera.project(samples, pose)
    shown = samples.weights * normals.any(axis=1)
    distance, strength = _nearest_edges(edges, pixels, normals, 3 * config.inlier_px, config.edge_step_px)
    matched = shown * ((strength > edges.threshold) & (np.abs(distance) < config.inlier_px))
    p = pixels.astype(np.float32)
    response = np.abs(across(edges.fine, p[None, :, 0], p[None, :, 1], normals))[0]
    total, outline = shown.sum() + 1e-12, shown[samples.outline].sum() + 1e-12
    return (
        float(matched.sum() / total),
        float(matched[samples.outline].sum() / outline),
        float(response @ samples.weights / total),
    )
