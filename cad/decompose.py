"""Convex pieces of a part for contact: CoACD for any mesh, cutting by planes where the shape is known.

CoACD (Wei et al., SIGGRAPH 2022) suits solid parts. On sheet of 0.3 mm it needs 60 to 95 pieces and still stands tens
of micrometres proud; a part made of known convex features is cut along them instead (``cut``), which is exact on flat
faces. ``cad.collision`` measures how far pieces stand outside the part, whichever way they were made.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import coacd
import numpy as np
import trimesh

from cad.parts import CadError
from cad.spatial import Array

Plane = tuple[tuple[float, float, float], float]
"""Normal n and offset d: the half-space n . p <= d."""


class DecompositionError(CadError):
    """A mesh that could not be turned into convex pieces."""


@dataclass(frozen=True, kw_only=True)
class DecomposeConfig:
    """CoACD's settings. ``threshold`` is relative to the mesh's size: 0.05 for solids, 0.01-0.02 for thin sheet."""

    threshold: float = 0.05
    max_pieces: int = -1  # -1: as many as the threshold needs
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.01 <= self.threshold <= 1:
            raise ValueError(f"threshold {self.threshold}: CoACD takes 0.01 (fine) to 1 (coarse)")
        if self.max_pieces != -1 and self.max_pieces < 1:
            raise ValueError(f"max_pieces {self.max_pieces}: use -1 for no limit or at least 1")


def decompose(mesh: trimesh.Trimesh, config: DecomposeConfig | None = None) -> list[trimesh.Trimesh]:
    """Convex pieces that together cover the mesh, by CoACD, in the mesh's own units.

    CoACD is free of scale; only its ``real_metric`` is not, which takes the threshold in the mesh's units and makes one
    hull of any part in metres. Its search is a third as long here as by default: the pieces are as many and as good.

    Raises DecompositionError when CoACD returns nothing.
    """
    config = config or DecomposeConfig()
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=config.threshold,
        max_convex_hull=config.max_pieces,
        seed=config.seed,
        preprocess_mode="off",  # meshes of parts are closed
        mcts_nodes=10,
        mcts_iterations=60,
        mcts_max_depth=2,
        real_metric=False,
    )
    if not pieces:
        raise DecompositionError("CoACD found no convex piece; check that the mesh is closed and not degenerate")
    return [hull_of(np.asarray(vertices)) for vertices, _ in pieces]


def cut(mesh: trimesh.Trimesh, planes: Iterable[Plane] = ()) -> trimesh.Trimesh:
    """Convex hull of the part of ``mesh`` that lies inside all half-spaces.

    Exact where that part is convex and no three planes meet inside it. Raises DecompositionError when nothing of the
    mesh lies there.
    """
    polygons = list(np.asarray(mesh.triangles))
    for normal, offset in planes:
        n = np.asarray(normal, dtype=np.float64)
        polygons = [clipped for polygon in polygons if len(clipped := _clip(polygon, n, offset))]
        if not polygons:
            raise DecompositionError(f"nothing of the mesh lies where {n.tolist()} . p <= {offset}")
    return hull_of(np.concatenate(polygons))


def hull_of(points: Array) -> trimesh.Trimesh:
    """Convex hull of points (N, 3) as a closed mesh.

    Raises DecompositionError when the points span no volume.
    """
    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    if len(points) < 4 or size <= 0:
        raise DecompositionError(f"{len(points)} points of extent {size} span no volume")
    hull = trimesh.convex.convex_hull((points - centre) / size)  # at unit scale: the tolerances inside are absolute
    hull.apply_transform(np.diag([size, size, size, 1.0]))
    hull.apply_translation(centre)
    if not hull.volume > 0:
        raise DecompositionError(f"{len(points)} points of extent {size} span no volume")
    return hull


def _clip(polygon: Array, normal: Array, offset: float) -> Array:
    """The polygon (N, 3) cut by a half-space (Sutherland and Hodgman, CACM 1974); empty when nothing is left."""
    depth = offset - polygon @ normal
    if (depth >= 0).all():
        return polygon
    kept: list[Array] = []
    for i, (p, d) in enumerate(zip(polygon, depth, strict=True)):
        q, e = polygon[i - 1], depth[i - 1]
        if (d >= 0) != (e >= 0):
            kept.append(q + (p - q) * e / (e - d))
        if d >= 0:
            kept.append(p)
    return np.array(kept).reshape(-1, 3)
