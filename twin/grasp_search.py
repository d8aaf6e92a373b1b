"""Candidate grasps of a part in a stable pose, found from its mesh: closing direction, place along the pads, height."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh

from cad import gripper
from cad.parts import Part, StablePose
from cad.spatial import Array, inverse, transform
from twin.grasp_config import Grasp, GraspConfig
from twin.grasp_geometry import (
    Miss,
    Missed,
    PadContact,
    PadStrip,
    SurfaceSamples,
    closing_axes,
    pad_contact,
    sample_surface,
    support_points,
    topples,
    view_along,
)

_FACE_YAWS = 16
"""At most this many closing directions are taken from the part's faces, the largest ones."""
_FACE_BIN = np.deg2rad(0.2)
_LEDGE_BIN_M = 0.1e-3
_LEDGE_AREA_M2 = 0.3e-6
_LEDGES = 3
_LEVEL_NORMAL = 0.9
_LEVEL_AXIS = np.deg2rad(20.0)
_SECTOR = np.deg2rad(15.0)


@dataclass(frozen=True, kw_only=True)
class GraspSearch:
    """Candidates of one stable pose, best first, and how often each reason spoke against others: the nearest miss."""

    grasps: tuple[Grasp, ...]
    rejections: dict[Missed, int]


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where a candidate's pads are: closing direction (rad), place along the pads and tips above the table (m)."""

    yaw: float
    b: float
    tips_m: float


def find_grasps(
    part: Part, stable_pose: StablePose, config: GraspConfig | None = None, samples: SurfaceSamples | None = None
) -> GraspSearch:
    """Parallel-jaw grasps of ``part`` in ``stable_pose``, ranked by geometry.

    Closing directions are those of the part's upright faces and a regular fan; the tips come down to the table and to
    just above every ledge. ``samples`` of the part's surface, in its frame, may be passed in to save time.
    """
    config = config or GraspConfig()
    T = stable_pose.T_table_part
    local = samples or sample_surface(part.mesh, config.sample_spacing_m, config.max_samples)
    lying = local.moved(T)
    com = T[:3, :3] @ part.mesh.center_mass + T[:3, 3]
    base = support_points(part.mesh, T)
    axes = part.rest_symmetries(stable_pose.index).continuous
    rolls = any(
        abs(T[2, :3] @ axis.direction) < np.sin(_LEVEL_AXIS) for axis in axes
    )  # a push rolls it, does not tip it
    misses: Counter[Miss] = Counter()
    nearest: dict[Miss, Missed] = {}
    found: list[tuple[_Place, Grasp]] = []
    for place, contact in _contacts(part.mesh, lying, T, com, config):
        missed = contact if isinstance(contact, Missed) else _unfit(contact, place, lying, config)
        if missed is None and isinstance(contact, PadContact) and not rolls:
            missed = topples(contact, place.yaw, base, com, config.rules.friction_table)
        if missed is None:
            assert isinstance(contact, PadContact)
            found.append((place, _grasp(part, stable_pose, place, contact, com, config)))
            continue
        misses[missed.miss] += 1
        if missed.miss not in nearest or missed.short < nearest[missed.miss].short:
            nearest[missed.miss] = missed
    found.sort(key=lambda item: -item[1].quality)
    chosen = sorted(_varied(_distinct(found, config))[: config.keep], key=lambda g: -g.quality)
    return GraspSearch(grasps=tuple(chosen), rejections={nearest[miss]: n for miss, n in misses.most_common()})


def _contacts(
    mesh: trimesh.Trimesh, lying: SurfaceSamples, T_table_part: Array, com: Array, config: GraspConfig
) -> Iterator[tuple[_Place, PadContact | Missed]]:
    """What the pads would touch at every candidate place."""
    steps = int(config.lateral_reach_m / config.lateral_step_m)
    beside = config.lateral_step_m * np.arange(-steps, steps + 1)
    yaws = _closing_yaws(mesh, T_table_part, config)
    for tips in _tip_heights(lying, config):
        strip = PadStrip(half_width_m=gripper.PAD_WIDTH_M / 2, z_low_m=tips, z_high_m=tips + gripper.PAD_HEIGHT_M)
        for yaw in yaws:
            view = view_along(lying, yaw, strip)
            for b in com @ closing_axes(yaw)[1] + beside:
                yield _Place(yaw=yaw, b=float(b), tips_m=tips), pad_contact(view, float(b), strip, config.rules)


def _closing_yaws(mesh: trimesh.Trimesh, T_table_part: Array, config: GraspConfig) -> list[float]:
    """Directions (rad, in [0, pi)) of the normals of upright faces, largest first area for area, and a regular fan."""
    normals = mesh.face_normals @ T_table_part[:3, :3].T
    upright = np.abs(normals[:, 2]) < np.sin(config.rules.normal_tolerance)
    yaws = np.arctan2(normals[upright, 1], normals[upright, 0]) % np.pi
    areas = mesh.area_faces[upright]
    bins = np.round(yaws / _FACE_BIN).astype(int)
    total = np.bincount(bins, areas)
    largest = [k for k in np.argsort(-total)[:_FACE_YAWS] if total[k] > config.rules.min_area_m2]
    faces = [float(np.average(yaws[bins == k], weights=areas[bins == k])) for k in largest]
    fan = [
        float(y)
        for y in np.arange(0.0, np.pi - 1e-9, config.yaw_step)
        if all(_turn_between(y, f) > _FACE_BIN for f in faces)
    ]
    return sorted(faces + fan)


def _tip_heights(lying: SurfaceSamples, config: GraspConfig) -> list[float]:
    """Heights of the pads' tips: just above the table, and just above the largest ledges that face up."""
    z = lying.points[:, 2]
    ledges = z[lying.normals[:, 2] > _LEVEL_NORMAL]
    bins = np.bincount(np.maximum(0, np.floor(ledges / _LEDGE_BIN_M)).astype(int), minlength=1)
    heights = [config.tip_clearance_m]
    highest = float(z.max()) - config.rules.min_overlap_height_m
    for k in np.argsort(-bins)[: 4 * _LEDGES]:
        tips = (k + 1) * _LEDGE_BIN_M + config.tip_clearance_m
        separate = all(abs(tips - other) > 2 * _LEDGE_BIN_M for other in heights)
        if bins[k] * lying.area_m2 > _LEDGE_AREA_M2 and tips < highest and separate and len(heights) <= _LEDGES:
            heights.append(float(tips))
    return heights


def _unfit(contact: PadContact, place: _Place, lying: SurfaceSamples, config: GraspConfig) -> Missed | None:
    if contact.width_m > config.max_width_m:
        return Missed(miss=Miss.WIDE, figure=1e3 * contact.width_m, limit=1e3 * config.max_width_m)
    if contact.width_m < config.min_width_m:
        return Missed(miss=Miss.THIN, figure=1e3 * contact.width_m, limit=1e3 * config.min_width_m)
    return _hits_hand(contact, place, lying, config)


def _hits_hand(contact: PadContact, place: _Place, lying: SurfaceSamples, config: GraspConfig) -> Missed | None:
    """Whether what stands higher than the pads reaches into the fingers above them, or up to the hand."""
    blade_top = place.tips_m + gripper.PAD_HEIGHT_M
    high = lying.points[lying.points[:, 2] > blade_top]
    if not len(high):
        return None
    axis_a, axis_b = closing_axes(place.yaw)
    across, along = np.abs(high @ axis_a - contact.a_mid_m), np.abs(high @ axis_b - place.b)
    carriage = high[:, 2] > place.tips_m + gripper.FINGER_LENGTH_M
    reach = np.where(carriage, gripper.CARRIAGE_WIDTH_M, gripper.FINGER_ROOT_WIDTH_M) / 2
    inside = (across > contact.width_m / 2 + gripper.PAD_COATING_M) & (along < reach)
    inside |= high[:, 2] > place.tips_m + gripper.FINGER_LENGTH_M + gripper.CARRIAGE_HEIGHT_M
    if not inside.any():
        return None
    top = float(high[inside, 2].max())
    return Missed(miss=Miss.HAND, figure=1e3 * top, limit=1e3 * blade_top)


def _distinct(found: list[tuple[_Place, Grasp]], config: GraspConfig) -> list[tuple[_Place, Grasp]]:
    """Of grasps that hardly differ, best first, only the best."""
    kept: list[tuple[_Place, Grasp]] = []
    for place, grasp in found:
        if not any(_alike(place, other, config) for other, _ in kept):
            kept.append((place, grasp))
    return kept


def _alike(one: _Place, other: _Place, config: GraspConfig) -> bool:
    near = abs(one.b - other.b) < config.distinct_m and abs(one.tips_m - other.tips_m) < config.distinct_m
    return _turn_between(one.yaw, other.yaw) < config.distinct_yaw and near


def _turn_between(yaw: float, other: float) -> float:
    """Angle in rad between two closing directions, which are the same after half a turn."""
    return abs((yaw - other + np.pi / 2) % np.pi - np.pi / 2)


def _varied(found: list[tuple[_Place, Grasp]]) -> list[Grasp]:
    """The best of every sector of closing directions first, then the second best of each, and so on."""
    taken: Counter[int] = Counter()
    ranked: list[tuple[int, float, Grasp]] = []
    for place, grasp in found:
        sector = round(place.yaw / _SECTOR) % round(np.pi / _SECTOR)
        ranked.append((taken[sector], -grasp.quality, grasp))
        taken[sector] += 1
    return [grasp for *_, grasp in sorted(ranked, key=lambda item: item[:2])]


def _grasp(
    part: Part, stable_pose: StablePose, place: _Place, contact: PadContact, com: Array, config: GraspConfig
) -> Grasp:
    axis_a, axis_b = closing_axes(place.yaw)
    R_table_tcp = np.column_stack([axis_a, axis_b, [0.0, 0.0, -1.0]])
    t_table_tcp = contact.a_mid_m * axis_a + place.b * axis_b + [0.0, 0.0, place.tips_m]
    return Grasp(
        part=part.name,
        stable_pose=stable_pose.index,
        T_part_tcp=inverse(stable_pose.T_table_part) @ transform(R_table_tcp, t_table_tcp),
        width_m=contact.width_m,
        opening_m=contact.width_m + 2 * config.clearance_at(contact.width_m),
        quality=_quality(contact, float(com @ axis_b), float(com[2])),
        contact=contact,
    )


def _quality(contact: PadContact, com_b: float, com_z: float) -> float:
    """Product of shares in (0, 1]: self-alignment, contact area, height, closeness to the centre of mass, flatness.

    A face aligns itself with the pad when its length exceeds the width times the pad's friction coefficient.
    """
    aligning = min(1.0, contact.length_m / (gripper.PAD_FRICTION * contact.width_m))
    area = contact.area_m2 / (contact.area_m2 + 1.0e-6)
    height = min(1.0, contact.height_m / 0.8e-3)
    lateral = np.exp(-((abs(contact.b_centre_m - com_b) / 1.5e-3) ** 2))
    vertical = np.exp(-((abs(contact.z_centre_m - com_z) / 3.0e-3) ** 2))
    flat = np.exp(-((contact.flatness_m / 20e-6) ** 2))
    return float(aligning * area * height * lateral * vertical * flat)
