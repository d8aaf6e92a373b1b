"""How a part comes to rest on a plane: which faces, how often, at what height.

The candidates are the faces of the convex hull that hold the centre of mass (trimesh). How often each occurs, and the
exact orientation and height, come from dropping the part in physics: quasi-static estimates favour sides and ends too
much. A face that physics does not settle on is left out; one that it finds by itself is added. The part's convex pieces
touch the plane: one hull would do for the shape, but of its many corners on a large flat face MuJoCo keeps too few and
the part rocks by 0.2 degrees, while the pieces leave every drop at rest.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from mujoco import rollout
from scipy.spatial.transform import Rotation

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose, load_part, part_names
from cad.spatial import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz
from cad.symmetry import find_symmetries
from scenes.contacts import PART, Touches, make_collision, set_options
from scenes.errors import SceneError
from scenes.gl import mujoco

_UPRIGHT = 0.35
"""Below this horizontal length of the part's unit x axis, y sets the canonical yaw instead."""
_BATCH = 100


@dataclass(frozen=True, kw_only=True)
class StablePoseConfig:
    """How to drop, and what counts as a pose. Angles in rad, speeds in m/s and rad/s."""

    drops: int = 2000
    seed: int = 0
    height_m: float = 0.02
    duration_s: float = 1.0
    timestep_s: float = 1e-3
    min_probability: float = 0.005
    same_face_rad: float = np.radians(2.0)
    still_speed: float = 1e-3
    still_rate: float = 0.05
    threads: int = os.cpu_count() or 1

    def __post_init__(self) -> None:
        if self.drops < 1 or self.threads < 1:
            raise ValueError(f"drops {self.drops}, threads {self.threads}: both must be at least 1")
        if not (self.height_m > 0 and self.duration_s > 0 and self.timestep_s > 0):
            raise ValueError(
                f"height {self.height_m} m, duration {self.duration_s} s, timestep {self.timestep_s} s: all positive"
            )
        if not 0 <= self.min_probability < 1:
            raise ValueError(f"min_probability {self.min_probability}: it must be in 0 to 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Drops:
    """Where dropped parts came to rest: rotations (N, 3, 3), heights of the origin (N,), and which are still (N,)."""

    R_table_part: Array
    height_m: Array
    still: Array


@dataclass(frozen=True, kw_only=True)
class StablePoseResult:
    """The poses, most probable first, and how well they explain the drops.

    ``unassigned`` is the share of drops that ended in none of the poses; ``refined_deg`` is, for each pose, the angle
    between the flat face of the hull and where physics settles; ``spread_deg`` the largest angle of a drop from its
    pose.
    """

    poses: tuple[StablePose, ...]
    unassigned: float
    refined_deg: tuple[float, ...]
    spread_deg: tuple[float, ...]


def find_stable_poses(part: Part, config: StablePoseConfig | None = None) -> StablePoseResult:
    """The stable poses of a part with probabilities from drops.

    Raises SceneError when no drop comes to rest in a pose that occurs often enough.
    """
    config = config or StablePoseConfig()
    symmetries = find_symmetries(part.mesh)
    drops = drop(part, config)
    ups = drops.R_table_part[:, 2]  # the table's normal in the part's frame
    faces = _distinct(resting_faces(part.mesh), symmetries, config.same_face_rad)
    owner = _assign(ups, drops.still, faces, symmetries, config.same_face_rad)
    found = []
    for k, face in enumerate(faces):
        mine = owner == k
        if mine.mean() < max(config.min_probability, 1 / config.drops):
            continue
        settled = np.array([closest_equivalent(up, face, symmetries) for up in ups[mine]])
        up = _unit(np.median(settled, axis=0))
        spread = max(_angle(up, s) for s in settled)
        found.append((float(mine.mean()), up, float(np.median(drops.height_m[mine])), _angle(up, face), spread))
    if not found:
        raise SceneError(
            f"part {part.name!r} came to rest in no pose more often than {config.min_probability}: "
            "drop it for longer or lower min_probability"
        )
    found.sort(key=lambda item: -item[0])
    poses = tuple(_stable_pose(i, part.mesh, up, height, p) for i, (p, up, height, _, _) in enumerate(found))
    return StablePoseResult(
        poses=poses,
        unassigned=1.0 - sum(p for p, *_ in found),
        refined_deg=tuple(float(np.degrees(item[3])) for item in found),
        spread_deg=tuple(float(np.degrees(item[4])) for item in found),
    )


def resting_faces(mesh: trimesh.Trimesh) -> Array:
    """(F, 3) upward directions in the part's frame for which the centre of mass stands over a face of the hull."""
    scale = 1.0 / float(np.ptp(mesh.bounds, axis=0).max())  # the tolerances inside are absolute
    unit = trimesh.Trimesh(scale * (mesh.vertices - mesh.center_mass), mesh.faces, process=False)
    transforms, _ = trimesh.poses.compute_stable_poses(unit, center_mass=np.zeros(3), seed=0)
    return np.array([T[2, :3] for T in transforms])


def canonical_rotation(up: Array) -> Array:
    """``R_table_part`` (3, 3) with the table's normal along ``up`` (3,) in the part's frame and yaw 0.

    At yaw 0 the part's x axis points along the table's x seen from above, its y axis where x is near the vertical.
    """
    flat_x = np.eye(3)[0] - up[0] * up
    flat = flat_x if np.linalg.norm(flat_x) > _UPRIGHT else np.eye(3)[1] - up[1] * up
    x = _unit(flat)
    return np.array([x, np.cross(up, x), up])


def closest_equivalent(up: Array, target: Array, symmetries: Symmetries) -> Array:
    """Of all directions (3,) that a symmetry of the part makes of ``up``, the one nearest to ``target``."""
    options = [up, *(T[:3, :3] @ up for T in symmetries.discrete)]
    for axis in (a.direction for a in symmetries.continuous):
        across = target - (target @ axis) * axis
        if np.linalg.norm(across) > 1e-9:
            along = [float(u @ axis) for u in options]
            options += [a * axis + np.sqrt(max(0.0, 1 - a * a)) * _unit(across) for a in along]
    return min(options, key=lambda u: _angle(u, target))


def drop(part: Part, config: StablePoseConfig) -> Drops:
    """Drop the part ``config.drops`` times from uniformly random orientations, each for the whole duration."""
    model = _drop_model(part, config)
    rng = np.random.default_rng(config.seed)
    R = Rotation.random(config.drops, rng=rng).as_matrix()
    corners = np.asarray(part.mesh.convex_hull.vertices)
    lowest = (R[:, 2] @ corners.T).min(axis=1)
    start = np.zeros((config.drops, 1 + model.nq + model.nv))
    start[:, 3] = config.height_m - lowest
    start[:, 4:8] = quat_wxyz_from_rotation(R)
    workers = [mujoco.MjData(model) for _ in range(config.threads)]
    steps = round(config.duration_s / config.timestep_s)
    end = np.empty_like(start)
    for i in range(0, config.drops, _BATCH):
        states, _ = rollout.rollout(model, workers, start[i : i + _BATCH], nstep=steps)
        end[i : i + _BATCH] = np.asarray(states)[:, -1]
    velocity = end[:, 8:14]
    still = np.linalg.norm(velocity[:, :3], axis=1) < config.still_speed
    still &= np.linalg.norm(velocity[:, 3:], axis=1) < config.still_rate
    return Drops(R_table_part=rotation_from_quat_wxyz(end[:, 4:8]), height_m=end[:, 3], still=still)


def write_stable_poses(folder: Path, result: StablePoseResult) -> None:
    """Write ``stable_poses.json`` of a part's folder."""
    poses: list[dict[str, Any]] = [
        {
            "R_table_part": pose.R_table_part.round(9).tolist(),
            "t_table_part_m": pose.t_table_part.round(9).tolist(),
            "probability": round(pose.probability, 6),
            "view_class": pose.view_class,
        }
        for pose in result.poses
    ]
    document = {"unassigned": round(result.unassigned, 6), "stable_poses": poses}
    (folder / "stable_poses.json").write_text(json.dumps(document, indent=1) + "\n")


def _drop_model(part: Part, config: StablePoseConfig) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    set_options(spec, config.timestep_s)
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    table = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE.value, size=[0.1, 0.1, 0.01])
    make_collision(table, Touches.CELL, PART)
    body = spec.worldbody.add_body()
    body.add_freejoint()
    solid = part.mesh.copy()
    solid.density = part.mass_kg / solid.volume
    body.explicitinertial = True
    body.mass = part.mass_kg
    body.ipos = solid.center_mass
    body.fullinertia = solid.moment_inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    for k, hull in enumerate(part.hulls):
        mesh = spec.add_mesh(name=f"hull_{k}")
        mesh.uservert = np.asarray(hull.vertices, np.float32).ravel()
        mesh.userface = np.asarray(hull.faces, np.int32).ravel()
        make_collision(body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH.value, meshname=mesh.name), Touches.PART, PART)
    return spec.compile()


def _stable_pose(index: int, mesh: trimesh.Trimesh, up: Array, height: float, probability: float) -> StablePose:
    R = canonical_rotation(up)
    seen = mesh.vertices @ R[:2].T
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    return StablePose(
        index=index,
        R_table_part=R,
        t_table_part=np.array([-centre[0], -centre[1], height]),
        probability=probability,
        view_class=index,
    )


def _distinct(faces: Array, symmetries: Symmetries, same_rad: float) -> list[Array]:
    kept: list[Array] = []
    for face in faces:
        if all(_angle(closest_equivalent(face, other, symmetries), other) > same_rad for other in kept):
            kept.append(face)
    return kept


def _assign(ups: Array, still: Array, faces: list[Array], symmetries: Symmetries, same_rad: float) -> Array:
    """Index of the face each drop rests on, -1 for none; faces that physics adds are appended to ``faces``."""
    owner = np.full(len(ups), -1)
    for i in np.flatnonzero(still):
        angles = [_angle(closest_equivalent(ups[i], face, symmetries), face) for face in faces]
        if not angles or min(angles) > same_rad:
            faces.append(ups[i])
            owner[i] = len(faces) - 1
        else:
            owner[i] = int(np.argmin(angles))
    return owner


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def main() -> None:
    """Compute and write the stable poses of the parts named on the command line (default: all)."""
    for name in sys.argv[1:] or part_names():
        part = load_part(name)
        result = find_stable_poses(part)
        write_stable_poses(part.folder, result)
        shares = ", ".join(f"{pose.probability:.3f}" for pose in result.poses)
        print(f"{name}: {len(result.poses)} poses, {shares}; unassigned {result.unassigned:.4f}")


if __name__ == "__main__":
    main()
