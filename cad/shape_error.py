"""How far two solids differ: volume and distance of what the one has beyond the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import Manifold, OpType

from cad.meshes import surface_samples
from cad.nearest import Surface
from cad.solids import to_mesh, to_solid
from cad.soup import Soup

_SAMPLES = 4000
_ROUNDING_M = 1e-8


@dataclass(frozen=True, kw_only=True)
class Beyond:
    """What a solid has beyond another.

    Largest distance from the other and 99th percentile over the solid's whole surface, 0 where it is not beyond, in
    metres; volume in m3.
    """

    max_m: float
    p99_m: float
    volume_m3: float


def solid_of(mesh: trimesh.Trimesh) -> Manifold:
    """The solid that a closed mesh bounds. Raises MeshError when it bounds none."""
    return to_solid(Soup(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)))


def union_of_hulls(pieces: Sequence[trimesh.Trimesh]) -> Manifold:
    """The union of the convex hulls of meshes."""
    hulls = [Manifold.hull_points(np.asarray(piece.vertices)) for piece in pieces]
    return Manifold.batch_boolean(hulls, OpType.Add)


def beyond(solid: Manifold, other: Manifold) -> Beyond:
    """What ``solid`` has beyond ``other``, in metres.

    The difference of the two has two kinds of surface: that of ``other``, at distance zero, and the part of the first
    solid's that is outside, whose corners and samples are measured.
    """
    difference = solid - other
    if difference.is_empty() or difference.volume() <= 0:
        return Beyond(max_m=0.0, p99_m=0.0, volume_m3=0.0)
    rest, whole = to_mesh(difference), to_mesh(solid)
    count = max(1, min(_SAMPLES, round(_SAMPLES * float(rest.area / whole.area))))
    samples = surface_samples(rest, count, np.random.default_rng(0))[0]
    surface = Surface(to_mesh(other))
    distances = surface.distance(samples)
    outside = distances[distances > _ROUNDING_M]
    everywhere = np.concatenate([outside, np.zeros(max(0, _SAMPLES - len(outside)))])
    return Beyond(
        max_m=max(float(distances.max()), surface.largest(np.asarray(rest.vertices))),
        p99_m=float(np.percentile(everywhere, 99)),
        volume_m3=float(difference.volume()),
    )


def hulls_apart(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> float:
    """Largest distance in metres between the convex hulls of a mesh and of all pieces together, over all directions.

    That is how wrong the height of a part on a plane can be at most.
    """
    corners = np.concatenate([np.asarray(piece.vertices) for piece in pieces])
    ours, theirs = Manifold.hull_points(np.asarray(mesh.vertices)), Manifold.hull_points(corners)
    return max(_farthest(ours, theirs), _farthest(theirs, ours))


def _farthest(hull: Manifold, other: Manifold) -> float:
    """Largest distance of a corner of a convex solid from another convex solid, 0 inside."""
    corners, faces = np.asarray(to_mesh(hull).vertices), to_mesh(other)
    heights = corners @ faces.face_normals.T - np.einsum("ij,ij->i", faces.face_normals, faces.triangles[:, 0])
    outside = corners[heights.max(axis=1) > _ROUNDING_M]
    return float(Surface(faces).distance(outside).max()) if len(outside) else 0.0
