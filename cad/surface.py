"""One watertight surface from the soups of a part's file: repair, union, outer surface, simplification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from manifold3d import Manifold

from cad.meshes import MeshError, surface_samples
from cad.nearest import Surface
from cad.repair import close_gaps, drop_copies, drop_walls, fill_holes, open_edges, split_t_junctions
from cad.shells import inside, shells_of
from cad.solids import outer_union, to_mesh, to_solid
from cad.soup import Soup, orient, weld
from cad.wrap import wrap

_DIGITS = 9  # vertices that agree to a nanometre are one
_THIN = 1e-7
"""Volume per surface in metres below which a shell has no thickness to speak of."""
_MOST_LOST = 0.02  # of the area, to walls between what was filled
_SAMPLES = 4000
_WRAP_SIMPLIFIED = 0.1  # cells
_SLIVER = 1e-8  # metres; what unions leave behind along surfaces that touch


@dataclass(frozen=True, kw_only=True)
class RepairConfig:
    """How far a repair may go.

    ``gap_m``: gaps up to this width are closed by moving vertices, wider ones are filled. ``triangles``: a surface of
    more is simplified, no point moving further than ``simplify_m``. ``wrap_cells``: cells along the longest side of a
    surface that cannot be repaired and is wrapped instead.
    """

    gap_m: float = 10e-6
    triangles: int = 20_000
    simplify_m: float = 2e-6
    wrap_cells: int = 128

    def __post_init__(self) -> None:
        for key in ("gap_m", "simplify_m"):
            if not getattr(self, key) > 0:
                raise ValueError(f"{key} {getattr(self, key)}: it must be positive")
        if self.triangles < 4:
            raise ValueError(f"triangles {self.triangles}: a solid has 4 or more")
        if not 16 <= self.wrap_cells <= 512:
            raise ValueError(f"wrap_cells {self.wrap_cells}: use 16 to 512")


def outer_surface(soups: Sequence[Soup], name: str, config: RepairConfig) -> tuple[trimesh.Trimesh, int, list[str]]:
    """The outer surface of the union of all that is in the soups (metres), the number of solids, and notes.

    Raises MeshError where the soups enclose no volume.
    """
    notes: list[str] = []
    shells: list[Soup] = []
    for soup in soups:
        shells += _shells(soup, config, notes)
    thick = [shell for shell in shells if abs(shell.volume) > _THIN * _area(shell)]
    if not thick:
        raise MeshError(f"{name} encloses no volume (a surface without thickness?); export the part as a solid")
    if len(thick) < len(shells):
        notes.append(f"{_many(len(shells) - len(thick), 'surface')} without thickness left out")
    outer = _without_enclosed(thick, notes)
    turned = sum(shell.volume < 0 for shell in outer)
    if turned:
        notes.append(f"{_many(turned, 'shell')} of {len(outer)} had inward normals and were turned outwards")
    union = _united([to_solid(shell) for shell in outer], notes)
    if union.num_tri() > config.triangles:
        simple = union.simplify(config.simplify_m)
        notes.append(
            f"{union.num_tri()} triangles simplified to {simple.num_tri()}; no point moved more than "
            f"{_um(config.simplify_m)}"
        )
        union = simple
    return to_mesh(union), len(thick), notes


def _shells(soup: Soup, config: RepairConfig, notes: list[str]) -> list[Soup]:
    """The closed shells of a soup: repaired, or wrapped where that fails."""
    sound = _joined(soup, config, notes)
    closed, holes = fill_holes(sound, config.gap_m)
    pieces = closed.components()
    found = [shells_of(piece) for piece in pieces]
    shells = [shell for group in found if group is not None for shell in group]
    uneven = max((hole.unevenness for hole in holes), default=0.0)
    lost = 1 - sum(map(_area, shells)) / _area(closed)
    if uneven > config.gap_m and lost > _MOST_LOST:
        return _wrapped(sound, config, notes)  # the holes were filled wrongly
    for piece, group in zip(pieces, found, strict=True):
        if group is None:
            shells += _wrapped(piece, config, notes)
    oriented, _, _ = orient(sound)
    turned = int((oriented.faces != sound.faces).any(axis=1).sum())
    if turned:
        notes.append(f"{_many(turned, 'triangle')} of {len(sound.faces)} wound against the others turned round")
    if holes:
        widest = 1e3 * max(hole.width for hole in holes)
        flat = "all flat" if uneven <= config.gap_m else f"rims up to {_um(uneven)} off a plane; look at the preview"
        notes.append(f"{_many(len(holes), 'hole')} filled, the widest {widest:.3g} mm across ({flat})")
    return shells


def _joined(soup: Soup, config: RepairConfig, notes: list[str]) -> Soup:
    """The soup without copies and walls, its triangles joined where they ought to be."""
    before = len(soup.faces)
    soup = weld(soup, _DIGITS)
    if len(soup.faces) < before:
        notes.append(f"{_many(before - len(soup.faces), 'triangle')} dropped that had two corners at one place")
    soup, copies = drop_copies(soup)
    joints, closed_at = 0, 0.0
    for gap in (1e-2 * config.gap_m, 1e-1 * config.gap_m, config.gap_m):
        loose = len(open_edges(soup))
        if not loose:
            break
        closer, split = split_t_junctions(close_gaps(soup, gap), gap)
        if len(open_edges(closer)) < loose:
            soup, more = drop_copies(closer)
            joints, copies, closed_at = joints + split, copies + more, gap
    if copies:
        notes.append(f"{_many(copies, 'triangle')} dropped that occurred more than once or lay between two solids")
    if closed_at:
        among = f", {_many(joints, 'T-junction')} among them" if joints else ""
        notes.append(f"gaps of up to {_um(closed_at)} between triangles closed{among}")
    soup, walls = drop_walls(soup)
    if walls:
        notes.append(f"{_many(walls, 'inner wall')} dropped")
    return soup


def _wrapped(soup: Soup, config: RepairConfig, notes: list[str]) -> list[Soup]:
    """A wrap around a soup; nothing where it encloses nothing."""
    wrapped = wrap(soup, config.wrap_cells)
    if wrapped is None:
        notes.append(f"a surface of {_many(len(soup.faces), 'triangle')} that encloses nothing left out")
        return []
    cell = float(np.ptp(soup.vertices, axis=0).max()) / config.wrap_cells
    mesh = to_mesh(to_solid(wrapped).simplify(max(config.simplify_m, _WRAP_SIMPLIFIED * cell)))
    given = trimesh.Trimesh(soup.vertices, soup.faces, process=False)
    points = surface_samples(given, _SAMPLES, np.random.default_rng(0))[0]
    error = np.percentile(Surface(mesh).upper_bounds(points), 99)
    notes.append(
        f"a surface of {len(soup.faces)} triangles that does not close was wrapped anew: 99 % of it lies within "
        f"{_um(error)} of the wrap; look at the preview"
    )
    return [Soup(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))]


def _without_enclosed(shells: list[Soup], notes: list[str]) -> list[Soup]:
    """The shells that lie in no other."""
    boxes = [(shell.vertices.min(axis=0), shell.vertices.max(axis=0)) for shell in shells]
    outer, volume = [], 0.0
    for i, shell in enumerate(shells):
        around = [
            other
            for j, other in enumerate(shells)
            if j != i and (boxes[j][0] < boxes[i][0]).all() and (boxes[j][1] > boxes[i][1]).all()
        ]
        some = shell.vertices[:: max(1, len(shell.vertices) // 16)]
        if any(inside(other, some).all() for other in around):
            volume += abs(shell.volume)
        else:
            outer.append(shell)
    if volume:
        notes.append(
            f"{_many(len(shells) - len(outer), 'closed surface')} inside others left out, {1e9 * volume:.3g} mm3 "
            f"(cavities or inner bodies): the part counts as solid there"
        )
    return outer


def _united(solids: list[Manifold], notes: list[str]) -> Manifold:
    union, filled = outer_union(solids)
    if len(solids) > 1:
        union = union.simplify(_SLIVER)
        bodies = [body for body in union.decompose() if body.volume() > _THIN * body.surface_area()]
        if len(bodies) < len(union.decompose()):
            union = Manifold.compose(bodies)
        shared = sum(solid.volume() for solid in solids) - union.volume() + filled
        overlap = f"; they overlap by {1e9 * shared:.3g} mm3" if shared > 1e-6 * union.volume() else ""
        notes.append(f"{len(solids)} solids united{overlap}")
        if filled:
            notes.append(f"{1e9 * filled:.3g} mm3 that they enclose filled: the part counts as solid there")
        if len(bodies) > 1:
            notes.append(f"{len(bodies)} bodies that do not touch are kept where they are, as one rigid part")
    return union


def _area(shell: Soup) -> float:
    a, b, c = np.moveaxis(shell.triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _um(metres: float) -> str:
    return f"{1e6 * metres:.2g} um"
