"""Triangle meshes of parts: checking, merging, sampling and writing. Metres throughout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from cad.parts import CadError
from cad.spatial import Array

DEFLECTION_MM = 0.002
"""Largest distance in mm between a curved CAD surface and its triangles."""
ANGULAR_DEFLECTION_RAD = 0.12
_MERGE_DIGITS = 9  # vertices that agree to a nanometre are one


class MeshError(CadError):
    """A mesh that cannot be read or does not bound a solid."""


def mesh_from_triangles(vertices_m: ArrayLike, triangles: ArrayLike, name: str = "mesh") -> trimesh.Trimesh:
    """A checked mesh of one solid from vertices (V, 3) in metres and triangles (F, 3), equal vertices merged.

    Raises MeshError as ``check_mesh`` does.
    """
    rounded = np.round(np.asarray(vertices_m, dtype=np.float64).reshape(-1, 3), _MERGE_DIGITS) + 0.0  # no -0.0
    vertices, index = np.unique(rounded, axis=0, return_inverse=True)
    faces = index.reshape(-1)[np.asarray(triangles, dtype=np.int64).reshape(-1, 3)]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    mesh = trimesh.Trimesh(vertices, faces[distinct], process=False)
    check_mesh(mesh, name)
    return mesh


def check_mesh(mesh: trimesh.Trimesh, name: str = "mesh") -> None:
    """Raise MeshError, saying what is wrong, unless the mesh is closed, consistently wound and of positive volume."""
    if not len(mesh.faces):
        raise MeshError(f"{name} has no triangles; export the part again")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(f"{name} has vertices that are not finite; export the part again")
    if not mesh.is_watertight:
        raise MeshError(f"{name} is not watertight (an edge does not join two triangles); close it in the CAD program")
    if not mesh.is_winding_consistent:
        raise MeshError(f"{name} has triangles wound both ways; make its normals consistent")
    if mesh.volume <= 0:
        raise MeshError(f"{name} has volume {mesh.volume:.3g} m3; turn its normals outwards")


def write_mesh(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write a binary PLY with vertices and triangles only; the same mesh gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    data = plain.export(file_type="ply", vertex_normal=False)
    assert isinstance(data, bytes)
    path.write_bytes(data)


def surface_samples(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """``count`` points uniformly on the surface and the outward normals there, both (count, 3)."""
    index = rng.choice(len(mesh.faces), size=count, p=mesh.area_faces / mesh.area)
    u, v = rng.random((2, count, 1))
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    a, b, c = np.moveaxis(mesh.triangles[index], 1, 0)
    return a + u * (b - a) + v * (c - a), np.asarray(mesh.face_normals)[index]
