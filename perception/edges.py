"""Edges of a part that show in an image, from its CAD: sampled, occluded ones left out, with what lies beside them.

An outline is where the part ends and the background begins. Inner edges are where depth steps by more than 0.1 mm, or
the surface turns by more than 20 degrees, from one side to the other (the chords of a rounded bend turn by less and
show no edge); they count for less, since their contrast is uncertain. Both sides are compared a pixel away from the
edge, so that relief too fine to be seen is left out. Samples are in frame ``rest``: the table frame of the part at
x = y = yaw = 0, that is ``T_table_part`` applied.
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
INNER_WEIGHT = 0.35

PATCH_OFFSETS_M: Array = np.linspace(-4.32e-4, 4.32e-4, 48, dtype=np.float64)
"""Distances from an edge, along its normal, at which ``EdgeSamples.patches`` says what is seen. Their number is even:
the edge itself lies half-way between two of them."""
MAX_PATCHES = 6

_PIXEL_M = 4e-5  # of the map that samples are compared with
_DIRECTION_STEP = 0.004  # rad; directions to the camera are rounded to this: 3 mm of height move by 6 um at most
_DISTANCE_STEP_M = 0.02  # and distances to this
_GRAZING = 0.02  # sine of the angle under which a face counts as seen edge-on
_LIFT_M = 5e-5  # a sample is hidden when something lies nearer than this in front of it
_BESIDE_M = 8e-5  # where the two sides of an edge are compared: a little over a pixel of the camera
_STEP_M = 1e-4  # a smaller step in depth is a relief that does not show
_MARGIN = 12  # pixels of background kept round the part
_SKEW = 0.47  # rad; edges of a part at rest run along its axes, and so cross the map's rows and columns at all phases


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeSamples:
    """Points on visible edges, in frame ``rest``.

    ``points`` (N, 3) m, ``tangents`` (N, 3) unit, ``weights`` (N,) 1 on outlines and less on inner edges, ``outline``
    (N,) bool. ``patches`` (N, T) numbers the pieces of surface or background seen along the normal at
    ``PATCH_OFFSETS_M``, from 0 to MAX_PATCHES - 1; the normal is tangent x direction to the eye, and the
    offsets are on the plane across the line of sight through the origin of ``rest``.
    """

    points: Array
    tangents: Array
    weights: Array
    outline: NDArray[np.bool_]
    patches: NDArray[np.uint8]

    def every(self, stride: int) -> EdgeSamples:
        """One sample in ``stride``."""
        return EdgeSamples(
            points=self.points[::stride],
            tangents=self.tangents[::stride],
            weights=self.weights[::stride],
            outline=self.outline[::stride],
            patches=self.patches[::stride],
        )


def visible_edges(part: Part, stable_pose: int, eye: Array) -> EdgeSamples:
    """Edges of a part at rest seen by a camera at ``eye`` (3,), metres in frame ``rest``.

    The eye's direction and distance are rounded a little, and sets are kept for what they round to. Raises IndexError
    for a stable pose the part does not have and ValueError for a camera that is not above the table.
    """
    if not 0 <= stable_pose < len(part.stable_poses):
        raise IndexError(f"part {part.name!r} has {len(part.stable_poses)} stable poses; {stable_pose} is not one")
    if eye[2] <= 0:
        raise ValueError(f"an eye at {np.round(eye, 3)} m is below the table; the camera must be above it")
    slope = np.round(np.asarray(eye[:2]) / eye[2] / _DIRECTION_STEP).astype(int)
    distance = max(1, round(float(np.linalg.norm(eye)) / _DISTANCE_STEP_M))
    return _edges_from(part, stable_pose, int(slope[0]), int(slope[1]), distance)


@lru_cache(maxsize=1024)
def _edges_from(part: Part, stable_pose: int, slope_x: int, slope_y: int, distance: int) -> EdgeSamples:
    towards = np.array([slope_x * _DIRECTION_STEP, slope_y * _DIRECTION_STEP, 1.0])
    towards /= np.linalg.norm(towards)
    eye = towards * distance * _DISTANCE_STEP_M
    solid, T_rest_part = solid_of(part), part.stable_poses[stable_pose].T_table_part
    vertices, normals = apply(T_rest_part, solid.vertices), solid.normals @ T_rest_part[:3, :3].T
    sight = eye - vertices[solid.faces[:, 0]]
    facing = (normals * sight).sum(axis=1) / np.linalg.norm(sight, axis=1)  # (F,) cosine between normal and sight
    a, b = facing[solid.edge_faces].T
    limb = np.minimum(a, b) * np.maximum(a, b) < 0
    crease = (np.minimum(a, b) > _GRAZING) & (solid.edge_angle > CREASE_ANGLE)
    chosen = np.flatnonzero(limb | crease)

    edge, points, tangents = _sample(apply(T_rest_part, solid.edge_ends[chosen]))
    outward = normals[solid.edge_faces[chosen[edge]]].sum(axis=1)
    view = _ViewMap.of(solid, vertices, normals, facing, eye)
    seen = ~view.hidden(points, outward)
    points, tangents = points[seen], tangents[seen]
    outline, inner = view.sides(points, tangents)
    drawn = outline | inner
    points, tangents, outline = points[drawn], tangents[drawn], outline[drawn]
    return EdgeSamples(
        points=points,
        tangents=tangents,
        weights=np.where(outline, OUTLINE_WEIGHT, INNER_WEIGHT),
        outline=outline,
        patches=view.patches(points, tangents),
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _ViewMap:
    """A resting part as an eye sees it, on the plane through frame ``rest``'s origin across the line of sight.

    ``height`` (m) of the surface seen towards the eye, minus infinity off the part; ``face`` seen, -1 off the part;
    ``normals`` (F + 1, 3) and ``facets`` (F + 1,) of the faces, the last row for no face.
    """

    basis: Array  # (3, 3), rows: right, up, towards the eye
    distance: float
    low: Array
    height: Array
    face: NDArray[np.int64]
    normals: Array
    facets: NDArray[np.int32]

    @staticmethod
    def of(solid: Solid, vertices: Array, normals: Array, facing: Array, eye: Array) -> _ViewMap:
        distance = float(np.linalg.norm(eye))
        towards = eye / distance
        right = np.cross([-np.sin(_SKEW), np.cos(_SKEW), 0.0], towards)
        right /= np.linalg.norm(right)
        basis = np.stack([right, np.cross(towards, right), towards])
        p_view = vertices @ basis.T
        on_plane = p_view[:, :2] * (distance / (distance - p_view[:, 2:]))
        low = on_plane.min(axis=0) - _MARGIN * _PIXEL_M
        size = np.ceil((on_plane.max(axis=0) - low) / _PIXEL_M).astype(int) + _MARGIN + 1
        front = np.flatnonzero(facing > 0)
        nearness = 1.0 / (distance - p_view[:, 2])
        seen, face = rasterise((on_plane - low) / _PIXEL_M, nearness, solid.faces[front], int(size[0]), int(size[1]))
        with np.errstate(divide="ignore"):
            height = distance - 1.0 / np.maximum(seen, 0.0)  # minus infinity where nothing is seen
        return _ViewMap(
            basis=basis,
            distance=distance,
            low=low,
            height=height,
            face=np.where(face >= 0, front[face], -1),
            normals=np.concatenate([normals, np.zeros((1, 3))]),
            facets=np.append(solid.facet, np.int32(-1)),
        )

    def _seen_at(self, points: Array) -> tuple[Array, Array]:
        """Where points (N, 3) appear on the plane (N, 2), and their heights towards the eye (N,)."""
        q = points @ self.basis.T
        return q[:, :2] * (self.distance / (self.distance - q[:, 2:])), q[:, 2]

    def _cell(self, q: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of places (..., 2) m on the plane, those outside moved to the border."""
        cell = np.round((q - self.low) / _PIXEL_M).astype(int)
        height, width = self.face.shape
        return np.clip(cell[..., 1], 0, height - 1), np.clip(cell[..., 0], 0, width - 1)

    def hidden(self, points: Array, outward: Array) -> NDArray[np.bool_]:
        """Which points (N, 3) have part of the surface in front of them.

        A point is moved a pixel along ``outward`` (N, 3), away from the faces it joins, before depths are compared.
        """
        place, height = self._seen_at(points)
        aside = outward @ self.basis[:2].T
        norm = np.linalg.norm(aside, axis=1, keepdims=True)
        moved = place + np.where(norm > 0.05, aside / np.maximum(norm, 1e-9), 0.0) * _PIXEL_M
        return self.height[self._cell(moved)] > height + _LIFT_M

    def _normals(self, points: Array, tangents: Array) -> Array:
        """Unit normals (N, 2) of edges on the plane: tangent x direction to the eye."""
        along = self._seen_at(points + 1e-6 * tangents)[0] - self._seen_at(points)[0]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        return np.stack([along[:, 1], -along[:, 0]], axis=1) / np.maximum(length, 1e-12)

    def sides(self, points: Array, tangents: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which edge samples lie between part and background, and which show inside of the part.

        The latter are where depth steps, or the normal turns, from one side of the edge to the other.
        """
        place, aside = self._seen_at(points)[0], self._normals(points, tangents) * _BESIDE_M
        left, right = self._cell(place + aside), self._cell(place - aside)
        on_left, on_right = np.isfinite(self.height[left]), np.isfinite(self.height[right])
        both = on_left & on_right
        step = np.abs(np.where(both, self.height[left], 0.0) - np.where(both, self.height[right], 0.0)) > _STEP_M
        cosine = (self.normals[self.face[left]] * self.normals[self.face[right]]).sum(axis=1)
        return on_left ^ on_right, both & (step | (cosine < np.cos(CREASE_ANGLE)))

    def patches(self, points: Array, tangents: Array) -> NDArray[np.uint8]:
        """What is seen beside each sample, (N, T); where there are too many patches the outer ones are merged."""
        place, aside = self._seen_at(points)[0], self._normals(points, tangents)
        label = self.facets[self.face[self._cell(place[:, None] + PATCH_OFFSETS_M[:, None] * aside[:, None])]]
        change = np.zeros(label.shape, dtype=np.int64)
        change[:, 1:] = label[:, 1:] != label[:, :-1]
        number = np.cumsum(change, axis=1)
        middle = number[:, len(PATCH_OFFSETS_M) // 2, None]
        return np.clip(number - middle + MAX_PATCHES // 2, 0, MAX_PATCHES - 1).astype(np.uint8)
