"""Where a parallel gripper's pads would touch a part: surface samples, pad contacts, footprints and finger boxes.

Everything here is in the part's canonical table frame (stable pose, yaw 0, z up, table at z = 0) or in plan view on it.
The pads close along the unit vector ``a = (cos yaw, sin yaw)``; ``b = (sin yaw, -cos yaw)`` runs along the pads, so
that (a, b, -z) is the right-handed tool frame: +x closing direction, +z approach.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from cad.spatial import Array, apply


@dataclass(frozen=True, kw_only=True)
class PadStrip:
    """The region that the pads sweep: half length along b, lowest and highest height above the table, in metres."""

    half_width_m: float
    z_low_m: float
    z_high_m: float


@dataclass(frozen=True, kw_only=True)
class ContactRules:
    """What counts as a contact that holds, in metres and radians.

    ``max_roll`` and ``max_bulge`` bound the contact's curvature times half the width, across and along its straightest
    direction: 0 is flat and 1 a circle between the pads. A part rounder than a circle rolls over between them, and one
    that is round both ways touches them in two points only.
    """

    face_depth_m: float = 30e-6
    normal_tolerance: float = np.deg2rad(8.0)
    min_overlap_length_m: float = 0.6e-3
    min_overlap_height_m: float = 0.2e-3
    min_overlap_line_m: float = 0.02e-3
    min_area_m2: float = 0.15e-6
    flat_roll: float = 0.3
    max_roll: float = 1.25
    max_bulge: float = 0.5
    friction_table: float = 0.4

    def __post_init__(self) -> None:
        if not (self.face_depth_m > 0 and 0 < self.normal_tolerance < np.pi / 4):
            raise ValueError(
                f"face depth {self.face_depth_m} m must be positive and the normal tolerance "
                f"{self.normal_tolerance} rad between 0 and pi/4"
            )
        if not 0 < self.flat_roll <= self.max_bulge <= self.max_roll:
            raise ValueError(
                f"flat_roll {self.flat_roll}, max_bulge {self.max_bulge} and max_roll {self.max_roll} must be above 0 "
                "and in this order"
            )


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """Points (N, 3) on a surface with outward normals (N, 3), each standing for ``area_m2`` of it."""

    points: Array
    normals: Array
    area_m2: float

    def moved(self, T: Array) -> SurfaceSamples:
        """The samples in another frame: ``T`` (4, 4) maps into it."""
        return replace(self, points=apply(T, self.points), normals=self.normals @ T[:3, :3].T)


@dataclass(frozen=True, kw_only=True)
class PadContact:
    """Two facing contacts. Lengths in metres; ``a_mid_m`` is the middle between the faces along a.

    ``length_m`` and ``height_m`` measure the facing overlap along b and z, ``b_centre_m`` and ``z_centre_m`` its
    middle; ``flatness_m`` is the RMS depth of the touching samples under the extreme; ``z_touch_m`` the lowest touching
    point; ``roll`` the contact's largest curvature times half the width: 0 flat, 1 a circle between the pads.
    """

    width_m: float
    a_mid_m: float
    area_m2: float
    length_m: float
    height_m: float
    b_centre_m: float
    z_centre_m: float
    z_touch_m: float
    flatness_m: float
    roll: float


class Miss(Enum):
    """Why two pads cannot take hold at one place. The value says it of the nearest miss, whose figure it quotes."""

    NOTHING = "nothing between the pads"
    NO_FACE = "nothing flat enough faces both pads: at best {:.3f} mm2, {:.3f} needed"
    NOT_FACING = "the faces do not face each other: at best over {:.2f} mm, {:.2f} needed"
    ROLLS = "round: it would roll between the pads (curvature x half width {:.2f}, at most {:.2f})"
    POINT = (
        "round in both directions: it would touch the pads in points (curvature x half width {:.2f}, at most {:.2f})"
    )
    WIDE = "wider than the gripper opens: {:.1f} mm, at most {:.1f} with room to come down"
    THIN = "too thin for the hand to tell from nothing: {:.2f} mm, at least {:.2f}"
    TIPS = "would tip over when one finger pushes it: stands on {:.2f} mm, {:.2f} needed"
    HAND = "wider above the pads than between them: {:.1f} mm tall there, at most {:.1f}"


@dataclass(frozen=True, kw_only=True)
class Missed:
    """A miss with its figure and the limit that it fails, in the units of its text; ``short`` is how far off it is."""

    miss: Miss
    figure: float = 0.0
    limit: float = 0.0

    @property
    def short(self) -> float:
        """How far the figure is from the limit, as a share of the limit."""
        return abs(self.figure - self.limit) / max(self.limit, 1e-12)

    def __str__(self) -> str:
        return self.miss.value.format(self.figure, self.limit)


def sample_surface(mesh: trimesh.Trimesh, spacing_m: float, max_count: int = 120_000, seed: int = 0) -> SurfaceSamples:
    """Samples spread evenly over ``mesh``, about ``spacing_m`` apart, or wider on a surface too large for that."""
    count = min(max(1000, int(mesh.area / spacing_m**2)), max_count)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    return SurfaceSamples(points=points, normals=mesh.face_normals[faces], area_m2=mesh.area / count)


def closing_axes(yaw: float) -> tuple[Array, Array]:
    """Unit vectors (3,) along the closing direction and along the pads for a closing direction at ``yaw`` rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c, s, 0.0]), np.array([s, -c, 0.0])


@dataclass(frozen=True, kw_only=True)
class JawView:
    """Samples between the heights of a strip, sorted by b.

    Distances ``a`` and ``b`` along those axes and height ``z`` (N,); ``facing``, ``lean_b`` and ``lean_z`` (N,) are the
    normal's components along a, b and z.
    """

    a: Array
    b: Array
    z: Array
    facing: Array
    lean_b: Array
    lean_z: Array
    area_m2: float


def view_along(samples: SurfaceSamples, yaw: float, strip: PadStrip) -> JawView:
    """What pads that close along ``yaw`` can touch of ``samples``, which are in the table frame."""
    axis_a, axis_b = closing_axes(yaw)
    z = samples.points[:, 2]
    inside = np.nonzero((z >= strip.z_low_m) & (z <= strip.z_high_m))[0]
    b = samples.points[inside] @ axis_b
    order = np.argsort(b)
    inside = inside[order]
    normals = samples.normals[inside]
    return JawView(
        a=samples.points[inside] @ axis_a,
        b=b[order],
        z=z[inside],
        facing=normals @ axis_a,
        lean_b=normals @ axis_b,
        lean_z=normals[:, 2],
        area_m2=samples.area_m2,
    )


def pad_contact(view: JawView, b_centre_m: float, strip: PadStrip, rules: ContactRules) -> PadContact | Missed:
    """The contact of two pads with their middle at ``b_centre_m``, or why there is none.

    Each pad stops at the extreme point in the strip; the samples within ``rules.face_depth_m`` of it whose normals face
    the pad carry the contact. Faces, and straight round sides such as a screw's shank, can be held.
    """
    low, high = np.searchsorted(view.b, [b_centre_m - strip.half_width_m, b_centre_m + strip.half_width_m])
    if high - low < 10:
        return Missed(miss=Miss.NOTHING)
    a, b, z, facing = view.a[low:high], view.b[low:high], view.z[low:high], view.facing[low:high]
    a_min, a_max = float(a.min()), float(a.max())
    width = a_max - a_min
    cos_limit = np.cos(rules.normal_tolerance)
    right = (a > a_max - rules.face_depth_m) & (facing > cos_limit)
    left = (a < a_min + rules.face_depth_m) & (facing < -cos_limit)
    sides = (np.flatnonzero(right), np.flatnonzero(left))
    area = float(min(len(side) for side in sides) * view.area_m2)
    if area < rules.min_area_m2 or min(len(side) for side in sides) < 4:
        return Missed(miss=Miss.NO_FACE, figure=1e6 * area, limit=1e6 * rules.min_area_m2)
    places = [np.column_stack([b[side], z[side]]) for side in sides]
    leans = [np.column_stack([view.lean_b[low:high][side], view.lean_z[low:high][side]]) for side in sides]
    curvature = np.mean([_curvature(p, n) for p, n in zip(places, leans, strict=True)], axis=0)
    (bulge, roll), directions = np.linalg.eigh(curvature * width / 2)
    reach, centre = _overlap(places, np.eye(2))
    extent, across = reach, rules.min_overlap_height_m
    if roll > rules.flat_roll:  # lines, which overlap along themselves and hardly across
        extent, across = _overlap(places, directions.T)[0], rules.min_overlap_line_m
    for length, needed in zip(extent, (rules.min_overlap_length_m, across), strict=True):
        if length < needed:
            return Missed(miss=Miss.NOT_FACING, figure=1e3 * max(0.0, float(length)), limit=1e3 * needed)
    if bulge > rules.max_bulge:
        return Missed(miss=Miss.POINT, figure=float(bulge), limit=rules.max_bulge)
    if roll > rules.max_roll:
        return Missed(miss=Miss.ROLLS, figure=float(roll), limit=rules.max_roll)
    depths = np.concatenate([a_max - a[sides[0]], a[sides[1]] - a_min])
    return PadContact(
        width_m=width,
        a_mid_m=(a_max + a_min) / 2,
        area_m2=area,
        length_m=float(reach[0]),
        height_m=float(reach[1]),
        b_centre_m=float(centre[0]),
        z_centre_m=float(centre[1]),
        z_touch_m=float(max(p[:, 1].min() for p in places)),
        flatness_m=float(np.sqrt((depths**2).mean())),
        roll=max(0.0, float(roll)),
    )


def _curvature(places: Array, leans: Array) -> Array:
    """Curvature (2, 2) in 1/m of a nearly flat patch, from its normals' leans (N, 2) at ``places`` (N, 2).

    Least squares; a patch without extent in a direction counts as flat in it.
    """
    X, N = places - places.mean(axis=0), leans - leans.mean(axis=0)
    K = np.linalg.solve(X.T @ X + len(X) * 1e-10 * np.eye(2), X.T @ N)
    return (K + K.T) / 2


def _overlap(places: list[Array], directions: Array) -> tuple[Array, Array]:
    """Length (2,) over which the patches of both sides overlap along two directions (rows), and its middle."""
    spans = [p @ directions.T for p in places]
    low = np.max([s.min(axis=0) for s in spans], axis=0)
    high = np.min([s.max(axis=0) for s in spans], axis=0)
    return high - low, (high + low) / 2


def topples(contact: PadContact, yaw: float, base: Array, com: Array, friction_table: float) -> Missed | None:
    """Whether a single pad that touches first would tip the part over instead of sliding it.

    A push at height h against friction mu tips a part whose support reaches less than ``mu h`` beyond the centre of
    mass in the direction of the push. ``base`` (N, 2) are support points on the table, ``com`` (3,) the centre of mass.
    """
    axis_a, _ = closing_axes(yaw)
    reach = base @ axis_a[:2] - com @ axis_a
    stands, needed = float(min(reach.max(), -reach.min())), friction_table * contact.z_touch_m
    return Missed(miss=Miss.TIPS, figure=1e3 * stands, limit=1e3 * needed) if stands < needed else None


def support_points(mesh: trimesh.Trimesh, T_table_part: Array, tolerance_m: float = 20e-6) -> Array:
    """Plan-view points (N, 2) of the mesh that touch the table in a stable pose."""
    vertices = apply(T_table_part, mesh.vertices)
    return vertices[vertices[:, 2] < vertices[:, 2].min() + tolerance_m, :2]


def footprint(mesh: trimesh.Trimesh, T_base_part: Array, z_above_m: float = -np.inf) -> Array:
    """Convex outline (N, 2) of the mesh seen from above, counter-clockwise, of what lies above ``z_above_m``."""
    vertices = apply(T_base_part, mesh.vertices)
    plan = vertices[vertices[:, 2] > z_above_m, :2]
    return plan[ConvexHull(plan).vertices]


def rectangle(T_base_tcp: Array, x: tuple[float, float], y: tuple[float, float]) -> Array:
    """Plan-view corners (4, 2) of a box given by x and y ranges in ``tcp``, for a tool that points straight down."""
    corners = np.array([[x[0], y[0], 0.0], [x[1], y[0], 0.0], [x[1], y[1], 0.0], [x[0], y[1], 0.0]])
    return apply(T_base_tcp, corners)[:, :2]


def convex_gap(A: Array, B: Array) -> float:
    """Gap in metres between convex polygons (N, 2) and (M, 2): the widest separating band, negative when they overlap.

    Separating axis theorem over the edge normals; a lower bound of the distance when corners face each other.
    """
    gap = -np.inf
    for polygon in (A, B):
        edges = np.roll(polygon, -1, axis=0) - polygon
        lengths = np.linalg.norm(edges, axis=1)
        edges = edges[lengths > 1e-12] / lengths[lengths > 1e-12, None]
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        pa, pb = A @ normals.T, B @ normals.T
        bands = np.maximum(pb.min(axis=0) - pa.max(axis=0), pa.min(axis=0) - pb.max(axis=0))
        gap = max(gap, float(bands.max()))
    return gap
