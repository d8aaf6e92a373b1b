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
from cad.shells import all_inside, shells_of
from cad.solids import bounds_solid, outer_union, to_mesh, to_solid
from cad.soup import Soup, orient, weld
from cad.spatial import Array
from cad.wrap import wrap

MOST_TRIANGLES = 60_000
"""What the later stages take in good time."""
_DIGITS = 9  # vertices that agree to a nanometre are one
_THIN = 1e-7
"""Volume per surface in metres below which a shell has no thickness to speak of."""
_MOST_COMPARED = 50  # shells
_MOST_PIECES = 200  # open, that holes are filled of
_SLIGHT = 1e-6  # share that is not worth a note
_MOST_LOST = 0.02  # of the area, to walls between what was filled
_SAMPLES = 4000
_WRAP_SIMPLIFIED = 0.2  # cells
_SLIVER = 1e-8  # metres; height of triangles that unions leave behind where surfaces touch


@dataclass(frozen=True, kw_only=True)
class RepairConfig:
    """How far a repair may go.

    ``gap_m``: gaps up to this width are closed by moving vertices, wider ones are filled. ``triangles``: a surface of
    more is simplified, no point moving further than ``simplify_m`` (or what brings it below MOST_TRIANGLES).
    ``wrap_cells``: cells along the longest side of a surface that cannot be repaired and is wrapped instead.
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
    thick = [shell for shell in shells if _is_thick(shell)]
    if not thick:
        raise MeshError(f"{name} encloses no volume (a surface without thickness?); export the part as a solid")
    if len(thick) < len(shells):
        notes.append(f"{_many(len(shells) - len(thick), 'surface')} without thickness left out")
    outer = _without_enclosed(thick, notes)
    turned = sum(shell.volume < 0 for shell in outer)
    if turned:
        notes.append(f"inward normals of {_many(turned, 'shell')} of {len(outer)} turned outwards")
    union = _united([to_solid(shell) for shell in outer], notes)
    if len(outer) > 1 or (_heights(union) < _SLIVER).any():
        union = union.as_original().simplify(_SLIVER)
    if union.num_tri() > config.triangles:
        union = _simplified(union, config, notes)
    return to_mesh(union), len(thick), notes


def _shells(soup: Soup, config: RepairConfig, notes: list[str]) -> list[Soup]:
    """The closed shells of a soup: of its closed pieces, and of the open ones filled or wrapped together."""
    sound = _joined(soup, config, notes)
    oriented, _, _ = orient(sound)
    turned = int((oriented.faces != sound.faces).any(axis=1).sum())
    if turned:
        notes.append(f"{_many(turned, 'triangle')} of {len(sound.faces)} wound against the others turned round")
    piece = sound.pieces()
    loose = np.isin(piece, piece[np.isin(sound.edges.index.reshape(-1, 3), open_edges(sound)).any(axis=1)])
    shells = []
    for closed in sound.take(~loose).components():
        found = _cut(closed, notes)
        shells += _wrapped(closed, config, notes) if found is None else found
    if not loose.any():
        return shells
    rest = sound.take(loose)
    return shells + (_filled(rest, config, notes) or _wrapped(rest, config, notes))


def _filled(soup: Soup, config: RepairConfig, notes: list[str]) -> list[Soup] | None:
    """The shells of a soup with its holes filled; None where that makes no sense of it."""
    if soup.pieces().max() >= _MOST_PIECES:
        return None
    closed, holes = fill_holes(soup, config.gap_m)
    told: list[str] = []
    found = [_cut(piece, told) for piece in closed.components()]
    shells = [shell for group in found if group for shell in group if _is_thick(shell)]
    uneven = max(hole.unevenness for hole in holes)
    lost = 1 - sum(map(_area, shells)) / _area(closed)
    if not shells or (lost > _MOST_LOST and (uneven > config.gap_m or None in found)):
        return None
    widest = 1e3 * max(hole.width for hole in holes)
    flat = "all flat" if uneven <= config.gap_m else f"rims up to {_um(uneven)} off a plane; look at the preview"
    notes.append(f"{_many(len(holes), 'hole')} filled, the widest {widest:.3g} mm across ({flat})")
    notes += told
    if lost > _SLIGHT:
        notes.append(f"fragments that enclose nothing left out, {100 * lost:.2g} % of the surface")
    return shells


def _cut(piece: Soup, notes: list[str]) -> list[Soup] | None:
    """The shells of a closed piece; None where it does not fall into any."""
    shells = shells_of(piece)
    if shells and not all(map(bounds_solid, shells)):
        return None
    inner = len(piece.faces) - sum(len(shell.faces) for shell in shells or [piece])
    if inner:
        notes.append(f"{_many(inner, 'triangle')} dropped that had solid on both sides")
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
    cell = float(np.ptp(soup.vertices, axis=0).max()) / config.wrap_cells
    solid = Manifold() if wrapped is None else to_solid(wrapped).simplify(_WRAP_SIMPLIFIED * cell)
    if solid.is_empty():
        notes.append(f"a surface of {_many(len(soup.faces), 'triangle')} that encloses nothing left out")
        return []
    mesh = to_mesh(solid)
    given = trimesh.Trimesh(soup.vertices, soup.faces, process=False)
    points = surface_samples(given, _SAMPLES, np.random.default_rng(0))[0]
    error = np.percentile(Surface(mesh).upper_bounds(points), 99)
    notes.append(
        f"a surface of {len(soup.faces)} triangles that does not close was wrapped anew: 99 % of it lies within "
        f"{_um(error)} of the wrap; look at the preview"
    )
    return [Soup(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))]


def _without_enclosed(shells: list[Soup], notes: list[str]) -> list[Soup]:
    """The shells that lie in no other; all where there are many, for their union has the same outer surface."""
    if len(shells) > _MOST_COMPARED:
        return shells
    boxes = [(shell.vertices.min(axis=0), shell.vertices.max(axis=0)) for shell in shells]
    outer, volume = [], 0.0
    for i, shell in enumerate(shells):
        around = [
            other
            for j, other in enumerate(shells)
            if j != i and (boxes[j][0] < boxes[i][0]).all() and (boxes[j][1] > boxes[i][1]).all()
        ]
        some = shell.vertices[:: 1 + len(shell.vertices) // 4]
        if any(all_inside(other, some) for other in around):
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
        bodies = [body for body in union.decompose() if body.volume() > _THIN * body.surface_area()]
        if len(bodies) < len(union.decompose()):
            union = Manifold.compose(bodies)
        shared = sum(solid.volume() for solid in solids) - union.volume() + filled
        overlap = f"; they overlap by {1e9 * shared:.3g} mm3" if shared > _SLIGHT * union.volume() else ""
        notes.append(f"{len(solids)} solids united{overlap}")
        if filled > _SLIGHT * union.volume():
            notes.append(f"{1e9 * filled:.3g} mm3 that they enclose filled: the part counts as solid there")
        if len(bodies) > 1:
            notes.append(f"{len(bodies)} bodies without a common face are kept where they are, as one rigid part")
    return union


def _heights(solid: Manifold) -> Array:
    """(F,) smallest height of each triangle of a solid."""
    corners = np.asarray(to_mesh(solid).triangles)
    sides = np.roll(corners, -1, axis=1) - corners
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return areas / np.maximum(np.linalg.norm(sides, axis=2).max(axis=1), np.finfo(float).tiny)


def _simplified(solid: Manifold, config: RepairConfig, notes: list[str]) -> Manifold:
    """A solid of fewer triangles, at the tolerance asked for or, above MOST_TRIANGLES, the first that suffices."""
    tolerance = config.simplify_m
    simple = solid.simplify(tolerance)
    while simple.num_tri() > MOST_TRIANGLES:
        tolerance *= 2
        simple = solid.simplify(tolerance)
    notes.append(
        f"{solid.num_tri()} triangles simplified to {simple.num_tri()}; no point moved more than {_um(tolerance)}"
    )
    return simple


def _is_thick(shell: Soup) -> bool:
    return abs(shell.volume) > _THIN * _area(shell)


def _area(shell: Soup) -> float:
    a, b, c = np.moveaxis(shell.triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _um(metres: float) -> str:
    return f"{1e6 * metres:.0f} um" if metres >= 10e-6 else f"{1e6 * metres:.2g} um"
