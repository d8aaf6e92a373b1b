"""Distance of points from a mesh's surface: exact for few points, bounded for many.

Meshes are taken to unit size first, because the tolerances inside trimesh are absolute.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cad.meshes import surface_samples
from cad.spatial import Array

Ints = NDArray[np.int64]

_SAMPLES = 40_000
_TRIAL = 2000
_NEIGHBOURS = 8
_EXACT, _MANY = 32, 1024  # points measured exactly at a time, first and later, those with the largest bounds first


class Surface:
    """A mesh prepared for many distance queries, all in the mesh's own unit."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        low, high = np.asarray(mesh.bounds)
        self._origin, self._scale = (low + high) / 2, float((high - low).max())
        self._mesh = trimesh.Trimesh((mesh.vertices - self._origin) / self._scale, mesh.faces, process=False)
        rng = np.random.default_rng(0)
        points, self._triangle = _cloud(self._mesh, _SAMPLES, rng)
        self._tree = cKDTree(points)
        trial = surface_samples(self._mesh, _TRIAL, rng)[0]
        self._cover = 1.5 * float(self._tree.query(trial)[0].max())

    def distance(self, points: Array) -> Array:
        """(N,) exact distance of points (N, 3) from the surface."""
        if not len(points):
            return np.empty(0)
        return self._scale * np.asarray(trimesh.proximity.closest_point(self._mesh, self._local(points))[1])

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """The surface's points nearest to points (N, 3), as far as single samples tell, and normals: (N, 3) both."""
        local = self._local(points)
        index = self._triangle[np.asarray(self._tree.query(local)[1])]
        on_surface = trimesh.triangles.closest_point(np.asarray(self._mesh.triangles)[index], local)
        return self._origin + self._scale * on_surface, np.asarray(self._mesh.face_normals)[index]

    def upper_bounds(self, points: Array, samples: int = 1) -> Array:
        """(N,) distances of points (N, 3) from the triangles of that many nearest samples: never below the exact."""
        local = self._local(points)
        index = self._triangle[self._tree.query(local, k=samples)[1]].reshape(len(points), samples)
        repeated = np.repeat(local, samples, axis=0)
        found = trimesh.triangles.closest_point(np.asarray(self._mesh.triangles)[index.ravel()], repeated)
        return self._scale * np.linalg.norm(found - repeated, axis=1).reshape(index.shape).min(axis=1)

    def all_within(self, points: Array, limit: float) -> bool:
        """Whether no point of (N, 3) is farther from the surface than ``limit``."""
        points = points[self.upper_bounds(points) > limit]
        bounds = self.upper_bounds(points, _NEIGHBOURS) if len(points) else np.empty(0)
        doubtful = np.flatnonzero(bounds > limit)
        doubtful = doubtful[np.argsort(-bounds[doubtful])]
        groups = np.split(doubtful, np.arange(_EXACT, len(doubtful), _MANY))
        return all((self.distance(points[group]) <= limit).all() for group in groups)

    def largest(self, points: Array) -> float:
        """Largest distance of points (N, 3) from the surface."""
        bounds = self.upper_bounds(points, _NEIGHBOURS)
        order = np.argsort(-bounds)
        largest, start, size = 0.0, 0, _EXACT
        while start < len(order) and bounds[order[start]] > largest:
            group = order[start : start + size]
            largest = max(largest, float(self.distance(points[group]).max()))
            start, size = start + size, min(2 * size, _MANY)
        return largest

    def surely_beyond(self, points: Array, distance: float) -> bool:
        """Whether a point of (N, 3) is farther from the surface than ``distance``; False when that is not certain."""
        nearest = self._tree.query(self._local(points))[0]
        return bool(self._scale * (nearest.max() - self._cover) > distance)

    def _local(self, points: Array) -> Array:
        return (points - self._origin) / self._scale


def _cloud(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[Array, Ints]:
    """Points over the surface, corners of all triangles included, and the triangle of each: (N, 3), (N,)."""
    index = rng.choice(len(mesh.faces), size=count, p=mesh.area_faces / mesh.area)
    weights = rng.dirichlet(np.ones(3), size=count)
    inside = np.einsum("nk,nkd->nd", weights, np.asarray(mesh.triangles)[index])
    corner, first = np.unique(np.asarray(mesh.faces).ravel(), return_index=True)
    return np.concatenate([inside, mesh.vertices[corner]]), np.concatenate([index, first // 3])
