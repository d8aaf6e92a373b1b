"""Collision shapes of a part: convex pieces whose error is measured, stored with it, and chosen by purpose.

A convex part is its own hull. Any other is decomposed by CoACD, from coarse to fine, until its pieces stand out of the
part by less than a target. The pieces are then fitted to the part's convex hull: what is outside is cut off, and hull
corners that no piece reaches are given to the piece nearest by, so that the part lies on a plane as its hull does.
Errors are taken between solids: ``excess`` is what the pieces have beyond the part, ``missing`` the other way round.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from manifold3d import Manifold

from cad.decompose import DecomposeConfig, decompose
from cad.meshes import write_mesh
from cad.nearest import Surface
from cad.parts import Part, hash_file, load_mesh
from cad.rest_shape import rest_pieces
from cad.shape_error import beyond, hulls_apart, solid_of, union_of_hulls
from cad.solids import to_mesh

Purpose = Literal["rest", "grasp"]
Method = Literal["hull", "cut", "coacd"]
Limit = Literal["target", "threshold", "pieces", "time"]

FILE = "collision.json"
_CONVEX_M = _CORNER_M = 1e-6
_MOST_TO_REST_ON = 32
_NEXT_TAKES = 1.5  # times what this threshold took


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """When the decomposition is fine enough, and when it stops all the same.

    ``thresholds`` are CoACD's, relative to the part's size; they are tried one after the other. ``simplify_m`` is how
    far the surface may move that CoACD is given when the mesh has more than ``triangles``.
    """

    max_excess_m: float = 50e-6
    max_pieces: int = 48
    max_cpu_seconds: float = 25.0
    thresholds: tuple[float, ...] = (0.1, 0.05, 0.02)
    triangles: int = 2000
    simplify_m: float = 5e-6
    seed: int = 0

    def __post_init__(self) -> None:
        for key in ("max_excess_m", "max_cpu_seconds", "simplify_m"):
            if not getattr(self, key) > 0:
                raise ValueError(f"{key} {getattr(self, key)}: it must be positive")
        if self.max_pieces < 1 or self.triangles < 4:
            raise ValueError(f"max_pieces {self.max_pieces}, triangles {self.triangles}: at least 1 and 4")
        if not self.thresholds or list(self.thresholds) != sorted(set(self.thresholds), reverse=True):
            raise ValueError(f"thresholds {self.thresholds}: give at least one, from coarse to fine")


@dataclass(frozen=True, kw_only=True)
class CollisionReport:
    """How collision shapes were made and how well they match the part.

    ``method`` is "hull", "cut" (along known features) or "coacd" with its ``threshold``; ``limit`` says why CoACD's
    were not made finer. ``simplified_um`` is the largest error of the surface that was decomposed. Distances are from
    points all over one solid's surface to the other solid: the largest, and the 99th percentile. ``hull_um`` is how far
    the convex hulls of the part and of all pieces together are apart, the error of a part at rest.
    """

    method: Method
    threshold: float | None
    pieces: int
    excess_max_um: float
    excess_p99_um: float
    missing_max_um: float
    missing_p99_um: float
    excess_mm3: float
    missing_mm3: float
    hull_um: float
    simplified_um: float
    limit: Limit | None = None
    cpu_seconds: float = 0.0
    mesh_hash: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionShapes:
    """Convex pieces in frame ``part``, metres, and their report."""

    pieces: tuple[trimesh.Trimesh, ...]
    report: CollisionReport


def contact_pieces(part: Part, purpose: Purpose) -> tuple[trimesh.Trimesh, ...]:
    """The convex pieces (frame ``part``, metres) that stand for a part when it comes to ``rest`` or is in a ``grasp``.

    Resting, it stands on the same pieces as in the cell, whose hull is the part's to a micrometre (``hull_um``). Where
    they are more than 32, for the time that they would take in thousands of drops, the hull's corners do
    (``rest_pieces``): nothing else of a part meets a plane. A single hull does not serve: MuJoCo keeps few contacts
    between a pair of geoms, and of 200 drops of ``top``, whose large face has many corners, 30 % never lie still on it.
    ``python -m benchmarks.geometry`` prints the comparison.
    """
    if purpose not in ("rest", "grasp"):
        raise ValueError(f"purpose {purpose!r}: use rest or grasp")
    few = purpose == "grasp" or 0 < len(part.hulls) <= _MOST_TO_REST_ON
    return part.hulls if few else rest_pieces(part.mesh)


def find_collision_shapes(
    mesh: trimesh.Trimesh, config: CollisionConfig | None = None, cache: Path | None = None
) -> CollisionShapes:
    """Collision shapes of a closed mesh in metres.

    ``cache`` is a part's folder: shapes stored there for the same mesh are read instead, made ones are not stored.
    Raises DecompositionError when CoACD returns nothing and MeshError for a mesh that bounds no solid.
    """
    config = config or CollisionConfig()
    stored = read_collision(cache) if cache is not None else None
    if stored is not None:
        return stored
    start = time.process_time()
    hull = to_mesh(union_of_hulls([mesh]))
    report = measure(mesh, [hull], method="hull")
    if report.excess_max_um < 1e6 * _CONVEX_M:
        return CollisionShapes(pieces=(hull,), report=replace(report, cpu_seconds=_since(start)))
    simple, moved_um = _simplified(mesh, config)
    best: CollisionShapes | None = None
    limit: Limit = "threshold"
    for threshold in config.thresholds:
        began = time.process_time()
        settings = DecomposeConfig(threshold=threshold, max_pieces=config.max_pieces, seed=config.seed)
        pieces = fitted(decompose(simple, settings), mesh)
        report = measure(mesh, pieces, method="coacd", threshold=threshold, simplified_um=moved_um)
        if best is None or report.excess_max_um < best.report.excess_max_um:
            best = CollisionShapes(pieces=tuple(pieces), report=report)
        limit = _limit(report, config, _since(start) + _NEXT_TAKES * _since(began))
        if limit != "threshold":
            break
    assert best is not None
    return replace(best, report=replace(best.report, limit=limit, cpu_seconds=_since(start)))


def cut_shapes(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> CollisionShapes:
    """Convex pieces that were cut along the known features of ``mesh``, both in metres, with their report."""
    return CollisionShapes(pieces=tuple(pieces), report=measure(mesh, pieces, method="cut"))


def measure(
    mesh: trimesh.Trimesh,
    pieces: Sequence[trimesh.Trimesh],
    *,
    method: Method,
    limit: Limit | None = None,
    threshold: float | None = None,
    simplified_um: float = 0.0,
) -> CollisionReport:
    """The report on convex pieces of a closed mesh, both in metres; without ``cpu_seconds`` and ``mesh_hash``."""
    part, whole = solid_of(mesh), union_of_hulls(pieces)
    excess, missing = beyond(whole, part), beyond(part, whole)
    return CollisionReport(
        method=method,
        limit=limit,
        threshold=threshold,
        pieces=len(pieces),
        excess_max_um=round(1e6 * excess.max_m, 3),
        excess_p99_um=round(1e6 * excess.p99_m, 3),
        missing_max_um=round(1e6 * missing.max_m, 3),
        missing_p99_um=round(1e6 * missing.p99_m, 3),
        excess_mm3=round(1e9 * excess.volume_m3, 6),
        missing_mm3=round(1e9 * missing.volume_m3, 6),
        hull_um=round(1e6 * hulls_apart(mesh, pieces), 3),
        simplified_um=round(simplified_um, 3),
    )


def fitted(pieces: Sequence[trimesh.Trimesh], mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Convex pieces cut to the convex hull of ``mesh``, and grown to the corners of that hull which none reaches."""
    hull = union_of_hulls([mesh])
    inside = [union_of_hulls([piece]) ^ hull for piece in pieces]
    points = [np.asarray(to_mesh(solid).vertices) for solid in inside if not solid.is_empty()]
    corners = np.asarray(to_mesh(hull).vertices)
    apart = np.array([Surface(to_mesh(Manifold.hull_points(p))).distance(corners) for p in points])
    lost, owner = apart.min(axis=0) > _CORNER_M, apart.argmin(axis=0)
    grown = [np.concatenate([p, corners[lost & (owner == k)]]) for k, p in enumerate(points)]
    return [to_mesh(Manifold.hull_points(p)) for p in grown]


def write_collision(folder: Path, shapes: CollisionShapes) -> None:
    """Write ``hulls/`` and ``collision.json`` of a part's folder; earlier pieces are removed."""
    for old in (folder / "hulls").glob("*.ply"):
        old.unlink()
    for i, piece in enumerate(shapes.pieces):
        write_mesh(piece, folder / "hulls" / f"{i:03d}.ply")
    write_report(folder, shapes.report)


def write_report(folder: Path, report: CollisionReport) -> None:
    """Write ``collision.json`` for the mesh that is in the part's folder."""
    mesh = folder / "mesh.ply"
    report = replace(report, mesh_hash=hash_file(mesh)) if mesh.is_file() else report
    (folder / FILE).write_text(json.dumps(asdict(report), indent=1) + "\n")


def read_collision(folder: Path) -> CollisionShapes | None:
    """The shapes stored in a part's folder, None when there are none or they were made for another mesh."""
    path, mesh = folder / FILE, folder / "mesh.ply"
    pieces = sorted((folder / "hulls").glob("*.ply"))
    if not path.is_file() or not mesh.is_file():
        return None
    report = CollisionReport(**json.loads(path.read_text()))
    if report.mesh_hash != hash_file(mesh) or report.pieces != len(pieces):
        return None
    return CollisionShapes(pieces=tuple(load_mesh(p) for p in pieces), report=report)


def _limit(report: CollisionReport, config: CollisionConfig, seconds: float) -> Limit:
    """Why to stop here, "threshold" when there is no reason to; ``seconds`` is when another round would be done."""
    if report.excess_max_um < 1e6 * config.max_excess_m:
        return "target"
    if report.pieces >= config.max_pieces:
        return "pieces"
    return "time" if seconds > config.max_cpu_seconds else "threshold"


def _simplified(mesh: trimesh.Trimesh, config: CollisionConfig) -> tuple[trimesh.Trimesh, float]:
    """The mesh with fewer triangles when it has many, and how far in um its surface moved at most."""
    if len(mesh.faces) <= config.triangles:
        return mesh, 0.0
    solid = solid_of(mesh)
    simple = solid.simplify(config.simplify_m)
    moved = max(beyond(solid, simple).max_m, beyond(simple, solid).max_m)
    return to_mesh(simple), 1e6 * moved


def _since(start: float) -> float:
    return round(time.process_time() - start, 2)
