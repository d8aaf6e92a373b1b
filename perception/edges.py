"""Edges of a part that show in an image, from its CAD: outlines and creases, sampled, with occluded ones left out.

An outline is an edge between a face turned to the camera and one turned away; a crease is one between two visible
faces that meet at more than 20 degrees (the chords of a rounded bend meet at less and show no edge). Samples are in
frame ``rest``: the table frame of the part at x = y = yaw = 0, that is ``T_table_part`` applied. What is visible depends
on the direction to the camera alone, so sets are kept per part, stable pose and direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, apply
from perception.silhouette import Solid, rasterise, solid_of

CREASE_ANGLE = np.radians(20.0)
SAMPLE_STEP_M = 1.2e-4
OUTLINE_WEIGHT = 1.0
CREASE_WEIGHT = 0.35

_PIXEL_M = 4e-5  # of the orthographic depth map that occlusion is tested against
_DIRECTION_STEP = 0.02  # rad; directions to the camera are rounded to this
_GRAZING = 0.02  # sine of the angle under which a face counts as seen edge-on
_LIFT_M = 5e-5  # a sample is hidden when something lies nearer than this in front of it


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeSamples:
    """Points on visible edges, in frame ``rest``.

    ``points`` (N, 3) m, ``tangents`` (N, 3) unit, ``weights`` (N,) 1 on outlines and less on creases,
    ``outline`` (N,) bool. Every sample stands for ``SAMPLE_STEP_M`` of edge.
    """

    points: Array
    tangents: Array
    weights: Array
    outline: NDArray[np.bool_]

    def every(self, stride: int) -> EdgeSamples:
        """One sample in ``stride``."""
        return EdgeSamples(
            points=self.points[::stride],
            tangents=self.tangents[::stride],
            weights=self.weights[::stride],
            outline=self.outline[::stride],
        )


def visible_edges(part: Part, stable_pose: int, direction: Array) -> EdgeSamples:
    """Edges of a part at rest seen from far away along ``direction`` (3,), a vector in ``rest`` from part to camera.

    The direction is rounded to about a degree. Raises IndexError for a stable pose the part does not have and
    ValueError for a camera that is not above the table.
    """
    if not 0 <= stable_pose < len(part.stable_poses):
        raise IndexError(f"part {part.name!r} has {len(part.stable_poses)} stable poses; {stable_pose} is not one")
    if direction[2] <= 0:
        raise ValueError(f"direction {np.round(direction, 3)} points below the table; the camera must be above it")
    slope = np.round(np.asarray(direction[:2]) / direction[2] / _DIRECTION_STEP).astype(int)
    return _edges_from(part, stable_pose, int(slope[0]), int(slope[1]))


@lru_cache(maxsize=4096)
def _edges_from(part: Part, stable_pose: int, slope_x: int, slope_y: int) -> EdgeSamples:
    towards = np.array([slope_x * _DIRECTION_STEP, slope_y * _DIRECTION_STEP, 1.0])
    towards /= np.linalg.norm(towards)
    solid, T_rest_part = solid_of(part), part.stable_poses[stable_pose].T_table_part
    facing = solid.normals @ (T_rest_part[:3, :3].T @ towards)  # (F,) cosine between normal and view
    a, b = facing[solid.edge_faces].T
    outline = np.minimum(a, b) * np.maximum(a, b) < 0
    crease = (np.minimum(a, b) > _GRAZING) & (solid.edge_angle > CREASE_ANGLE)
    chosen = np.flatnonzero(outline | crease)

    edge, points, tangents = _sample(apply(T_rest_part, solid.edge_ends[chosen]))
    edge = chosen[edge]
    outward = solid.normals[solid.edge_faces[edge]].sum(axis=1) @ T_rest_part[:3, :3].T
    seen = ~_hidden(solid, T_rest_part, facing, towards, points, outward)
    edge, points, tangents = edge[seen], points[seen], tangents[seen]
    return EdgeSamples(
        points=points,
        tangents=tangents,
        weights=np.where(outline[edge], OUTLINE_WEIGHT, CREASE_WEIGHT),
        outline=outline[edge],
    )


def _sample(ends: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """Evenly spaced points along segments (E, 2, 3) laid end to end, so that chords of any length get their share."""
    step = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(step, axis=1)
    stop = np.cumsum(length)
    total = float(stop[-1]) if len(stop) else 0.0
    at = np.arange(SAMPLE_STEP_M / 2, total, SAMPLE_STEP_M)
    edge = np.minimum(np.searchsorted(stop, at), max(len(stop) - 1, 0))
    tangents = step[edge] / length[edge, None]
    return edge, ends[edge, 0] + (at - stop[edge] + length[edge])[:, None] * tangents, tangents


def _hidden(
    solid: Solid, T_rest_part: Array, facing: Array, towards: Array, points: Array, outward: Array
) -> NDArray[np.bool_]:
    """Which points (N, 3) have part of the surface in front of them, looking against ``towards``.

    A point is moved a pixel outwards, away from the faces it joins, before the depth there is compared.
    """
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    basis = np.stack([right, np.cross(towards, right), towards])  # rows: image right, image up, nearness
    p_view = apply(T_rest_part, solid.vertices) @ basis.T
    low = p_view[:, :2].min(axis=0) - 3 * _PIXEL_M
    size = np.ceil((p_view[:, :2].max(axis=0) - low) / _PIXEL_M).astype(int) + 4
    uv = (p_view[:, :2] - low) / _PIXEL_M
    nearness, _ = rasterise(uv, p_view[:, 2], solid.faces[facing > 0], int(size[0]), int(size[1]))

    q = points @ basis.T
    aside = outward @ basis[:2].T
    norm = np.linalg.norm(aside, axis=1, keepdims=True)
    q_px = (q[:, :2] - low) / _PIXEL_M + np.where(norm > 0.05, aside / np.maximum(norm, 1e-9), 0.0)
    col, row = np.round(q_px).astype(int).T
    return nearness[row, col] > q[:, 2] + _LIFT_M
