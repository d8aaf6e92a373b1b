"""What a part's geometry is worth: python -m benchmarks.geometry [--parts NAME_OR_FILE ...].

Symmetries found and how far they move the surface; collision shapes and what they have beyond the part and lack; and
how drops end on one convex hull and on the pieces for rest and for a grasp. Parts are names, or STEP, STL, OBJ or PLY
files.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro

from benchmarks.tables import Section, show
from cad.collision import CollisionReport, contact_pieces, find_collision_shapes, read_collision
from cad.equivalence import Symmetries
from cad.intake import read_part
from cad.parts import BUILT_IN, Part, load_part
from cad.shape_error import union_of_hulls
from cad.solids import to_mesh
from cad.symmetry import deviation_m, find_symmetries
from scenes.drops import DropsConfig, drop_part

STEEL_KG_M3 = 7850.0


@dataclass(frozen=True, kw_only=True)
class GeometryBenchmark:
    """Options of the benchmark."""

    parts: tuple[str, ...] = BUILT_IN
    """Names of parts, or files; a file's numbers are in --unit."""
    parts_dir: Path | None = None
    """Folder of your own parts."""
    unit: str | None = None
    """Unit of files: m, cm, mm or in."""
    drops: int = 200
    """Drops on the hull and on each kind of pieces; 0 leaves them out."""
    seed: int = 0
    json: bool = False
    """Print JSON instead of tables."""


def main(options: GeometryBenchmark) -> None:
    """Measure and print."""
    symmetries: list[tuple[str, ...]] = []
    shapes: list[tuple[str, ...]] = []
    rests: list[tuple[str, ...]] = []
    for name in options.parts:
        part, pieces, report = _subject(name, options)
        symmetries += [_symmetry_row(part.name, part.mesh), _symmetry_row(f"{part.name}, hull", part.mesh.convex_hull)]
        shapes.append(_shape_row(part.name, report))
        if options.drops:
            hull = to_mesh(union_of_hulls([part.mesh]))
            kinds = (("hull", (hull,)), ("rest", contact_pieces(part, "rest")), ("grasp", pieces))
            rests += [_rest_row(part, kind, shape, hull, options) for kind, shape in kinds]
    sections = [
        Section(
            title="Rotational symmetries",
            columns=("part", "triangles", "elements", "axes", "tolerance um", "deviation um", "CPU s"),
            rows=symmetries,
        ),
        Section(
            title="Collision shapes (excess and missing: largest, 99th percentile, volume)",
            columns=(
                "part",
                "method",
                "pieces",
                "excess um",
                "p99",
                "mm3",
                "missing um",
                "p99 ",
                "mm3 ",
                "hull um",
                "limit",
                "CPU s",
            ),
            rows=shapes,
        ),
        Section(
            title="Drops on one hull and on pieces (tilt from the nearest face of the hull; 5th and 95th percentile)",
            columns=("part", "shape", "still %", "tilt deg", "lowest corner um", "CPU s"),
            rows=rests,
        ),
    ]
    show(sections if options.drops else sections[:2], f"seed {options.seed}", as_json=options.json)


def _subject(name: str, options: GeometryBenchmark) -> tuple[Part, tuple[trimesh.Trimesh, ...], CollisionReport]:
    """A part, its convex pieces and the report on them: stored ones for a name, made ones for a file."""
    if not Path(name).is_file():
        part = load_part(name, options.parts_dir)
        stored = read_collision(part.folder)
        found = stored or find_collision_shapes(part.mesh)
        return part, contact_pieces(part, "grasp"), found.report
    mesh = read_part(Path(name), unit=options.unit).mesh
    made = find_collision_shapes(mesh)
    part = Part(
        name=Path(name).stem,
        obj_id=1,
        folder=Path(name).parent,
        mass_kg=STEEL_KG_M3 * float(mesh.volume),
        material="steel",
        rgba=(0.7, 0.7, 0.7, 1.0),
        metallic=1.0,
        roughness=0.3,
        mesh=mesh,
        symmetries=Symmetries(),
        stable_poses=(),
        keypoints=np.zeros((8, 3)),
        mesh_hash="",
    )
    return part, made.pieces, made.report


def _symmetry_row(name: str, mesh: trimesh.Trimesh) -> tuple[str, ...]:
    start = time.process_time()
    found = find_symmetries(mesh)
    seconds = time.process_time() - start
    return (
        name,
        str(len(mesh.faces)),
        str(len(found.elements)),
        str(len(found.continuous)),
        f"{1e6 * found.tolerance_m:.1f}",
        f"{1e6 * deviation_m(mesh, found):.2f}",
        f"{seconds:.2f}",
    )


def _shape_row(name: str, report: CollisionReport) -> tuple[str, ...]:
    method = report.method if report.threshold is None else f"{report.method} {report.threshold:g}"
    return (
        name,
        method,
        str(report.pieces),
        f"{report.excess_max_um:.1f}",
        f"{report.excess_p99_um:.1f}",
        f"{report.excess_mm3:.3f}",
        f"{report.missing_max_um:.1f}",
        f"{report.missing_p99_um:.1f}",
        f"{report.missing_mm3:.3f}",
        f"{report.hull_um:.2f}",
        report.limit or "",
        f"{report.cpu_seconds:.1f}",
    )


def _rest_row(
    part: Part,
    kind: str,
    pieces: tuple[trimesh.Trimesh, ...],
    hull: trimesh.Trimesh,
    options: GeometryBenchmark,
) -> tuple[str, ...]:
    start = time.process_time()
    drops = drop_part(part, pieces, DropsConfig(drops=options.drops, seed=options.seed, threads=1))
    seconds = time.process_time() - start
    up = drops.R_table_part[drops.still][:, 2]
    if not len(up):
        return part.name, kind, "0", "", "", f"{seconds:.1f}"
    tilt = np.degrees(np.arccos(np.clip((-up @ np.asarray(hull.face_normals).T).max(axis=1), -1, 1)))
    lowest = 1e6 * ((up @ np.asarray(hull.vertices).T).min(axis=1) + drops.height_m[drops.still])
    return (
        part.name,
        kind,
        f"{100 * drops.still.mean():.1f}",
        " to ".join(f"{v:.4f}" for v in np.percentile(tilt, (5, 95))),
        " to ".join(f"{v:.2f}" for v in np.percentile(lowest, (5, 95))),
        f"{seconds:.1f}",
    )


if __name__ == "__main__":
    main(tyro.cli(GeometryBenchmark))
