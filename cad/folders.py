"""Writes a part's folder: all that needs no physics (``scenes`` adds the stable poses, ``twin`` the grasps)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import trimesh

from cad.collision import CollisionShapes, write_collision
from cad.keypoints import surface_keypoints
from cad.meshes import check_mesh, write_mesh
from cad.parts import hash_file
from cad.symmetry import find_symmetries, models_info


@dataclass(frozen=True, kw_only=True)
class PartFacts:
    """What a mesh does not tell about a part; ``notes`` say what was mended of its source."""

    name: str
    obj_id: int
    density_kg_m3: float
    material: str
    rgba: tuple[float, float, float, float]
    metallic: float
    roughness: float
    sources: tuple[str, ...] = ()
    source_unit: str = "mm"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"part name {self.name!r}: use letters, digits and underscores, not starting with a digit")
        if self.obj_id < 1:
            raise ValueError(f"obj_id {self.obj_id}: BOP counts objects from 1")
        if not self.density_kg_m3 > 0:
            raise ValueError(f"density {self.density_kg_m3} kg/m3: it must be positive")
        if len(self.rgba) != 4 or not all(0 <= v <= 1 for v in (*self.rgba, self.metallic, self.roughness)):
            raise ValueError(f"rgba {self.rgba}, metallic {self.metallic}, roughness {self.roughness}: all in 0 to 1")


def write_part_folder(folder: Path, mesh: trimesh.Trimesh, shapes: CollisionShapes, facts: PartFacts) -> None:
    """Write mesh.ply, hulls/, collision.json, part.json, symmetries.json and keypoints.json; lengths in metres.

    Raises MeshError for a mesh or a hull that bounds no solid. Pieces of an earlier decomposition are removed.
    """
    check_mesh(mesh, facts.name)
    for i, piece in enumerate(shapes.pieces):
        check_mesh(piece, f"hull {i} of {facts.name}")
    folder.mkdir(parents=True, exist_ok=True)
    write_mesh(mesh, folder / "mesh.ply")
    write_collision(folder, shapes)
    _write_json(folder / "symmetries.json", models_info(mesh, find_symmetries(mesh)))
    _write_json(folder / "keypoints.json", {"keypoints_m": surface_keypoints(mesh).round(9).tolist()})
    info = asdict(facts)
    info |= {
        "units": "m",
        "mass_kg": round(float(mesh.volume) * facts.density_kg_m3, 12),
        "mesh_hash": hash_file(folder / "mesh.ply"),
    }
    _write_json(folder / "part.json", info)


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
