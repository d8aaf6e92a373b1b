"""Which placements of a part look the same from straight above, computed from the CAD.

Two placements look the same when their height and normal maps, drawn from above, differ over less than
``SAME_VIEW_MM2``. A pose that looks like itself at other yaws counts: a nut does every 60 degrees. Of a pose that may
roll, only the stored roll is compared: at another one a socket or a marking on the part's side looks otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.parts import Part, StablePose, ViewEquivalent, planar
from cad.spatial import Array, apply, inverse, rotation_angle, rotation_z, wrap_angle, yaw_of
from perception.silhouette import rasterise, solid_of

SAME_VIEW_MM2 = 0.3
"""Area that must look different for two placements to be told apart (found by experiment at 67 um a pixel)."""

_PIXEL_M = 1e-4
_HEIGHT_STEP_M = 1.5e-4  # a height difference above this is seen
_NORMAL_COSINE = 0.94  # and so is a change of the surface normal by 20 degrees
_COARSE_STEP = np.radians(5.0)
_COARSE_LIMIT_MM2 = 6.0  # coarse minima above this are not worth refining: 2.5 degrees off costs about 2 mm^2
_SNAP_RAD = np.radians(3.0)
_LEVEL_RAD = np.radians(1.0)
_ROUND_STEP = np.radians(10.0)  # a view that is the same at every yaw is listed at these


@dataclass(frozen=True, kw_only=True, eq=False)
class TopView:
    """Height (N, N) in metres (minus infinity off the part) and unit normal (N, N, 3) seen from straight above, rows
    along +y, columns along +x, centred on ``centroid`` (2,), the centroid of the silhouette.
    """

    height: Array
    normal: Array
    centroid: Array

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where the part is, (N, N)."""
        return np.isfinite(self.height)

    @property
    def profile_mm2(self) -> Array:
        """Area of the silhouette in each ring of one pixel's width about its centroid: it is the same at any yaw."""
        size = len(self.height)
        offsets = np.stack(np.nonzero(self.mask)) - (size - 1) / 2
        return _mm2(np.bincount(np.hypot(*offsets).astype(np.int64), minlength=size))


def find_view_equivalents(part: Part) -> tuple[tuple[ViewEquivalent, ...], ...]:
    """For each stable pose of a part the other placements that look like it at yaw 0.

    They go both ways: when pose b looks like pose a, pose a is listed for b. Yaw and shift are exact where the part is
    symmetric, else to half a degree and some tens of micrometres.
    """
    low, high = part.mesh.bounds
    size = int(np.ceil(np.linalg.norm(high - low) / _PIXEL_M)) + 8
    views = [top_view(part, pose, size) for pose in part.stable_poses]
    profiles = [view.profile_mm2 for view in views]
    found: list[list[ViewEquivalent]] = [[] for _ in views]
    for i, a in enumerate(views):
        for j in range(i, len(views)):
            if np.abs(profiles[i] - profiles[j]).sum() > _COARSE_LIMIT_MM2:
                continue
            b = views[j]
            exact = _symmetric_placements(part, part.stable_poses[i], part.stable_poses[j])
            for yaw in _same_yaws(a, b, itself=i == j):
                placement = _snapped(planar(*_shift(a, b, yaw), yaw), exact)
                found[i].append(_as_equivalent(j, placement))
                if j != i:
                    found[j].append(_as_equivalent(i, inverse(placement)))
    return tuple(tuple(equivalents) for equivalents in found)


def top_view(part: Part, pose: StablePose, size: int) -> TopView:
    """Orthographic view of a resting part, ``size`` pixels of 0.1 mm wide."""
    solid = solid_of(part)
    vertices = apply(pose.T_table_part, solid.vertices)
    normals = solid.normals @ pose.R_table_part.T
    up = np.flatnonzero(normals[:, 2] > 0.02)

    def draw(centre: Array) -> tuple[Array, NDArray[np.int64]]:
        uv = (vertices[:, :2] - centre) / _PIXEL_M + (size - 1) / 2
        return rasterise(uv, vertices[:, 2], solid.faces[up], size, size)

    _, seen = draw(np.zeros(2))
    rows, columns = np.nonzero(seen >= 0)
    centroid = (np.array([columns.mean(), rows.mean()]) - (size - 1) / 2) * _PIXEL_M
    height, seen = draw(centroid)
    normal = np.where((seen >= 0)[..., None], normals[up[np.maximum(seen, 0)]], 0.0)
    return TopView(height=height, normal=normal, centroid=centroid)


def view_difference_mm2(a: TopView, b: TopView, yaw: float) -> tuple[float, float]:
    """Area that looks different between ``a`` and ``b`` turned by ``yaw`` rad about its centroid.

    First without strips thinner than two pixels, which come from sampling: it decides whether two views are told apart.
    Then with them: it is least where they fit best.
    """
    size = a.height.shape[0]
    grid = np.stack(np.meshgrid(*[np.arange(size) - (size - 1) / 2] * 2), axis=-1)  # (N, N, 2) as x, y
    source = grid @ rotation_z(yaw)[:2, :2] + (size - 1) / 2  # where each pixel comes from: turned back by yaw
    column, row = np.rint(source).astype(np.int64).transpose(2, 0, 1)
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    flat = np.where(inside, row * size + column, 0)
    height = np.where(inside, b.height.ravel()[flat], -np.inf)
    normal = b.normal.reshape(-1, 3)[flat] @ rotation_z(yaw).T
    mask_a, mask_b = a.mask, np.isfinite(height)
    both = mask_a & mask_b
    differs = mask_a ^ mask_b
    if both.any():
        step = np.where(both, a.height, 0.0) - np.where(both, height, 0.0)
        step -= np.median(step[both])
        turned = (a.normal * normal).sum(axis=-1) < _NORMAL_COSINE
        differs |= both & ((np.abs(step) > _HEIGHT_STEP_M) | turned)
    thick = cv2.erode(differs.astype(np.uint8), np.ones((2, 2), np.uint8))
    return float(_mm2(thick.sum())), float(_mm2(differs.sum()))


def _same_yaws(a: TopView, b: TopView, itself: bool) -> list[float]:
    """Yaws at which ``b`` looks like ``a``, without 0 when it is ``itself``: a sweep by 5 degrees, then finer."""
    yaws = np.arange(0.0, 2 * np.pi - 1e-9, _COARSE_STEP)
    thick, whole = np.array([view_difference_mm2(a, b, yaw) for yaw in yaws]).T
    if (thick < SAME_VIEW_MM2).all():
        return np.arange(_ROUND_STEP if itself else 0.0, 2 * np.pi - 1e-9, _ROUND_STEP).tolist()
    minima = (whole <= np.roll(whole, 1)) & (whole < np.roll(whole, -1)) & (thick < _COARSE_LIMIT_MM2)
    found: list[float] = []
    for yaw in yaws[minima]:
        near = yaw + np.radians(np.arange(-4.0, 4.1, 0.5))
        thick, whole = np.array([view_difference_mm2(a, b, y) for y in near]).T
        yaw = float(near[whole.argmin()])
        if thick.min() < SAME_VIEW_MM2 and not (itself and abs(float(wrap_angle(yaw))) < 2 * _COARSE_STEP):
            found.append(yaw)
    return found


def _shift(a: TopView, b: TopView, yaw: float) -> tuple[float, float]:
    """By how much ``b``, turned by ``yaw``, is moved to lie where ``a`` does."""
    x, y = a.centroid - rotation_z(yaw)[:2, :2] @ b.centroid
    return float(x), float(y)


def _symmetric_placements(part: Part, a: StablePose, b: StablePose) -> list[Array]:
    """Motions in the table's plane (4, 4) that lay the part from pose ``b`` into pose ``a``, by its symmetries."""
    motions = [a.T_table_part @ S @ inverse(b.T_table_part) for S in part.symmetries.elements]
    return [motion for motion in motions if motion[2, 2] > np.cos(_LEVEL_RAD)]


def _snapped(placement: Array, exact: list[Array]) -> Array:
    """The exact motion (4, 4) that a placement found by comparing pixels is near to, else the placement itself."""
    return next((T for T in exact if rotation_angle(T[:3, :3], placement[:3, :3]) < _SNAP_RAD), placement)


def _as_equivalent(stable_pose: int, placement: Array) -> ViewEquivalent:
    return ViewEquivalent(
        stable_pose=stable_pose,
        yaw=float(wrap_angle(yaw_of(placement[:3, :3]))),
        shift_m=(float(placement[0, 3]), float(placement[1, 3])),
    )


def _mm2(pixels: ArrayLike) -> Array:
    return np.asarray(pixels, dtype=np.float64) * (1e3 * _PIXEL_M) ** 2
