"""Where a parallel gripper's pads would touch a part: surface samples, pad contacts, footprints and finger boxes.

Everything here is in the part's canonical table frame (stable pose, yaw 0, z up, table at z = 0) or in plan view on it.
The pads close along the unit vector ``a = (cos yaw, sin yaw)``; ``b = (sin yaw, -cos yaw)`` runs along the pads, so
that (a, b, -z) is the right-handed tool frame: +x closing direction, +z approach.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    """What counts as flat contact, in metres and radians."""

    face_depth_m: float = 30e-6
    normal_tolerance: float = np.deg2rad(8.0)
    min_overlap_length_m: float = 0.6e-3
    min_overlap_height_m: float = 0.2e-3
    min_area_m2: float = 0.15e-6
    friction_table: float = 0.4

    def __post_init__(self) -> None:
        if not (self.face_depth_m > 0 and 0 < self.normal_tolerance < np.pi / 4):
            raise ValueError(
                f"face depth {self.face_depth_m} m must be positive and the normal tolerance "
                f"{self.normal_tolerance} rad between 0 and pi/4"
            )


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """Points (N, 3) on a surface with outward normals (N, 3), each standing for ``area_m2`` of it."""

    points: Array
    normals: Array
    area_m2: float


@dataclass(frozen=True, kw_only=True)
class PadContact:
    """Two facing flat contacts. Lengths in metres; ``a_mid_m`` is the middle between the faces along a.

    ``length_m`` and ``height_m`` measure the facing overlap along b and z, ``b_centre_m`` and ``z_centre_m`` its
    middle; ``flatness_m`` is the RMS depth of the touching samples under the extreme; ``z_touch_m`` the lowest touching
    point.
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


def sample_surface(mesh: trimesh.Trimesh, spacing_m: float, seed: int = 0) -> SurfaceSamples:
    """Samples spread evenly over ``mesh``, about ``spacing_m`` apart."""
    count = max(1000, int(mesh.area / spacing_m**2))
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    return SurfaceSamples(points=points, normals=mesh.face_normals[faces], area_m2=mesh.area / count)


def closing_axes(yaw: float) -> tuple[Array, Array]:
    """Unit vectors (3,) along the closing direction and along the pads for a closing direction at ``yaw`` rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c, s, 0.0]), np.array([s, -c, 0.0])


@dataclass(frozen=True, kw_only=True)
class JawView:
    """Samples between the heights of a strip, sorted by b: distance along a and b, height, facing = normal . a."""

    a: Array
    b: Array
    z: Array
    facing: Array
    area_m2: float


def view_along(samples: SurfaceSamples, yaw: float, strip: PadStrip) -> JawView:
    """What pads that close along ``yaw`` can touch of ``samples``, which are in the table frame."""
    axis_a, axis_b = closing_axes(yaw)
    z = samples.points[:, 2]
    inside = np.nonzero((z >= strip.z_low_m) & (z <= strip.z_high_m))[0]
    b = samples.points[inside] @ axis_b
    order = np.argsort(b)
    inside = inside[order]
    return JawView(
        a=samples.points[inside] @ axis_a,
        b=b[order],
        z=z[inside],
        facing=samples.normals[inside] @ axis_a,
        area_m2=samples.area_m2,
    )


def pad_contact(view: JawView, b_centre_m: float, strip: PadStrip, rules: ContactRules) -> PadContact | str:
    """The flat contact of two pads with their middle at ``b_centre_m``, or why there is none.

    Each pad stops at the extreme point in the strip; the samples within ``rules.face_depth_m`` of it whose normals face
    the pad carry the contact.
    """
    low, high = np.searchsorted(view.b, [b_centre_m - strip.half_width_m, b_centre_m + strip.half_width_m])
    if high - low < 10:
        return "nothing between the pads"
    a, b, z, facing = view.a[low:high], view.b[low:high], view.z[low:high], view.facing[low:high]
    a_min, a_max = float(a.min()), float(a.max())
    cos_limit = np.cos(rules.normal_tolerance)
    right = (a > a_max - rules.face_depth_m) & (facing > cos_limit)
    left = (a < a_min + rules.face_depth_m) & (facing < -cos_limit)
    area = min(right.sum(), left.sum()) * view.area_m2
    if area < rules.min_area_m2:
        return "no flat face on one side"
    b_low, b_high = max(b[right].min(), b[left].min()), min(b[right].max(), b[left].max())
    z_low, z_high = max(z[right].min(), z[left].min()), min(z[right].max(), z[left].max())
    if b_high - b_low < rules.min_overlap_length_m or z_high - z_low < rules.min_overlap_height_m:
        return "the flat faces do not face each other"
    depths = np.concatenate([a_max - a[right], a[left] - a_min])
    return PadContact(
        width_m=a_max - a_min,
        a_mid_m=(a_max + a_min) / 2,
        area_m2=float(area),
        length_m=float(b_high - b_low),
        height_m=float(z_high - z_low),
        b_centre_m=float(b_high + b_low) / 2,
        z_centre_m=float(z_high + z_low) / 2,
        z_touch_m=float(max(z[right].min(), z[left].min())),
        flatness_m=float(np.sqrt((depths**2).mean())),
    )


def topples(contact: PadContact, yaw: float, base: Array, com: Array, friction_table: float) -> bool:
    """Whether a single pad that touches first would tip the part over instead of sliding it.

    A push at height h against friction mu tips a part whose support reaches less than ``mu h`` beyond the centre of
    mass in the direction of the push. ``base`` (N, 2) are support points on the table, ``com`` (3,) the centre of mass.
    """
    axis_a, _ = closing_axes(yaw)
    reach = base @ axis_a[:2] - com @ axis_a
    return bool(min(reach.max(), -reach.min()) < friction_table * contact.z_touch_m)


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
