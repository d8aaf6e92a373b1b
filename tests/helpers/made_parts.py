"""Parts that no folder describes."""

from pathlib import Path

import numpy as np
import trimesh

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose


def part_of(
    mesh: trimesh.Trimesh, rotations, symmetries: Symmetries | None = None, name: str = "block", obj_id: int = 1
) -> Part:
    """A part at rest on the plane in each of the given orientations, its footprint centred on the origin."""
    poses = []
    for i, R in enumerate(rotations):
        v = mesh.vertices @ np.asarray(R).T
        t = -(v.min(axis=0) + v.max(axis=0)) / 2
        t[2] = -v[:, 2].min()
        poses.append(StablePose(index=i, R_table_part=R, t_table_part=t, probability=1 / len(rotations), view_class=i))
    return Part(
        name=name,
        obj_id=obj_id,
        folder=Path(),
        mass_kg=1e-4,
        material="steel",
        rgba=(1.0, 1.0, 1.0, 1.0),
        metallic=0.0,
        roughness=1.0,
        mesh=mesh,
        symmetries=symmetries or Symmetries(),
        stable_poses=tuple(poses),
        keypoints=np.asarray(mesh.vertices[:8]),
        mesh_hash="",
    )
