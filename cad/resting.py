"""In which stable pose a part lies, modulo its symmetries and, where its hull is round, its roll."""

from __future__ import annotations

import numpy as np

from cad.parts import Part, StablePose
from cad.spatial import Array, angle_between, rotation_z, transform, yaw_of


def nearest_rest(part: Part, R_table_part: Array) -> tuple[StablePose, float]:
    """The stable pose that ``R_table_part`` (3, 3) is nearest to, and how far it leans from it in rad."""
    tilts = [tilt(part, pose, R_table_part) for pose in part.stable_poses]
    best = int(np.argmin(tilts))
    return part.stable_poses[best], tilts[best]


def tilt(part: Part, pose: StablePose, R_table_part: Array) -> float:
    """Angle in rad between the vertical and what is the vertical in a stable pose, seen from the part."""
    up = R_table_part[2]  # the table's normal in the part's frame
    target = pose.R_table_part[2]
    near = part.rest_symmetries(pose.index).nearest_direction(target, up)
    return float(angle_between(near, target))


def as_rest(part: Part, pose: StablePose, T_table_part: Array) -> Array:
    """The transform among those that leave the part at rest the same which is nearest to ``pose`` at some yaw.

    A nut that lies on its other face, or a screw rolled about its axis, comes back as the stable pose describes it, so
    that what is stored for the pose (grasps, nest, footprint) applies. ``T_table_part`` (4, 4), table +z up.
    """
    symmetries = part.rest_symmetries(pose.index)
    if symmetries.is_trivial:
        return T_table_part
    target = pose.R_table_part[2]
    options = [T_table_part @ S for S in symmetries.elements]
    options += [
        T @ axis.turn(_turn_between(axis.direction, target, T[2, :3]))
        for T in list(options)
        for axis in symmetries.continuous
    ]
    angles = angle_between(np.array(options)[:, 2, :3], target)
    near = [T for T, angle in zip(options, angles, strict=True) if angle <= angles.min() + 1e-6]
    return min(near, key=lambda T: abs(yaw_of(T[:3, :3] @ pose.R_table_part.T)))


def _turn_between(axis: Array, start: Array, end: Array) -> float:
    """Angle in rad about ``axis`` (3,) that turns ``start`` nearest to ``end``, both (3,)."""
    a, b = start - (start @ axis) * axis, end - (end @ axis) * axis
    return float(np.arctan2(axis @ np.cross(a, b), a @ b))


def settled(pose: StablePose, T_table_part: Array) -> Array:
    """A part near a stable pose brought down into it: x, y and yaw are kept, height and tilt are the pose's."""
    yaw = yaw_of(T_table_part[:3, :3] @ pose.R_table_part.T)
    return transform(rotation_z(yaw) @ pose.R_table_part, [*T_table_part[:2, 3], pose.t_table_part[2]])
