"""Grasps of a part: found from its mesh for each stable pose, ranked, and stored in ``grasps.json``."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cad import gripper
from cad.parts import Part, StablePose, hash_file
from cad.spatial import Array, inverse, transform
from twin.grasp_geometry import (
    ContactRules,
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
from twin.robot import TwinError


class GraspError(TwinError):
    """A part or stable pose that cannot be gripped, or a grasp file that does not fit its part."""


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """How grasps are searched and cleared, in metres and radians."""

    yaw_step: float = np.deg2rad(5.0)
    lateral_step_m: float = 0.5e-3
    lateral_reach_m: float = 4.0e-3
    distinct_m: float = 0.9e-3
    tip_clearance_m: float = 0.15e-3
    sample_spacing_m: float = 0.08e-3
    clearance_m: float = 3.0e-3
    min_clearance_m: float = 1.5e-3
    neighbour_margin_m: float = 0.5e-3
    keep: int = 24
    rules: ContactRules = field(default_factory=ContactRules)

    def __post_init__(self) -> None:
        if not 0 < self.min_clearance_m <= self.clearance_m:
            raise ValueError(
                f"opening clearances {self.min_clearance_m} .. {self.clearance_m} m a side must be positive and ordered"
            )
        if not 0 < self.tip_clearance_m < gripper.PAD_HEIGHT_M:
            raise ValueError(
                f"tip clearance {self.tip_clearance_m} m must lie between 0 and the pad height {gripper.PAD_HEIGHT_M} m"
            )

    @property
    def strip(self) -> PadStrip:
        """Where the pads can touch a part on the table."""
        return PadStrip(
            half_width_m=gripper.PAD_WIDTH_M / 2,
            z_low_m=self.tip_clearance_m,
            z_high_m=self.tip_clearance_m + gripper.PAD_HEIGHT_M,
        )


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One way to take hold of a part that lies in one of its stable poses.

    ``T_part_tcp`` (4, 4) is where the tool is when the pads have closed, ``width_m`` the opening then, ``opening_m``
    the opening to come down with, ``quality`` in (0, 1], best first.
    """

    part: str
    stable_pose: int
    T_part_tcp: Array
    width_m: float
    opening_m: float
    quality: float
    contact: PadContact

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for ``grasps.json``."""
        return {
            "stable_pose": self.stable_pose,
            "T_part_tcp": self.T_part_tcp.round(9).tolist(),
            "width_m": round(self.width_m, 7),
            "opening_m": round(self.opening_m, 7),
            "quality": round(self.quality, 4),
            "contact": {k: float(f"{v:.4g}") for k, v in asdict(self.contact).items()},
        }


@dataclass(frozen=True, kw_only=True)
class GraspSearch:
    """Grasps of one stable pose, best first, and how many candidates each reason rejected."""

    grasps: tuple[Grasp, ...]
    rejections: dict[str, int]


def find_grasps(part: Part, stable_pose: StablePose, config: GraspConfig | None = None) -> GraspSearch:
    """Every parallel-jaw grasp of ``part`` in ``stable_pose`` over yaw and offset along the pads, ranked."""
    config = config or GraspConfig()
    local = sample_surface(part.mesh, config.sample_spacing_m)
    R, t = stable_pose.R_table_part, stable_pose.t_table_part
    samples = SurfaceSamples(points=local.points @ R.T + t, normals=local.normals @ R.T, area_m2=local.area_m2)
    com = R @ part.mesh.center_mass + t
    base = support_points(part.mesh, stable_pose.T_table_part)
    rejections: Counter[str] = Counter()
    found: list[tuple[float, float, Grasp]] = []
    for yaw in np.arange(0.0, np.pi - 1e-9, config.yaw_step):
        view = view_along(samples, yaw, config.strip)
        for b in _lateral_offsets(com, yaw, config):
            contact = pad_contact(view, b, config.strip, config.rules)
            reason = contact if isinstance(contact, str) else _unfit(contact, yaw, base, com, config)
            if reason:
                rejections[reason] += 1
                continue
            assert isinstance(contact, PadContact)
            found.append((float(yaw), float(b), _grasp(part, stable_pose, yaw, b, contact, com, config)))
    found.sort(key=lambda item: -item[2].quality)
    return GraspSearch(grasps=tuple(_distinct(found, config)[: config.keep]), rejections=dict(rejections))


def _distinct(found: list[tuple[float, float, Grasp]], config: GraspConfig) -> list[Grasp]:
    """The best grasp of every yaw, and others of that yaw at least ``distinct_m`` away along the pads."""
    kept: list[tuple[float, float, Grasp]] = []
    for yaw, b, grasp in found:
        if all(yaw != other or abs(b - there) >= config.distinct_m for other, there, _ in kept):
            kept.append((yaw, b, grasp))
    return [grasp for _, _, grasp in kept]


def _lateral_offsets(com: Array, yaw: float, config: GraspConfig) -> Array:
    """Offsets along the pads to try: the centre of mass and steps to either side."""
    steps = int(config.lateral_reach_m / config.lateral_step_m)
    return com @ closing_axes(yaw)[1] + config.lateral_step_m * np.arange(-steps, steps + 1)


def _unfit(contact: PadContact, yaw: float, base: Array, com: Array, config: GraspConfig) -> str | None:
    if contact.width_m + 2 * config.clearance_m > gripper.STROKE_M:
        return "wider than the gripper opens"
    if topples(contact, yaw, base, com, config.rules.friction_table):
        return "would tip over when pushed"
    return None


def _grasp(
    part: Part, stable_pose: StablePose, yaw: float, b: float, contact: PadContact, com: Array, config: GraspConfig
) -> Grasp:
    axis_a, axis_b = closing_axes(yaw)
    R_table_tcp = np.column_stack([axis_a, axis_b, [0.0, 0.0, -1.0]])
    t_table_tcp = contact.a_mid_m * axis_a + b * axis_b + [0.0, 0.0, config.tip_clearance_m]
    return Grasp(
        part=part.name,
        stable_pose=stable_pose.index,
        T_part_tcp=inverse(stable_pose.T_table_part) @ transform(R_table_tcp, t_table_tcp),
        width_m=contact.width_m,
        opening_m=contact.width_m + 2 * config.clearance_m,
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


def write_grasps(part: Part, config: GraspConfig | None = None) -> Path:
    """Search every stable pose of ``part`` and write ``grasps.json`` into its folder.

    Raises GraspError naming the stable poses that cannot be gripped and why.
    """
    searches = [find_grasps(part, pose, config) for pose in part.stable_poses]
    failed = {i: s.rejections for i, s in enumerate(searches) if not s.grasps}
    path = part.folder / "grasps.json"
    content = {"made_for": _made_for(part), "grasps": [g.as_json() for s in searches for g in s.grasps]}
    path.write_text(json.dumps(content) + "\n")
    read_grasps.cache_clear()
    if failed:
        raise GraspError(f"part {part.name!r} cannot be gripped in stable poses {failed}; other grasps are in {path}")
    return path


def _made_for(part: Part) -> dict[str, str]:
    """Hashes of what grasps depend on."""
    return {"mesh": part.mesh_hash, "stable_poses": hash_file(part.folder / "stable_poses.json")}


@lru_cache(maxsize=64)
def read_grasps(part: Part) -> tuple[tuple[Grasp, ...], ...]:
    """Grasps of ``part`` by stable pose, best first, from its folder.

    Raises GraspError when there are none or they were made for another mesh or other stable poses.
    """
    path = part.folder / "grasps.json"
    if not path.exists():
        raise GraspError(f"part {part.name!r} has no grasps.json in {part.folder}; write_grasps makes it")
    made_for = json.loads(path.read_text()).get("made_for")
    if made_for != _made_for(part):
        raise GraspError(
            f"{path} was made for {made_for}, the part's files are {_made_for(part)}; write_grasps makes it anew"
        )
    by_pose: list[list[Grasp]] = [[] for _ in part.stable_poses]
    for entry in part.grasps:
        by_pose[entry["stable_pose"]].append(
            Grasp(
                part=part.name,
                stable_pose=entry["stable_pose"],
                T_part_tcp=np.array(entry["T_part_tcp"]),
                width_m=entry["width_m"],
                opening_m=entry["opening_m"],
                quality=entry["quality"],
                contact=PadContact(**entry["contact"]),
            )
        )
    return tuple(tuple(grasps) for grasps in by_pose)
