"""How a part comes to rest on a plane: which faces, how often, at what height.

The candidates are the faces of the convex hull that hold the centre of mass. How often each occurs comes from dropping
the part in physics: quasi-static estimates favour sides and ends too much. The orientation is the hull's where physics
settles next to it (contacts give way by micrometres), else where physics settles. A face that physics does not settle
on is left out; one that it finds by itself is added.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from cad.collision import contact_pieces
from cad.equivalence import Symmetries, axis_to_json
from cad.parts import Part, StablePose, ViewEquivalent
from cad.spatial import Array
from scenes.drops import DropsConfig, drop_part
from scenes.errors import SceneError
from scenes.resting_faces import RestingFace, nearest_faces, ways_to_rest

UPRIGHT = 0.35
"""Below this horizontal length of the part's unit x axis, y sets the canonical yaw instead."""
UNASSIGNED = -1
_SAME_NUMBER_RAD = np.radians(5.0)


@dataclass(frozen=True, kw_only=True)
class StablePoseConfig(DropsConfig):
    """How to drop, and what counts as a pose. Angles in rad.

    A face is kept when at least ``min_probability`` of the drops end on it; rarer ones are, too, until less than
    ``max_unassigned`` of the drops are in none.
    """

    min_probability: float = 0.005
    max_unassigned: float = 0.005
    same_face_rad: float = np.radians(2.0)
    exact_face_rad: float = np.radians(0.3)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("min_probability", "max_unassigned"):
            if not 0 <= getattr(self, name) < 1:
                raise SceneError(f"{name} {getattr(self, name)}: it must be in 0 to 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class StablePoseResult:
    """The poses and how well they explain the drops. Tuples hold one entry for each pose.

    ``quasi_static`` are the probabilities by toppling without momentum; ``hull_deg`` the angle between the hull's face
    and where physics settles (not a number for a pose that is on no face of the hull); ``spread_deg`` the largest angle
    of a drop from its pose. ``unassigned`` is the share of the settled drops that ended in none of the poses,
    ``unsettled`` the share of all ``drops`` that still moved in the end. ``total_variation`` is half the sum of the
    differences between the two sources' probabilities. ``settled_up`` (N, 3) is the table's normal in the part's frame
    for every settled drop and ``owner`` (N,) its pose, -1 for none.
    """

    poses: tuple[StablePose, ...]
    quasi_static: tuple[float, ...]
    hull_deg: tuple[float, ...]
    spread_deg: tuple[float, ...]
    drops: int
    unassigned: float
    unsettled: float
    total_variation: float
    mesh_hash: str
    settled_up: Array
    owner: NDArray[np.int64]


def find_stable_poses(
    part: Part, config: StablePoseConfig | None = None, progress: Callable[[float], None] = lambda done: None
) -> StablePoseResult:
    """The stable poses of a part with probabilities from drops, most probable first.

    A part that has stable poses already keeps their numbers, for grasps and weights go by them. ``progress`` is told
    the share of drops that are over. Raises SceneError when no drop comes to rest in a pose that occurs often enough.
    """
    config = config or StablePoseConfig()
    drops = drop_part(part, contact_pieces(part, "rest"), config, progress)
    ups = drops.R_table_part[drops.still, 2]
    faces = ways_to_rest(part.mesh, part.symmetries, config.same_face_rad)
    owner = _owners(ups, faces, part.symmetries, config.same_face_rad)
    counts = np.bincount(owner, minlength=len(faces))
    kept = _kept(counts, len(ups), config)
    if not kept:
        raise SceneError(
            f"part {part.name!r}: of {config.drops} drops {len(ups)} came to rest, in no pose more often than "
            f"{config.min_probability}; drop it for longer or lower min_probability"
        )
    heights = drops.height_m[drops.still]
    found = [_settled(part, faces[k], ups[owner == k], heights[owner == k], counts[k] / len(ups), config) for k in kept]
    order = _numbers_kept(part, [pose for pose, _, _ in found])
    kept, found = [kept[i] for i in order], [found[i] for i in order]
    number = np.full(len(faces), UNASSIGNED)
    number[kept] = np.arange(len(kept))
    quasi_static = np.array([faces[k].probability for k in kept])
    shares = counts[kept] / len(ups)
    rest = abs(quasi_static.sum() - shares.sum())
    return StablePoseResult(
        poses=tuple(replace(pose, index=i, view_class=i) for i, (pose, _, _) in enumerate(found)),
        quasi_static=tuple(quasi_static.tolist()),
        hull_deg=tuple(hull_deg for _, hull_deg, _ in found),
        spread_deg=tuple(spread_deg for _, _, spread_deg in found),
        drops=config.drops,
        unassigned=float(len(ups) - counts[kept].sum()) / len(ups),
        unsettled=1.0 - len(ups) / config.drops,
        total_variation=float(np.abs(quasi_static - shares).sum() + rest) / 2,
        mesh_hash=part.mesh_hash,
        settled_up=ups,
        owner=number[owner],
    )


def canonical_rotation(up: Array) -> Array:
    """``R_table_part`` (3, 3) with the table's normal along ``up`` (3,) in the part's frame and yaw 0.

    At yaw 0 the part's x axis points along the table's x seen from above, its y axis where x is near the vertical.
    """
    flat_x = np.eye(3)[0] - up[0] * up
    flat = flat_x if np.linalg.norm(flat_x) > UPRIGHT else np.eye(3)[1] - up[1] * up
    x = _unit(flat)
    return np.array([x, np.cross(up, x), up])


def write_stable_poses(
    folder: Path, result: StablePoseResult, equivalents: Sequence[Sequence[ViewEquivalent]] | None = None
) -> None:
    """Write ``stable_poses.json`` of a part's folder; ``equivalents`` hold for each pose the views like it."""
    classes = _view_classes(equivalents) if equivalents is not None else range(len(result.poses))
    poses: list[dict[str, Any]] = []
    for i, pose in enumerate(result.poses):
        entry: dict[str, Any] = {
            "R_table_part": (pose.R_table_part.round(9) + 0.0).tolist(),
            "t_table_part_m": (pose.t_table_part.round(9) + 0.0).tolist(),
            "probability": round(pose.probability, 6),
            "quasi_static": round(result.quasi_static[i], 6),
            "hull_deg": round(result.hull_deg[i], 4) if np.isfinite(result.hull_deg[i]) else None,
            "view_class": classes[i],
        }
        if pose.roll is not None:
            entry["roll"] = axis_to_json(pose.roll)
        if equivalents is not None:
            entry["view_equivalents"] = [
                {
                    "stable_pose": e.stable_pose,
                    "yaw_rad": round(e.yaw, 6),
                    "shift_m": [round(s, 9) for s in e.shift_m],
                }
                for e in equivalents[i]
            ]
        poses.append(entry)
    document = {
        "made_for": result.mesh_hash,
        "drops": result.drops,
        "unsettled": round(result.unsettled, 6),
        "unassigned": round(result.unassigned, 6),
        "total_variation": round(result.total_variation, 6),
        "stable_poses": poses,
    }
    (folder / "stable_poses.json").write_text(json.dumps(document, indent=1) + "\n")


def _owners(ups: Array, faces: list[RestingFace], symmetries: Symmetries, same_rad: float) -> NDArray[np.int64]:
    """Index of the face each of ``ups`` (N, 3) rests on; faces that physics adds are appended to ``faces``."""
    owner, angle = nearest_faces(ups, faces, symmetries)
    while (away := np.flatnonzero(angle > same_rad)).size:
        new = RestingFace(up=ups[away[0]], on_hull=False)
        near = new.angles(ups[away], symmetries)
        owner[away[near <= same_rad]], angle[away[near <= same_rad]] = len(faces), 0.0
        faces.append(new)
    return owner


def _kept(counts: NDArray[np.int64], settled: int, config: StablePoseConfig) -> list[int]:
    """Indices of the faces that become poses, most frequent first."""
    kept: list[int] = []
    for k in np.argsort(-counts, kind="stable").tolist():
        unassigned = settled - counts[kept].sum()
        often = counts[k] >= max(1, config.min_probability * config.drops)
        if not often and (unassigned < max(1, config.max_unassigned * settled) or counts[k] < 2):
            break
        kept.append(k)
    return kept


def _settled(
    part: Part, face: RestingFace, ups: Array, heights: Array, share: float, config: StablePoseConfig
) -> tuple[StablePose, float, float]:
    """A pose, the angle in degrees between face and physics, and the largest of a drop from the pose."""
    rests = face.rests(part.symmetries)
    near = np.array([rests.nearest_direction(face.up, up) for up in ups])
    settled = _unit(np.median(near, axis=0))
    apart = float(face.angles(settled[None], part.symmetries)[0])
    exact = face.on_hull and apart <= config.exact_face_rad
    up = face.up if exact else settled
    height = 0.0 - float((part.mesh.vertices @ up).min()) if exact else float(np.median(heights))
    pose = _stable_pose(part.mesh, replace(face, up=up), height, float(share))
    spread = float(replace(face, up=up).angles(ups, part.symmetries).max())
    return pose, float(np.degrees(apart)) if face.on_hull else float("nan"), float(np.degrees(spread))


def _stable_pose(mesh: trimesh.Trimesh, face: RestingFace, height: float, probability: float) -> StablePose:
    R = canonical_rotation(face.up)
    seen = mesh.vertices @ R[:2].T
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    return StablePose(
        index=0,
        R_table_part=R,
        t_table_part=np.array([-centre[0], -centre[1], height]),
        probability=probability,
        view_class=0,
        roll=face.roll,
    )


def _numbers_kept(part: Part, found: Sequence[StablePose]) -> list[int]:
    """The order in which poses that the part has already keep their places; new ones follow."""
    left = list(range(len(found)))
    order: list[int] = []
    for old in part.stable_poses:
        same = [i for i in left if found[i].R_table_part[2] @ old.R_table_part[2] > np.cos(_SAME_NUMBER_RAD)]
        if same:
            order.append(same[0])
            left.remove(same[0])
    return order + left


def _view_classes(equivalents: Sequence[Sequence[ViewEquivalent]]) -> list[int]:
    """A number for each pose, the same for poses that look alike."""
    classes = list(range(len(equivalents)))
    for i, found in enumerate(equivalents):
        for e in found:
            old, new = max(classes[i], classes[e.stable_pose]), min(classes[i], classes[e.stable_pose])
            classes = [new if c == old else c for c in classes]
    numbers = {c: n for n, c in enumerate(dict.fromkeys(classes))}
    return [numbers[c] for c in classes]


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)
