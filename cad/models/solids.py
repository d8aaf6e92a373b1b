"""Solids with a finish, their building blocks, and how they are written as meshes, index and STEP.

Solids are made in millimetres in the frame of the body they belong to; meshes are binary STL in metres.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from build123d import (  # pyright: ignore[reportMissingImports]
    Axis,
    Box,
    Color,
    Compound,
    Cylinder,
    GeomType,
    Pos,
    Shape,
    Solid,
    export_step,
    fillet,
)
from trimesh.exchange.stl import export_stl

from cad.meshes import mesh_from_triangles

MESH_INDEX, STEP_FILE = "meshes.json", "cell.step"
STEP_DATE = "2025-01-01T00:00:00"
"""Fixed, so that building again leaves the header alone (the meshes come out byte for byte the same)."""
DEFLECTION_MM, ANGULAR_DEFLECTION_RAD = 0.3, 0.3


@dataclass(frozen=True, kw_only=True)
class Finish:
    """How a surface looks: colour, and the metallic and roughness values of a physically based renderer."""

    rgba: tuple[float, float, float, float]
    metallic: float
    roughness: float


@dataclass(frozen=True, kw_only=True)
class Piece:
    """One solid of one finish, in millimetres in the frame of ``body``; ``name`` becomes the file's name."""

    name: str
    body: str
    shape: Shape
    finish: Finish


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], rounding: float = 0.0) -> Solid:
    """Box between the given limits in mm, its edges along z rounded."""
    limits = (x, y, z)
    solid = Box(*(high - low for low, high in limits))
    if rounding > 0:
        solid = fillet(solid.edges().filter_by(Axis.Z), rounding)
    return Pos(*((low + high) / 2 for low, high in limits)) * solid


def barrel(radius: float, low: float, high: float, *, round_low: float = 0.0, round_high: float = 0.0) -> Solid:
    """Cylinder about z between two heights in mm, its rims rounded."""
    solid = Pos(0, 0, (low + high) / 2) * Cylinder(radius, high - low)
    for rounding, index in ((round_low, 0), (round_high, -1)):
        if rounding > 0:
            rim = solid.edges().filter_by(GeomType.CIRCLE).sort_by(Axis.Z)[index]
            solid = fillet(rim, rounding)
    return solid


def fuse(shapes: Iterable[Shape]) -> Shape:
    """Union of solids that overlap."""
    first, *others = shapes
    for other in others:
        first = first + other
    return first


def write_stl(path: Path, shape: Shape) -> int:
    """Write ``shape`` (mm) as a binary STL in metres; returns the number of triangles."""
    vertices, triangles = shape.tessellate(DEFLECTION_MM, ANGULAR_DEFLECTION_RAD)
    mesh = mesh_from_triangles(np.array([tuple(v) for v in vertices]) * 1e-3, triangles)
    path.write_bytes(export_stl(mesh))
    return len(mesh.faces)


def write_pieces(pieces: Sequence[Piece], markers: Sequence[Piece], folder: Path) -> int:
    """Write meshes, index and STEP file into ``folder``, replacing what was there; returns the number of triangles.

    ``pieces`` belong to bodies of the cell; ``markers`` are drawn wherever a scene puts them (a nest's outline).
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.stl"):
        old.unlink()
    triangles = sum(write_stl(folder / f"{piece.name}.stl", piece.shape) for piece in [*pieces, *markers])
    index = {"meshes": [_entry(piece) for piece in pieces], "markers": {m.body: _entry(m) for m in markers}}
    (folder / MESH_INDEX).write_text(json.dumps(index, indent=1) + "\n")
    for piece in pieces:
        piece.shape.label = piece.name
        piece.shape.color = Color(*piece.finish.rgba)
    bodies = dict.fromkeys(piece.body for piece in pieces)
    groups = [Compound(label=body, children=[p.shape for p in pieces if p.body == body]) for body in bodies]
    export_step(Compound(label="cell", children=groups), folder / STEP_FILE, write_pcurves=False, timestamp=STEP_DATE)
    return triangles


def _entry(piece: Piece) -> dict[str, object]:
    finish = piece.finish
    return {
        "file": f"{piece.name}.stl",
        "body": piece.body,
        "rgba": list(finish.rgba),
        "metallic": finish.metallic,
        "roughness": finish.roughness,
    }
