"""What a camera sees of a part, from its CAD alone: mask, depth and facet labels by a small z-buffer in numpy.

Triangles are filled scan line by scan line, all of them at once: every triangle is expanded into its rows, every row
into its pixels, and one ``maximum.at`` keeps the nearest. A pixel belongs to a triangle when its centre does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cad.parts import Part
from cad.spatial import Array, Intrinsics, apply

_NORMAL_BINS = 4.0
"""Neighbouring triangles whose normals round to the same multiples of 1/4 (about 15 degrees) form one facet, so that
flats stay whole and rounded bends fall into strips of nearly even brightness."""

_MIN_AREA_PX2 = 1e-7
_EDGE_SLACK_PX = 1e-9


@dataclass(frozen=True, kw_only=True)
class PartView:
    """A part in an image of (height, width) pixels.

    ``mask`` bool; ``depth`` float64 metres along the camera's z, infinite off the part; ``facet`` int32 label of the
    facet seen (see ``solid_of``), -1 off the part.
    """

    mask: NDArray[np.bool_]
    depth: Array
    facet: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A part's surface made ready for drawing, in frame ``part``.

    ``vertices`` (V, 3) m, ``faces`` (F, 3) into them, ``normals`` (F, 3) outward, ``facet`` (F,) label of the piece of
    surface of nearly one normal that a face belongs to; ``edge_ends`` (E, 2, 3) m, ``edge_faces`` (E, 2) and
    ``edge_angle`` (E,) rad describe every edge between two faces that are not coplanar.
    """

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array
    facet: NDArray[np.int32]
    edge_ends: Array
    edge_faces: NDArray[np.int64]
    edge_angle: Array


@lru_cache(maxsize=64)
def solid_of(part: Part) -> Solid:
    """The part's surface with merged vertices, facets and edges; computed once a part."""
    mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    pairs, angles = mesh.face_adjacency, mesh.face_adjacency_angles
    n_faces = len(mesh.faces)
    normals = np.asarray(mesh.face_normals, dtype=np.float64)
    rounded = np.round(normals * _NORMAL_BINS)
    smooth = pairs[(rounded[pairs[:, 0]] == rounded[pairs[:, 1]]).all(axis=1)]
    graph = coo_matrix((np.ones(len(smooth)), (smooth[:, 0], smooth[:, 1])), shape=(n_faces, n_faces))
    _, facet = connected_components(graph, directed=False)
    bent = angles > 1e-4
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    return Solid(
        vertices=vertices,
        faces=np.asarray(mesh.faces, dtype=np.int64),
        normals=normals,
        facet=facet.astype(np.int32),
        edge_ends=vertices[mesh.face_adjacency_edges[bent]],
        edge_faces=np.asarray(pairs[bent], dtype=np.int64),
        edge_angle=np.asarray(angles[bent], dtype=np.float64),
    )


def rasterise(
    uv: Array, nearness: Array, faces: NDArray[np.int64], width: int, height: int
) -> tuple[Array, NDArray[np.int64]]:
    """Draw triangles with a z-buffer.

    ``uv`` (V, 2) are vertex pixels, ``nearness`` (V,) any quantity that is linear in the image and grows towards the
    camera (1 / depth under perspective, minus depth without), ``faces`` (F, 3). Returns the nearness seen
    (height, width), minus infinity where there is nothing, and the index of the face seen, -1 where there is none.
    """
    corner = uv[faces]  # (F, 3, 2)
    near = nearness[faces]  # (F, 3)
    d1, d2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    keep = np.flatnonzero(np.abs(area) > _MIN_AREA_PX2)
    corner, near, d1, d2, area = corner[keep], near[keep], d1[keep], d2[keep], area[keep]
    n1, n2 = near[:, 1] - near[:, 0], near[:, 2] - near[:, 0]
    slope_u = (n1 * d2[:, 1] - n2 * d1[:, 1]) / area
    slope_v = (n2 * d1[:, 0] - n1 * d2[:, 0]) / area
    offset = near[:, 0] - slope_u * corner[:, 0, 0] - slope_v * corner[:, 0, 1]

    order = np.argsort(corner[..., 1], axis=1)
    top, mid, low = (corner[np.arange(len(corner)), order[:, i]] for i in range(3))
    row0 = np.maximum(np.ceil(top[:, 1] - _EDGE_SLACK_PX), 0).astype(np.int64)
    row1 = np.minimum(np.floor(low[:, 1] + _EDGE_SLACK_PX), height - 1).astype(np.int64)
    tri, row = _expand(row0, row1)
    t, m, b = top[tri], mid[tri], low[tri]
    along = _at_row(t, b, row)
    bent = np.where(row < m[:, 1], _at_row(t, m, row), _at_row(m, b, row))
    left, right = np.minimum(along, bent), np.maximum(along, bent)
    col0 = np.maximum(np.ceil(left - _EDGE_SLACK_PX), 0).astype(np.int64)
    col1 = np.minimum(np.floor(right + _EDGE_SLACK_PX), width - 1).astype(np.int64)
    span, col = _expand(col0, col1)
    tri, row = tri[span], row[span]

    seen = offset[tri] + slope_u[tri] * col + slope_v[tri] * row
    np.clip(seen, near.min(axis=1)[tri], near.max(axis=1)[tri], out=seen)
    pixel = row * width + col
    buffer = np.full(height * width, -np.inf)
    np.maximum.at(buffer, pixel, seen)
    won = seen == buffer[pixel]
    face = np.full(height * width, -1, dtype=np.int64)
    face[pixel[won]] = keep[tri[won]]
    return buffer.reshape(height, width), face.reshape(height, width)


def _expand(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs (i, k) with first[i] <= k <= last[i], in order of i, as two flat arrays."""
    count = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    return owner, np.arange(len(owner)) - start[owner] + first[owner]


def _at_row(a: Array, b: Array, row: NDArray[np.int64]) -> Array:
    """Column where the segments a-b (N, 2), a above b, meet their rows; the nearer end outside of them."""
    rise = b[:, 1] - a[:, 1]
    s = np.clip((row - a[:, 1]) / np.where(rise > 1e-12, rise, 1.0), 0.0, 1.0)
    return a[:, 0] + np.where(rise > 1e-12, s, 0.0) * (b[:, 0] - a[:, 0])


def render_view(part: Part, T_cam_part: Array, intrinsics: Intrinsics) -> PartView:
    """Mask, depth and facets of a part at ``T_cam_part`` (4, 4), all of it in front of the camera.

    Raises ValueError when a vertex lies behind the camera.
    """
    solid = solid_of(part)
    p_cam = apply(T_cam_part, solid.vertices)
    if p_cam[:, 2].min() <= 0:
        raise ValueError(f"part {part.name!r} reaches behind the camera (depth {p_cam[:, 2].min():.4f} m)")
    facing = _front_faces(solid, T_cam_part, p_cam)
    nearness, face = rasterise(
        intrinsics.project(p_cam), 1.0 / p_cam[:, 2], solid.faces[facing], intrinsics.width, intrinsics.height
    )
    mask = face >= 0
    depth = np.full(mask.shape, np.inf)
    depth[mask] = 1.0 / nearness[mask]
    facet = np.full(mask.shape, -1, dtype=np.int32)
    facet[mask] = solid.facet[facing[face[mask]]]
    return PartView(mask=mask, depth=depth, facet=facet)


def _front_faces(solid: Solid, T_cam_part: Array, p_cam: Array) -> NDArray[np.int64]:
    normals = solid.normals @ T_cam_part[:3, :3].T
    towards = (normals * p_cam[solid.faces[:, 0]]).sum(axis=1)
    return np.flatnonzero(towards < 0)


def silhouette_mask(
    part: Part, T_cam_part: Array, intrinsics: Intrinsics, margin_px: int = 2
) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """Mask of a part in its own tight window of the image, and the window's first pixel (u, v).

    The window stays inside the image; a part outside of it gives an empty (0, 0) mask.
    """
    uv = intrinsics.project(apply(T_cam_part, solid_of(part).vertices))
    low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - margin_px, 0)
    high = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + margin_px + 1, [intrinsics.width, intrinsics.height])
    width, height = (int(d) for d in high - low)
    if width < 1 or height < 1:
        return np.zeros((0, 0), dtype=bool), (int(low[0]), int(low[1]))
    window = intrinsics.crop(int(low[0]), int(low[1]), width, height)
    return render_view(part, T_cam_part, window).mask, (int(low[0]), int(low[1]))
