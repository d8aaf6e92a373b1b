"""A part and its folder: everything the other packages know about a part is read here.

A folder holds ``part.json``, ``source.*``, ``mesh.ply`` (watertight, metres), ``hulls/*.ply`` (convex pieces) and
``collision.json`` (their errors), ``symmetries.json`` (BOP ``models_info`` form, millimetres), ``stable_poses.json``,
``keypoints.json``, ``grasps.json`` and ``preview.png``. Built-in parts live in ``cad/library``; a user's own in the
folder that ``parts_dir`` or the environment variable ``TAGCELL_PARTS_DIR`` names, else in the user's data directory.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cad.equivalence import Axis, Symmetries, axis_from_json, symmetries_from_json
from cad.spatial import Array, diameter, rotation_z, transform

LIBRARY = Path(__file__).parent / "library"
BUILT_IN = ("inserted", "main", "top")
"""Parts that come with Tagcell, in the order of their obj_id."""
PARTS_DIR_VARIABLE = "TAGCELL_PARTS_DIR"


class CadError(Exception):
    """Root of the errors that ``cad`` raises."""


class PartError(CadError):
    """A part that does not exist or whose folder is incomplete or inconsistent."""


@dataclass(frozen=True, kw_only=True)
class ViewEquivalent:
    """A placement of the same part that looks the same from straight above.

    It lies in ``stable_pose`` with its yaw larger by ``yaw`` rad and its footprint's centre shifted by ``shift_m``
    (2,), given in the table frame of the original at yaw 0.
    """

    stable_pose: int
    yaw: float
    shift_m: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class StablePose:
    """One way a part comes to rest on a plane.

    ``R_table_part`` (3, 3) is the canonical orientation (yaw 0, table +z up), ``t_table_part`` (3,) the position of the
    part's origin when the centre of its bounding rectangle seen from above is at the table frame's origin, so that a
    part at rest is ``T_board_part = planar(x, y, yaw) @ T_table_part``. A part whose hull is round about a level axis
    rests at any turn about it: ``roll`` is that axis in the part's frame, and this one pose stands for all of them.
    ``view_equivalents`` are other placements that look like it at yaw 0; None while they have not been computed.
    """

    index: int
    R_table_part: Array
    t_table_part: Array
    probability: float
    view_class: int
    roll: Axis | None = None
    view_equivalents: tuple[ViewEquivalent, ...] | None = None

    @property
    def T_table_part(self) -> Array:
        """(4, 4) canonical resting transform."""
        return transform(self.R_table_part, self.t_table_part)

    @property
    def height_m(self) -> float:
        """Height of the part's origin above the table."""
        return float(self.t_table_part[2])


def planar(x: float, y: float, yaw: float) -> Array:
    """(4, 4) transform of a motion in the table plane: rotate by ``yaw`` rad about z, then shift by (x, y) metres."""
    return transform(rotation_z(yaw), [x, y, 0.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A part as its folder describes it. Lengths in metres, mass in kilograms, frame ``part``."""

    name: str
    obj_id: int
    folder: Path
    mass_kg: float
    material: str
    rgba: tuple[float, float, float, float]
    metallic: float
    roughness: float
    mesh: trimesh.Trimesh
    symmetries: Symmetries
    stable_poses: tuple[StablePose, ...]
    keypoints: Array  # (K, 3), K = 8 by farthest-point sampling
    mesh_hash: str
    sources: tuple[str, ...] = ()
    info: dict[str, Any] = field(default_factory=dict)

    def rest_symmetries(self, stable_pose: int) -> Symmetries:
        """What leaves the part at rest in one of its stable poses: its symmetries and the roll of that pose."""
        roll = self.stable_poses[stable_pose].roll
        return self.symmetries if roll is None else self.symmetries.with_axis(roll)

    @cached_property
    def hulls(self) -> tuple[trimesh.Trimesh, ...]:
        """Convex pieces for contact, in frame ``part``."""
        return tuple(load_mesh(p) for p in sorted((self.folder / "hulls").glob("*.ply")))

    @cached_property
    def grasps(self) -> list[dict[str, Any]]:
        """Grasp candidates as stored in ``grasps.json`` (empty when the file is not there)."""
        path = self.folder / "grasps.json"
        return json.loads(path.read_text())["grasps"] if path.exists() else []

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance between two points of the part."""
        return diameter(self.mesh.convex_hull.vertices)

    @cached_property
    def radius_m(self) -> float:
        """Largest distance of a point of the part from the part's bounding-box centre."""
        return float(np.linalg.norm(self.mesh.vertices - self.mesh.bounds.mean(axis=0), axis=1).max())


def load_mesh(path: Path) -> trimesh.Trimesh:
    """A triangle mesh as stored, vertices not merged, from PLY, STL or OBJ."""
    mesh = trimesh.load(path, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def hash_file(path: Path) -> str:
    """First 16 hex digits of the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def own_parts_dir(parts_dir: Path | None = None) -> Path:
    """Where a user's own parts are: ``parts_dir``, else the environment variable, else the user's data directory."""
    if parts_dir is not None:
        return parts_dir
    if named := os.environ.get(PARTS_DIR_VARIABLE):
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "tagcell" / "parts"


def parts_roots(parts_dir: Path | None = None) -> list[Path]:
    """Folders searched for parts, the user's own first."""
    return [own_parts_dir(parts_dir), LIBRARY]


def part_names(parts_dir: Path | None = None) -> list[str]:
    """Names of all parts, ordered by obj_id."""
    found: dict[str, int] = {}
    for root in parts_roots(parts_dir):
        for path in root.glob("*/part.json"):
            if not path.parent.name.startswith("."):
                found.setdefault(path.parent.name, int(json.loads(path.read_text())["obj_id"]))
    return sorted(found, key=found.__getitem__)


def load_part(name: str, parts_dir: Path | None = None) -> Part:
    """Read the part called ``name``.

    Raises PartError naming the parts there are when there is none of that name, or the file that is missing.
    """
    for root in parts_roots(parts_dir):
        if (root / name / "part.json").exists():
            folder = (root / name).resolve()
            return _read_folder(folder, _stamp(folder))
    known = ", ".join(part_names(parts_dir)) or "none"
    raise PartError(f"no part is called {name!r}; parts there are: {known}")


def _stamp(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Changes whenever a file of the folder does, so that what was read before is not taken for what is there now."""
    files = sorted((entry for entry in os.scandir(folder) if entry.is_file()), key=lambda entry: entry.name)
    return tuple((entry.name, entry.stat().st_mtime_ns, entry.stat().st_size) for entry in files)


@lru_cache(maxsize=64)
def _read_folder(folder: Path, stamp: tuple[tuple[str, int, int], ...]) -> Part:
    del stamp
    info = json.loads((folder / "part.json").read_text())
    mesh_path = folder / "mesh.ply"
    if not mesh_path.exists():
        raise PartError(f"part {folder.name!r} has no mesh.ply in {folder}")
    mesh_hash = hash_file(mesh_path)
    if info["mesh_hash"] != mesh_hash:
        raise PartError(
            f"{mesh_path} has hash {mesh_hash} but part.json was made for {info['mesh_hash']}; build the part again"
        )
    return Part(
        name=info["name"],
        obj_id=int(info["obj_id"]),
        folder=folder,
        mass_kg=float(info["mass_kg"]),
        material=info["material"],
        rgba=tuple(info["rgba"]),
        metallic=float(info["metallic"]),
        roughness=float(info["roughness"]),
        mesh=load_mesh(mesh_path),
        symmetries=_read_symmetries(folder / "symmetries.json"),
        stable_poses=_read_stable_poses(folder / "stable_poses.json"),
        keypoints=np.array(json.loads((folder / "keypoints.json").read_text())["keypoints_m"]),
        mesh_hash=mesh_hash,
        sources=tuple(info.get("sources", ())),
        info=info,
    )


def _read_symmetries(path: Path) -> Symmetries:
    return symmetries_from_json(json.loads(path.read_text())) if path.exists() else Symmetries()


def _read_stable_poses(path: Path) -> tuple[StablePose, ...]:
    if not path.exists():
        return ()
    return tuple(
        StablePose(
            index=i,
            R_table_part=np.array(p["R_table_part"]),
            t_table_part=np.array(p["t_table_part_m"]),
            probability=float(p["probability"]),
            view_class=int(p.get("view_class", i)),
            roll=axis_from_json(p["roll"]) if p.get("roll") else None,
            view_equivalents=_view_equivalents(p["view_equivalents"]) if "view_equivalents" in p else None,
        )
        for i, p in enumerate(json.loads(path.read_text())["stable_poses"])
    )


def _view_equivalents(entries: list[dict[str, Any]]) -> tuple[ViewEquivalent, ...]:
    return tuple(
        ViewEquivalent(
            stable_pose=int(e["stable_pose"]),
            yaw=float(e["yaw_rad"]),
            shift_m=(float(e["shift_m"][0]), float(e["shift_m"][1])),
        )
        for e in entries
    )
