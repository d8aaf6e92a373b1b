"""Faces of a part's convex hull that hold its centre of mass, and which of them are one and the same way to rest.

trimesh finds the faces and how probable each is if the part topples without momentum (Goldberg et al., "Part pose
statistics", IEEE Trans. Robotics and Automation, 1999). Faces that a symmetry of the part brings together count once,
and so do the narrow faces round a screw or a pin: where the hull is round about a line through the centre of mass, the
part rests at any turn about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from cad.equivalence import Axis, Symmetries
from cad.spatial import Array, angle_between
from cad.symmetry import find_symmetries

LEVEL_RAD = np.radians(10.0)
"""A part rolls only about an axis farther than this from the vertical; nearer, it stands on its end."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RestingFace:
    """A way to rest: the table's normal ``up`` (3,) in the part's frame, its quasi-static ``probability``, and the axis
    that the part may ``roll`` about.

    ``up`` is opposite to a face of the hull if ``on_hull``, else it is where only physics found the part at rest.
    """

    up: Array
    probability: float = 0.0
    roll: Axis | None = None
    on_hull: bool = True

    def angles(self, ups: Array, symmetries: Symmetries) -> Array:
        """(N,) rad between ``up`` and directions ``ups`` (N, 3), modulo the part's symmetries and the roll."""
        rests = self.rests(symmetries)
        if len(rests.continuous) > 1:  # a ball
            return np.zeros(len(ups))
        images = np.einsum("sab,nb->sna", rests.elements[:, :3, :3], ups)
        if rests.continuous:
            axis = rests.continuous[0].direction
            return np.abs(angle_between(images, axis) - angle_between(self.up, axis)).min(axis=0)
        apart = np.linalg.norm(images - self.up, axis=-1).min(axis=0)
        return 2 * np.arcsin(np.clip(apart / 2, 0.0, 1.0))

    def rests(self, symmetries: Symmetries) -> Symmetries:
        """The part's ``symmetries`` and the roll."""
        return symmetries if self.roll is None else symmetries.with_axis(self.roll)


def resting_faces(mesh: trimesh.Trimesh) -> tuple[Array, Array]:
    """Upward directions (F, 3) in the part's frame for which the centre of mass stands over a face of the hull, and
    their quasi-static probabilities (F,), most probable first.
    """
    scale = 1.0 / float(np.ptp(mesh.bounds, axis=0).max())  # the tolerances inside are absolute
    unit = trimesh.Trimesh(scale * (mesh.vertices - mesh.center_mass), mesh.faces, process=False)
    transforms, shares = trimesh.poses.compute_stable_poses(unit, center_mass=np.zeros(3), seed=0)
    return np.array([T[2, :3] for T in transforms]), np.asarray(shares) / np.sum(shares)


def ways_to_rest(mesh: trimesh.Trimesh, symmetries: Symmetries, same_rad: float) -> list[RestingFace]:
    """The resting faces that differ by more than ``same_rad`` modulo the part's ``symmetries``, most probable first.

    Their probabilities are those of all the faces they stand for. Of faces round a hull, the one that stays is nearest
    to an axis of the part's frame.
    """
    ups, shares = resting_faces(mesh)
    axis = roll_axis(mesh, symmetries)
    kept: list[RestingFace] = []
    for up, share in zip(ups, shares, strict=True):
        face = RestingFace(up=up, probability=float(share), roll=_roll_of(up, axis))
        same = next((i for i, k in enumerate(kept) if k.angles(up[None], symmetries)[0] <= same_rad), None)
        if same is None:
            kept.append(face)
            continue
        keeper = kept[same]
        squarer = keeper.roll is not None and np.abs(up).max() > np.abs(keeper.up).max() + 1e-6
        kept[same] = replace(face if squarer else keeper, probability=keeper.probability + face.probability)
    return sorted(kept, key=lambda face: -face.probability)


def roll_axis(mesh: trimesh.Trimesh, symmetries: Symmetries) -> Axis | None:
    """The line through the centre of mass about which the convex hull is round, unless the mesh itself is (its
    ``symmetries`` say so then).
    """
    if symmetries.continuous:
        return None
    vertices = np.asarray(mesh.vertices)
    hull = trimesh.Trimesh(vertices / mesh.scale, mesh.faces, process=False).convex_hull
    hull = trimesh.Trimesh(hull.vertices * mesh.scale, hull.faces, process=False)
    found = find_symmetries(hull)
    through = (a for a in found.continuous if _distance(a, mesh.center_mass) <= found.tolerance_m)
    axis = next(through, None)
    return None if axis is None else Axis(direction=axis.direction, point=np.array(mesh.center_mass))


def nearest_faces(ups: Array, faces: Sequence[RestingFace], symmetries: Symmetries) -> tuple[NDArray[np.int64], Array]:
    """For directions ``ups`` (N, 3): which face is nearest (N,), and the angle to it in rad (N,)."""
    angles = np.array([face.angles(ups, symmetries) for face in faces]).reshape(len(faces), len(ups))
    nearest = angles.argmin(axis=0)
    return nearest, angles[nearest, np.arange(len(ups))]


def _roll_of(up: Array, axis: Axis | None) -> Axis | None:
    if axis is None:
        return None
    lean = float(angle_between(up, axis.direction))
    return axis if LEVEL_RAD < lean < np.pi - LEVEL_RAD else None


def _distance(axis: Axis, point: Array) -> float:
    return float(np.linalg.norm(np.cross(axis.direction, point - axis.point)))
