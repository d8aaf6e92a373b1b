"""Small things that are not parts: what else may lie on a board in a workshop, each at rest on a face of its own.

Fasteners, stampings, electronic components, wire, coins, paper, crumbs, and blocks, rings and channels about as large
as the parts, so that size and outline alone do not tell a part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from trimesh.creation import annulus, box, cylinder, icosphere
from trimesh.transformations import rotation_matrix, translation_matrix

from cad.parts import Part
from cad.spatial import Array

Point = tuple[float, float, float]
CRUMB = "crumb"
_FLAT_MM = 1e-4
_STEADY_MM = 0.01
_SAME_SIZE = 0.04


@dataclass(frozen=True, kw_only=True, eq=False)
class Distractor:
    """A thing that lies on z = 0 with its bounding rectangle centred at the origin: what is drawn, and the convex
    ``pieces`` that touch others from the side. Metres.
    """

    name: str
    mesh: trimesh.Trimesh
    pieces: tuple[trimesh.Trimesh, ...]

    @property
    def kind(self) -> str:
        """What it is: its name without the number."""
        return self.name.rsplit("_", 1)[0]

    @cached_property
    def radius_m(self) -> float:
        """Radius of the circle round the origin that holds its footprint."""
        return float(np.linalg.norm(self.mesh.vertices[:, :2], axis=1).max())

    def resembles(self, part: Part) -> bool:
        """Whether it is as long, wide and high as a part and fills as much of that: it might be the part."""
        mine, its = np.sort(self.mesh.extents), np.sort(part.mesh.extents)
        hulls = np.array([self.mesh.convex_hull.volume, part.mesh.convex_hull.volume])
        return bool((np.abs(mine / its - 1) < _SAME_SIZE).all() and abs(hulls[0] / hulls[1] - 1) < _SAME_SIZE)


@lru_cache(maxsize=1)
def distractors() -> Mapping[str, Distractor]:
    """Name -> distractor, several of each of some twenty kinds; always the same."""
    made: dict[str, list[_Thing]] = {
        "washer": [_holed(1.08 * d, 2.2 * d, 0.16 * d, 40) for d in (2.0, 3.0, 4.0)],
        "nut": [_holed(d, 1.85 * d * 2 / np.sqrt(3), 0.8 * d, 6) for d in (2.0, 2.5, 3.0, 4.0)],
        "screw": [_screw(d, length, kind) for d, length, kind in _SCREWS],
        "block": [_boxes((size, (0, 0, 0))) for size in ((9, 7, 3), (5, 4, 2.5), (12, 3, 1.2), (7, 7, 0.5))],
        "disc": [_Thing([cylinder(radius=r, height=h, sections=40)]) for r, h in ((3, 2), (1.6, 6), (4.5, 0.8))],
        "pin": [_Thing([_lying(cylinder(radius=r, height=h, sections=24))]) for r, h in ((1, 8), (0.6, 12), (0.4, 7))],
        "strip": [_boxes((size, (0, 0, 0))) for size in ((3, 14, 0.4), (6, 20, 0.2), (1.5, 9, 0.3))],
        "bracket": [_bracket(7, 6, 4, 0.5), _bracket(9, 4, 3, 0.4)],
        "channel": [_channel(9, 7, 3, 0.3), _channel(5.7, 9.4, 2, 0.4), _channel(7.3, 8.9, 4.1, 0.6)],
        "ring": [_frame(9, 7.5, 3.6, 0.5), _frame(7.7, 8, 3.3, 0.3), _frame(5.7, 9.4, 1.2, 0.8)],
        "step": [
            _boxes(((7.5, 8.5, 1.5), (0, 0, 0.75)), ((4, 8.5, 2.2), (-1.75, 0, 2.6))),
            _boxes(((5.5, 9, 1), (0, 0, 0.5)), ((3.5, 3, 1.2), (0, 3, 1.6)), ((3.5, 3, 1.2), (0, -3, 1.6))),
        ],
        "tongue": [_boxes(((3, 9, 2), (-2, 0, 1)), ((4.5, 7, 0.7), (1.6, 0, 1.2)))],
        "ball": [_Thing([icosphere(subdivisions=3, radius=r)]) for r in (1.0, 1.75)],
        "chip": [_chip(4.9, 3.9, 4), _chip(9.9, 3.9, 7), _boxes(((5, 5, 0.9), (0, 0, 0)))],
        "resistor": [_ends(2.0, 1.25, 0.5, 0.4), _ends(3.2, 1.6, 0.6, 0.5)],
        "header": [_boxes(((7.6, 2.5, 2.5), (0, 0, 1.25)), *[((0.6, 6, 0.6), (x, 3, 1.25)) for x in (-2.5, 0, 2.5)])],
        "wire": [_wire(points, r) for r, points in _WIRES],
        "coin": [_coin(d, h) for d, h in ((16.25, 1.67), (18.75, 1.67))],
        "paper": [_scrap(seed, size, 0.1) for seed, size in enumerate((4.0, 6.0, 8.0, 5.0))],
        CRUMB: [_crumb(seed, size) for seed, size in enumerate((0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.75, 0.9))],
    }
    found = [_at_rest(f"{kind}_{k}", thing) for kind, things in made.items() for k, thing in enumerate(things)]
    return MappingProxyType({distractor.name: distractor for distractor in found})


def distractor_meshes() -> dict[str, trimesh.Trimesh]:
    """Name -> mesh in metres of every distractor, lying on z = 0 round the origin."""
    return {name: distractor.mesh for name, distractor in distractors().items()}


class _Thing:
    """Solids in mm, and the convex pieces that stand for them where the solids are not convex themselves."""

    def __init__(self, solids: Sequence[trimesh.Trimesh], pieces: Sequence[trimesh.Trimesh] | None = None) -> None:
        self.solids, self.pieces = list(solids), list(pieces or solids)


_SCREWS = (
    (2.0, 5.0, "round"),
    (2.0, 3.0, "sunk"),
    (2.5, 7.0, "round"),
    (3.0, 6.0, "hexagon"),
    (3.0, 4.0, "sunk"),
    (1.4, 4.0, "round"),
)
"""Thread and length in mm, and the head's shape."""
_WIRES: tuple[tuple[float, tuple[tuple[float, float], ...]], ...] = (
    (0.25, ((0, 0), (12, 0))),
    (0.25, ((0, 0), (4, 2), (9, 1.5), (13, 4))),
    (0.4, ((0, 0), (7, 0), (7, 5))),
    (0.3, ((0, 0), (6, 0), (7.5, 1.5), (6, 3), (0, 3))),
    (0.5, ((0, 0), (3, 3), (6, 2), (9, 5), (8, 9))),
)
"""Radius and the corners of the centre line, mm."""


def _at_rest(name: str, thing: _Thing) -> Distractor:
    """Turn a thing as little as possible until it stands on a face of its hull, centre it and convert it to metres."""
    volumes = np.array([solid.volume for solid in thing.pieces])
    centre = volumes @ [solid.center_mass for solid in thing.pieces] / volumes.sum()
    hull = trimesh.util.concatenate(thing.pieces).convex_hull
    for normal in sorted(np.unique(hull.face_normals.round(6), axis=0), key=lambda n: float(n[2])):
        T = trimesh.geometry.align_vectors(normal, [0.0, 0.0, -1.0])
        if _stands(trimesh.transform_points(hull.vertices, T), trimesh.transform_points(centre[None], T)[0]):
            break
    low, high = hull.copy().apply_transform(T).bounds
    T = translation_matrix([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]]) @ T
    T = np.diag([1e-3, 1e-3, 1e-3, 1.0]) @ T
    drawn = trimesh.util.concatenate(thing.solids)
    assert isinstance(drawn, trimesh.Trimesh)
    return Distractor(
        name=name,
        mesh=drawn.apply_transform(T),
        pieces=tuple(piece.convex_hull.apply_transform(T) for piece in thing.pieces),
    )


def _stands(corners: Array, centre: Array) -> bool:
    """Whether a centre of mass is above the inside of the face that corners (V, 3), mm, rest on."""
    face = corners[corners[:, 2] < corners[:, 2].min() + _FLAT_MM, :2]
    if len(face) < 3 or np.linalg.matrix_rank(face - face[0], tol=_STEADY_MM) < 2:
        return False
    sides = ConvexHull(face).equations
    return bool((sides[:, :2] @ centre[:2] + sides[:, 2] < -_STEADY_MM).all())


def _lying(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """From standing along z to lying along x."""
    return mesh.apply_transform(rotation_matrix(np.pi / 2, [0, 1, 0]))


def _boxes(*boxes: tuple[Point, Point]) -> _Thing:
    """Boxes, each a size and a centre."""
    return _Thing([box(size, translation_matrix(at)) for size, at in boxes])


def _holed(inner: float, outer: float, height: float, sections: int) -> _Thing:
    """A washer or nut: diameters of its hole and of the circle round it."""
    mesh = annulus(r_min=inner / 2, r_max=outer / 2, height=height, sections=sections)
    return _Thing([mesh], [mesh.convex_hull])


def _screw(thread: float, length: float, head: str) -> _Thing:
    shank = cylinder(radius=thread / 2, height=length, sections=24)
    height = 0.55 * thread if head == "sunk" else 0.7 * thread
    top = cylinder(radius=0.95 * thread, height=height, sections=6 if head == "hexagon" else 32)
    if head == "sunk":
        narrow = top.vertices[:, 2] < 0
        top.vertices[narrow, :2] *= 0.5 / 0.95
    top.apply_translation([0, 0, (length + height) / 2])
    return _Thing([_lying(shank), _lying(top)])


def _bracket(length: float, width: float, height: float, sheet: float) -> _Thing:
    return _boxes(((length, width, sheet), (length / 2, 0, sheet / 2)), ((sheet, width, height), (0, 0, height / 2)))


def _channel(length: float, width: float, height: float, sheet: float) -> _Thing:
    side, at = (sheet, width, height), (length - sheet) / 2
    return _boxes(
        ((length, width, sheet), (0, 0, sheet / 2)), (side, (-at, 0, height / 2)), (side, (at, 0, height / 2))
    )


def _frame(length: float, width: float, height: float, wall: float) -> _Thing:
    """A rectangular ring."""
    x, y = (length - wall) / 2, (width - wall) / 2
    along, across = (length, wall, height), (wall, width - 2 * wall, height)
    return _boxes((along, (0, y, 0)), (along, (0, -y, 0)), (across, (x, 0, 0)), (across, (-x, 0, 0)))


def _chip(length: float, width: float, legs: int) -> _Thing:
    """A component with ``legs`` gull-wing legs a side; from the side a row of legs touches like a bar."""
    body = box((length, width, 1.4), translation_matrix([0, 0, 0.85]))
    feet, shins, rows = [], [], []
    for side in (-1, 1):
        y = side * (width / 2 + 0.75)
        for x in 1.27 * (np.arange(legs) - (legs - 1) / 2):
            feet.append(box((0.4, 0.9, 0.2), translation_matrix([x, y, 0.1])))
            shins.append(box((0.4, 0.6, 0.2), translation_matrix([x, side * (width / 2 + 0.2), 0.8])))
            shins.append(box((0.4, 0.2, 0.9), translation_matrix([x, side * (width / 2 + 0.4), 0.45])))
        rows.append(trimesh.util.concatenate(feet[-legs:]).convex_hull)
        rows.append(trimesh.util.concatenate(shins[-2 * legs :]).convex_hull)
    return _Thing([body, *feet, *shins], [body, *rows])


def _ends(length: float, width: float, height: float, end: float) -> _Thing:
    """A chip resistor: a body between two end caps that stand out a little."""
    cap, at = (end, width, height), (length - end) / 2
    body = ((length - 2 * end, 0.94 * width, 0.9 * height), (0.0, 0.0, 0.0))
    return _boxes(body, (cap, (-at, 0, 0)), (cap, (at, 0, 0)))


def _wire(points: tuple[tuple[float, float], ...], radius: float) -> _Thing:
    """Straight pieces of round wire, flat on the table, with round bends."""
    at = np.column_stack([np.array(points, float), np.zeros(len(points))])
    straight = [cylinder(radius=radius, segment=at[k : k + 2], sections=12) for k in range(len(at) - 1)]
    bends = [icosphere(subdivisions=1, radius=radius).apply_translation(p) for p in at[1:-1]]
    return _Thing([*straight, *bends])


def _coin(diameter: float, height: float) -> _Thing:
    """A disc with a raised rim."""
    disc = cylinder(radius=diameter / 2 - 0.3, height=height - 0.2, sections=64)
    rim = annulus(r_min=diameter / 2 - 0.6, r_max=diameter / 2, height=height, sections=64)
    return _Thing([disc, rim], [rim.convex_hull])


def _scrap(seed: int, size: float, thickness: float) -> _Thing:
    """A torn piece of paper: a flat polygon."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
    edge = size * rng.uniform(0.6, 1.0, 7)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    corners = [np.column_stack([edge, np.full(7, z)]) for z in (0.0, thickness)]
    return _Thing([trimesh.Trimesh(np.concatenate(corners)).convex_hull])


def _crumb(seed: int, size: float) -> _Thing:
    """A grain of dirt: the hull of some random points, flatter than it is wide."""
    points = np.random.default_rng(seed).normal(size=(14, 3)) * size * np.array([0.7, 0.5, 0.35])
    return _Thing([trimesh.Trimesh(points).convex_hull])
