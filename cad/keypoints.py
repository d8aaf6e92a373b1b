"""Keypoints on a part's surface by farthest-point sampling (as PVNet chooses them: Peng et al., CVPR 2019)."""

from __future__ import annotations

import numpy as np
import trimesh

from cad.meshes import surface_samples
from cad.spatial import Array

KEYPOINTS = 8
_CANDIDATES = 20_000


def farthest_points(points: Array, count: int, start: Array) -> Array:
    """``count`` of the points (N, 3): first the one farthest from ``start``, then each farthest from those chosen.

    Raises ValueError when there are fewer points than asked for.
    """
    if not 1 <= count <= len(points):
        raise ValueError(f"{count} keypoints asked of {len(points)} points; ask for 1 to {len(points)}")
    chosen = [int(np.argmax(np.linalg.norm(points - start, axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def surface_keypoints(mesh: trimesh.Trimesh, count: int = KEYPOINTS, seed: int = 0) -> Array:
    """(count, 3) keypoints in metres, spread over the mesh's vertices and surface, the same for the same seed."""
    samples, _ = surface_samples(mesh, _CANDIDATES, np.random.default_rng(seed))
    return farthest_points(np.concatenate([mesh.vertices, samples]), count, mesh.centroid)
