"""Light on the ground that things lie on: it changes slowly except near them, so most pixels need few samples.

Far from things a picture of the ground is, colour by colour, a smooth field times its reflectance plus another one.
Both fields are fitted to noisy colours by a guided filter (He, Sun and Tang 2010) whose guide is the reflectance, which
is known almost without noise: prints and textures stay as sharp as the guide, and the mean of the light is kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics, apply, inverse
from scenes.scene_export import DrawnGeom, DrawnLamp

Colours = NDArray[np.float32]

RADIUS = 8
"""Half the side of the squares, pixels, over which the fields are taken as constant."""
LEAST_VARIANCE = np.float32(1e-6)
"""Of a guide: one that varies less says nothing."""
SPECK_FACTOR, SPECK_REFLECTANCE = np.float32(2.0), np.float32(0.05)
BAND_ROWS = 512
MARGIN_M = 0.0015
"""How far round things and their shadows light changes fast: half shadows, light thrown back."""


def smooth_light(colours: Colours, reflectance: Colours) -> Colours:
    """Noisy ``colours`` (H, W, 3) of a ground of that ``reflectance`` (H, W, 3; 0..1) without most of their noise."""
    smooth = np.empty_like(colours)
    reach = 2 * RADIUS + 2
    for top in range(0, len(colours), BAND_ROWS):
        bottom = min(top + BAND_ROWS, len(colours))
        first, last = max(0, top - reach), min(len(colours), bottom + reach)
        band = _fitted(colours[first:last], reflectance[first:last])
        smooth[top:bottom] = band[top - first : bottom - first]
    return smooth


def _fitted(colours: Colours, guide: Colours) -> Colours:
    levels = _without_specks(colours, guide)
    mean_guide, mean = _mean(guide), _mean(levels)
    variance = _mean(guide * guide) - mean_guide * mean_guide
    slope = np.divide(_mean(guide * levels) - mean_guide * mean, variance + LEAST_VARIANCE, dtype=np.float32)
    return _mean(slope) * guide + _mean(mean - slope * mean_guide)


def _without_specks(colours: Colours, guide: Colours) -> Colours:
    """Single pixels that are lit far more than those round them, by a rare path to a lamp, are cut down."""
    weight = guide + SPECK_REFLECTANCE
    light = colours / weight
    around = np.asarray(cv2.medianBlur(light, 5), np.float32)
    return np.minimum(light, SPECK_FACTOR * around) * weight


def _mean(image: Colours) -> Colours:
    side = (2 * RADIUS + 1, 2 * RADIUS + 1)
    return np.asarray(cv2.blur(image, side, borderType=cv2.BORDER_REFLECT), np.float32)


def near_things(
    things: Sequence[DrawnGeom], lamps: Sequence[DrawnLamp], window: Intrinsics, T_world_cam: Array
) -> NDArray[np.bool_]:
    """Pixels (H, W) of a window that show things, the shadows that they cast, and what is within ``MARGIN_M`` of them.

    Shadows are those on the level of a thing's lowest point.
    """
    near = np.zeros((window.height, window.width), np.uint8)
    T_cam_world = inverse(T_world_cam)
    for thing in things:
        corners = thing.world_vertices
        for shadow in (corners[:0], *(_shadow(corners, lamp) for lamp in lamps)):
            seen = apply(T_cam_world, np.concatenate([corners, shadow]))
            if seen[:, 2].min() > 0:
                margin_px = MARGIN_M * window.fx / float(seen[:, 2].min())
                _paint(near, window.project(seen), margin_px)
    return near.astype(bool)


def _paint(image: NDArray[np.uint8], uv: Array, margin_px: float) -> None:
    """Fill the convex hull of pixels (N, 2), and what is that near it, with ones."""
    farthest = 4.0 * max(image.shape)
    hull = cv2.convexHull(np.clip(np.rint(uv), -farthest, farthest).astype(np.int32))
    cv2.fillConvexPoly(image, hull, (1,))
    cv2.polylines(image, [hull], True, (1,), thickness=1 + 2 * math.ceil(margin_px))


def boxes(mask: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Rectangles (left, top, width, height) round the connected pieces of a mask (H, W)."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return [(int(x), int(y), int(w), int(h)) for x, y, w, h in stats[1:count, :4]]


def _shadow(points: Array, lamp: DrawnLamp) -> Array:
    """Where a lamp's rays through points (N, 3) meet the level of the lowest one; no shadow of what is above it."""
    away = np.broadcast_to(lamp.direction, points.shape) if lamp.kind == "directional" else points - lamp.position
    down = away[:, 2] < 0
    points, away = points[down], away[down]
    if not len(points):
        return points
    return points + away * ((points[:, 2] - points[:, 2].min()) / -away[:, 2])[:, None]
