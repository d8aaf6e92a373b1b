"""What the body of a part is made of: the mass properties of its solid, and convex pieces that touch."""

from __future__ import annotations

import numpy as np
import trimesh

from scenes.gl import mujoco


def set_mass_properties(body: mujoco.MjsBody, mesh: trimesh.Trimesh, mass_kg: float) -> None:
    """State mass, centre of mass and inertia of a homogeneous solid with a closed mesh; geoms then add nothing."""
    solid = mesh.copy()
    solid.density = mass_kg / solid.volume
    body.explicitinertial = True
    body.mass = mass_kg
    body.ipos = solid.center_mass
    body.fullinertia = solid.moment_inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def add_piece(spec: mujoco.MjSpec, name: str, piece: trimesh.Trimesh) -> None:
    """Add a convex piece as a mesh asset called ``name``."""
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.asarray(piece.vertices, np.float32).ravel()
    mesh.userface = np.asarray(piece.faces, np.int32).ravel()
