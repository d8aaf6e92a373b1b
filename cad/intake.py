"""Takes in a part's file as it comes: unit, size, repair, union. The result is one watertight mesh in metres."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from cad.meshes import MeshError, check_mesh
from cad.soup import Soup
from cad.sources import CAD_SUFFIXES, read_bytes, read_triangles
from cad.step import declared_unit, read_step
from cad.surface import RepairConfig, outer_surface

METRES_PER_UNIT = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "um": 1e-6, "in": 25.4e-3, "ft": 304.8e-3}
"""The units of length that files come in."""


@dataclass(frozen=True, kw_only=True)
class IntakeConfig:
    """What is taken in without a question, and how closely.

    ``size_mm``: range of the largest side of the bounding box that a part may have without ``accept_size``. The Hand-E
    opens 50 mm, so nothing longer can be taken at any angle, and 1 mm is a few tens of pixels in the picture, too few
    for a pose. A part under 25 mm falls outside when its inches or metres are taken for millimetres, and one over 2 mm
    when its millimetres are taken for inches.

    ``time_limit_s`` is for the CAD kernel.
    """

    size_mm: tuple[float, float] = (1.0, 50.0)
    time_limit_s: float = 120.0
    repair: RepairConfig = field(default_factory=RepairConfig)

    def __post_init__(self) -> None:
        low, high = self.size_mm
        if not 0 < low < high:
            raise ValueError(f"size_mm {self.size_mm}: two sizes in mm, the smaller first")
        if not self.time_limit_s > 0:
            raise ValueError(f"time_limit_s {self.time_limit_s}: it must be positive")


@dataclass(frozen=True, kw_only=True)
class Intake:
    """A part as it was taken in.

    ``mesh`` is the outer surface of the union of all solids, watertight, in metres; ``solids`` is how many closed
    shells the file holds; ``unit`` is what the file's numbers are in and ``unit_source`` how that is known;
    ``size_mm`` (3,) is the bounding box; ``origin_m`` (3,) is where the mesh's origin lies in the file's frame (zero
    unless the part lies far from the file's origin), the axes being the file's; ``notes`` say, for a person to read,
    what was changed and by how much.
    """

    mesh: trimesh.Trimesh
    solids: int
    unit: str
    unit_source: str
    size_mm: tuple[float, float, float]
    origin_m: tuple[float, float, float]
    notes: tuple[str, ...]


def read_part(
    path: Path, *, unit: str | None = None, accept_size: bool = False, config: IntakeConfig | None = None
) -> Intake:
    """Take in a STEP, STL, OBJ, PLY or OFF file.

    ``unit`` is what the file's numbers are in: STEP files say it themselves (``unit`` overrules them), meshes are
    taken for millimetres. Nothing is written. Raises MeshError, in one line with the remedy, for a file that cannot be
    read, a surface that bounds no volume, and a size that is implausible unless ``accept_size``.
    """
    config = config or IntakeConfig()
    if unit is not None and unit not in METRES_PER_UNIT:
        raise MeshError(f"unit {unit!r} is unknown; use one of {', '.join(METRES_PER_UNIT)}")
    data, name = read_bytes(path), str(path)
    if path.suffix.lower() in CAD_SUFFIXES:
        declared = declared_unit(data)
        scale, unit, source = _step_scale(name, declared, unit)
        soups = read_step(data, name, time_limit_s=config.time_limit_s)
    else:
        soups = read_triangles(data, path.suffix, name)
        source = "as asked" if unit else "mesh files name no unit; millimetres are the custom"
        unit = unit or "mm"
        scale = METRES_PER_UNIT[unit]
    soups = [Soup(vertices=scale * soup.vertices, faces=soup.faces) for soup in soups]
    _check_size(name, soups, unit, accept_size, config)
    mesh, solids, notes = outer_surface(soups, name, config.repair)
    origin = _recentre(mesh, notes)
    check_mesh(mesh, name)
    x, y, z = (round(1e3 * float(side), 6) for side in mesh.extents)
    return Intake(
        mesh=mesh,
        solids=solids,
        unit=unit,
        unit_source=source,
        size_mm=(x, y, z),
        origin_m=origin,
        notes=tuple(notes),
    )


def _step_scale(name: str, declared: str | None, unit: str | None) -> tuple[float, str, str]:
    """What the metres read from a STEP file are multiplied by, the unit, and how it is known."""
    if unit is None:
        return 1.0, declared or "mixed", "the file says so" if declared else "the file names its units"
    if declared is None:
        raise MeshError(f"{name} names several or unusual units of its own; leave --unit away")
    return METRES_PER_UNIT[unit] / METRES_PER_UNIT[declared], unit, f"as asked (the file says {declared})"


def _recentre(mesh: trimesh.Trimesh, notes: list[str]) -> tuple[float, float, float]:
    """Move a mesh that lies farther from its origin than it is long to the middle of its bounding box."""
    centre = np.asarray(mesh.bounds).mean(axis=0)
    if np.linalg.norm(centre) <= mesh.extents.max():
        return 0.0, 0.0, 0.0
    mesh.apply_translation(-centre)
    x, y, z = (float(value) for value in centre)
    notes.append(
        f"the part lies {1e3 * np.linalg.norm(centre):.3g} mm from the file's origin; its own origin is the middle of "
        "its bounding box instead"
    )
    return x, y, z


def _check_size(name: str, soups: list[Soup], unit: str, accept: bool, config: IntakeConfig) -> None:
    corners = np.concatenate([soup.vertices[np.unique(soup.faces)] for soup in soups])
    if not np.isfinite(corners).all():
        raise MeshError(f"{name} has vertices that are not finite; export the part again")
    size = 1e3 * float(np.ptp(corners, axis=0).max())
    low, high = config.size_mm
    if accept or low <= size <= high:
        return
    others = {other: size * factor / METRES_PER_UNIT.get(unit, 1e-3) for other, factor in METRES_PER_UNIT.items()}
    listed = ", ".join(f"{_mm(value)} if they are {key}" for key, value in others.items() if key not in (unit, "ft"))
    fitting = [other for other, value in others.items() if low <= value <= high and other != unit]
    hint = f"--unit {'|'.join(fitting or METRES_PER_UNIT)}"
    raise MeshError(
        f"{name} is {_mm(size)} long if its numbers are {unit}, but this cell picks parts of {low:g} to {high:g} mm; "
        f"which unit is it ({listed})? Answer with {hint}, or with --accept-size if {_mm(size)} is right"
    )


def _mm(value: float) -> str:
    return f"{value:,.0f} mm" if value >= 1000 else f"{value:.3g} mm"
