"""Straight edges of a part's silhouette from its mesh, and where an image shows them."""

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.special import erf

from cad.spatial import Array, Intrinsics, apply

BAND_PX = 3.0
"""An edge is fitted to the pixels this near to it."""
CORNER_PX = 2.0
"""That near to an edge's ends nothing is fitted."""
SHORTEST_PX = 8.0
FINE = 16
"""Steps a pixel of the raster that tells inside from outside."""


@dataclass(frozen=True)
class Edge:
    """From ``start`` to ``end`` (2,) pixels, with the unit ``normal`` (2,) that points away from the part."""

    start: Array
    end: Array
    normal: Array

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.end - self.start))


def silhouette_edges(mesh: trimesh.Trimesh, intrinsics: Intrinsics, T_cam_part: Array) -> list[Edge]:
    """Edges of the mesh between a face that is seen and one that is not, with nothing of the part beyond them."""
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    p_cam = apply(T_cam_part, welded.vertices)
    corners = p_cam[welded.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = np.einsum("fi,fi->f", normals, corners[:, 0]) < 0
    turns = seen[welded.face_adjacency[:, 0]] != seen[welded.face_adjacency[:, 1]]
    pixels = intrinsics.project(p_cam)
    inside = _raster(pixels[welded.faces], intrinsics)
    found = (_outer_edge(*ends, inside) for ends in pixels[welded.face_adjacency_edges[turns]])
    return [edge for edge in found if edge is not None]


def edge_offset(grey: NDArray[np.floating], edge: Edge) -> float:
    """Pixels by which a blurred step fitted to an image (H, W) lies outside of an edge."""
    along = (edge.end - edge.start) / edge.length
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    from_start = np.stack([u, v], axis=-1) - edge.start
    t, s = from_start @ along, from_start @ edge.normal
    near = (t > CORNER_PX) & (t < edge.length - CORNER_PX) & (np.abs(s) < BAND_PX)
    s, levels = s[near], grey[near]
    start = [0.0, 0.5, levels[s < -1].mean(), levels[s > 1].mean()]
    fitted, _ = curve_fit(lambda s, x, w, a, b: a + (b - a) * (1 + erf((s - x) / w)) / 2, s, levels, p0=start)
    return float(fitted[0])


def _raster(triangles: Array, intrinsics: Intrinsics) -> NDArray[np.bool_]:
    image = np.zeros((intrinsics.height * FINE, intrinsics.width * FINE), np.uint8)
    for triangle in np.round((triangles + 0.5) * FINE - 0.5).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 1)
    return image > 0


def _outer_edge(start: Array, end: Array, inside: NDArray[np.bool_]) -> Edge | None:
    length = float(np.linalg.norm(end - start))
    if length < SHORTEST_PX:
        return None
    along = (end - start) / length
    normal = np.array([-along[1], along[0]])
    beside = np.arange(0.25, BAND_PX + 1, 0.25)
    t = np.arange(1.0, length - 1.0, 0.5)
    sides = []
    for sign in (1, -1):
        points = start + t[:, None, None] * along + sign * beside[None, :, None] * normal
        column, row = np.moveaxis(np.round((points + 0.5) * FINE - 0.5).astype(int), -1, 0)
        if min(column.min(), row.min()) < 0 or column.max() >= inside.shape[1] or row.max() >= inside.shape[0]:
            return None
        sides.append(inside[row, column])
    if sides[0].all() and not sides[1].any():
        return Edge(start, end, -normal)
    if sides[1].all() and not sides[0].any():
        return Edge(start, end, normal)
    return None
