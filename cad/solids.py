"""Closed shells of triangles as solids: their union, and what lies inside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from manifold3d import Error, Manifold, Mesh64, OpType

from cad.meshes import MeshError
from cad.soup import Soup


def bounds_solid(shell: Soup) -> bool:
    """Whether a shell bounds a solid."""
    return _solid(shell).status() == Error.NoError


def to_solid(shell: Soup) -> Manifold:
    """The solid that a closed, consistently wound shell bounds, whichever way its normals point."""
    solid = _solid(shell if shell.volume > 0 else shell.flipped())
    if solid.status() != Error.NoError:
        raise MeshError(f"a shell of {len(shell.faces)} triangles bounds no solid ({solid.status().name})")
    return solid


def outer_union(solids: Sequence[Manifold]) -> tuple[Manifold, float]:
    """Union of solids with its enclosed cavities filled, and the volume of those."""
    union = Manifold.batch_boolean(list(solids), OpType.Add) if len(solids) > 1 else solids[0]
    pieces = union.decompose()
    outer = [piece for piece in pieces if piece.volume() > 0]
    filled = float(-sum(piece.volume() for piece in pieces if piece.volume() < 0))
    if len(outer) == len(pieces):
        return union, 0.0
    return Manifold.batch_boolean(outer, OpType.Add), filled


def to_mesh(solid: Manifold) -> trimesh.Trimesh:
    """The surface of a solid."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64), process=False
    )


def _solid(shell: Soup) -> Manifold:
    return Manifold(
        Mesh64(
            vert_properties=np.ascontiguousarray(shell.vertices, dtype=np.float64),
            tri_verts=np.ascontiguousarray(shell.faces, dtype=np.uint64),
        )
    )
