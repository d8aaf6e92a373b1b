"""Convex contact pieces of the USB Type-C parts: each feature of the solid, cut along planes where it is not convex.

CoACD needs 60 to 95 pieces for sheet of 0.3 mm and stands up to 70 um proud of the faces the gripper closes on. The
features are known here, so they are cut by hand: flat outer faces are exact and a bend of the shell stands proud by the
sagitta of its inner arc only, towards the inside.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh

from cad.decompose import Plane, cut
from cad.models import usb_c as u

ARC_SECTORS = 8
"""Pieces of each half-round side wall: 22.5 degrees, whose inner chord is 25 um proud."""
ROWS = ("rib", "post", "foot")
"""Contacts in a row are one piece: nothing in the cell is thin enough to enter the gaps of 0.25 and 0.30 mm."""
_SLACK_MM = 5e-4  # cells end this far before a face that lies in their boundary

Range = tuple[float, float]
_ANY: Range = (-np.inf, np.inf)


def cells(part: str, feature: str) -> list[list[Plane]]:
    """Half-spaces in millimetres whose intersections cut a feature into convex pieces; one without any when convex."""
    return {
        ("main", "tube"): _tube_cells,
        ("inserted", "flange"): lambda: [box(z=(-np.inf, 0.0)), box(z=(0.0, np.inf))],
        ("inserted", "tongue"): _tongue_cells,
        ("top", "sides"): _side_cells,
        ("top", "rear"): _rear_cells,
    }.get((part, feature), lambda: [[]])()


def pieces(part: str, features: dict[str, list[trimesh.Trimesh]]) -> list[trimesh.Trimesh]:
    """Convex pieces of a part from the meshes of its features, in millimetres like the meshes."""
    out: list[trimesh.Trimesh] = []
    for feature, meshes in features.items():
        solids = [_together(meshes)] if feature in ROWS else meshes
        out += [cut(mesh, planes) for mesh in solids for planes in cells(part, feature)]
    return out


def box(x: Range = _ANY, y: Range = _ANY, z: Range = _ANY) -> list[Plane]:
    """The half-spaces of an axis-aligned box, drawn in by the slack; infinite bounds are left out."""
    planes: list[Plane] = []
    for (low, high), (a, b, c) in zip((x, y, z), np.eye(3).tolist(), strict=True):
        if np.isfinite(high):
            planes.append(((a, b, c), high - _SLACK_MM))
        if np.isfinite(low):
            planes.append(((-a, -b, -c), -(low + _SLACK_MM)))
    return planes


def sector(axis: int, centre: tuple[float, float], start: float, stop: float) -> list[Plane]:
    """The wedge between two angles (rad, stop - start < pi) about a line along ``axis`` (0: y to z, 1: x to z)."""
    first, second = (1, 2) if axis == 0 else (0, 2)
    planes: list[Plane] = []
    for angle, sign in ((start, -1.0), (stop, 1.0)):
        n = np.zeros(3)
        n[first], n[second] = -sign * np.sin(angle), sign * np.cos(angle)
        planes.append(((float(n[0]), float(n[1]), float(n[2])), float(n[first] * centre[0] + n[second] * centre[1])))
    return planes


def _together(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    vertices, faces = trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes])
    return trimesh.Trimesh(vertices, faces, process=False)


def _tube_cells() -> list[list[Plane]]:
    corner = (u.SHELL_WIDTH - u.SHELL_HEIGHT) / 2
    ahead, behind = u.WINDOW_X + u.WINDOW_LENGTH / 2, u.WINDOW_X - u.WINDOW_LENGTH / 2
    out = [box(y=(-corner, corner), z=(-np.inf, 0.0))]
    inner, outer = u.WINDOW_Y - u.WINDOW_WIDTH / 2, u.WINDOW_Y + u.WINDOW_WIDTH / 2
    above = (0.0, np.inf)
    out.append(box(y=(-inner, inner), z=above))
    for low, high in ((inner, outer), (-outer, -inner)):
        out += [box(x=x, y=(low, high), z=above) for x in ((-np.inf, behind), (ahead, np.inf))]
    out += [box(y=y, z=above) for y in ((outer, corner), (-corner, -outer))]
    edges = np.linspace(-np.pi / 2, np.pi / 2, ARC_SECTORS + 1)
    for side, middle in ((corner, 0.0), (-corner, np.pi)):
        for start, stop in pairwise(edges):
            lower = (start + stop) / 2 < 0 if side > 0 else (start + stop) / 2 > 0
            half = box(z=(-np.inf, 0.0) if lower else above)
            out.append(sector(0, (side, 0.0), start + middle, stop + middle) + half)
    return out


def _tongue_cells() -> list[list[Plane]]:
    ahead, behind = u.NOTCH_X + u.NOTCH_LENGTH / 2, u.NOTCH_X - u.NOTCH_LENGTH / 2
    return [box(x=(ahead, np.inf)), box(x=(behind, ahead)), box(x=(-np.inf, behind))]


def _side_cells() -> list[list[Plane]]:
    y, z = u.COVER_INNER_WIDTH / 2 - u.COVER_BEND, u.COVER_TOP_Z - u.COVER_SHEET - u.COVER_BEND
    out = [box(y=(-y, y))]
    for side in (1, -1):
        beyond = (y, np.inf) if side > 0 else (-np.inf, -y)
        out.append(box(y=beyond, z=(-np.inf, z)))
        start = 0.0 if side > 0 else np.pi / 2
        for k in (0, 1):
            wedge = sector(0, (side * y, z), start + k * np.pi / 4, start + (k + 1) * np.pi / 4)
            out.append(wedge + box(y=beyond, z=(z, np.inf)))
    return out


def _rear_cells() -> list[list[Plane]]:
    x, z = u.COVER_REAR_X + u.COVER_SHEET + u.COVER_BEND, u.COVER_TOP_Z - u.COVER_SHEET - u.COVER_BEND
    out = [box(x=(x, np.inf)), box(x=(-np.inf, x), z=(-np.inf, z))]
    for k in (2, 3):
        wedge = sector(1, (x, z), k * np.pi / 4, (k + 1) * np.pi / 4)
        out.append(wedge + box(x=(-np.inf, x), z=(z, np.inf)))
    return out
