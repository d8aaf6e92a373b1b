"""Parts dropped onto the board: where and how they come to rest is left to physics, from a seed.

Each part falls on a place of its own. What rolls out of the pick area or comes to rest too close to another part is
dropped again; parts already at rest stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cad.parts import Part, load_part
from cad.spatial import Array, apply, inverse, rotation_from_quat_wxyz, transform
from scenes.cell_config import CellConfig
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.workcell import build_board_scene, part_body, set_parts

PARKED_M = -1.0
"""Height at which a part that waits for its drop is kept, out of everything's way."""


@dataclass(frozen=True, kw_only=True)
class DropConfig:
    """How parts are dropped, in metres and seconds, and when they count as lying still (m/s and rad/s).

    ``gap_m`` is the smallest distance between the circles round any two parts' footprints.
    """

    height_m: float = 0.020
    gap_m: float = 0.006
    timestep_s: float = 0.001
    shortest_s: float = 0.15
    longest_s: float = 1.5
    still_speed: float = 5e-4
    still_rate: float = 0.02
    rounds: int = 60

    def __post_init__(self) -> None:
        if min(self.height_m, self.timestep_s, self.longest_s) <= 0 or self.gap_m < 0 or self.rounds < 1:
            raise SceneError(f"drop height, time step, time and rounds must be positive: {self}")


def settle_parts(
    config: CellConfig, instances: Sequence[str], rng: np.random.Generator, drop: DropConfig | None = None
) -> Array:
    """``T_world_part`` (N, 4, 4) of parts at rest in the pick area, one for each name in ``instances``.

    The same generator state gives the same poses. Raises SceneError when the pick area is too small for the parts.
    """
    drop = drop or DropConfig()
    model = build_board_scene(replace(config, timestep_s=drop.timestep_s), instances).compile()
    model.opt.enableflags &= ~mujoco.mjtEnableBit.mjENBL_SLEEP.value
    data = mujoco.MjData(model)
    parts = [load_part(name, config.parts_dir) for name in instances]
    T_world_part = np.stack([transform(t=[0.1 * i, 0.0, PARKED_M]) for i in range(len(parts))]) if parts else []
    T_world_part = np.reshape(T_world_part, (-1, 4, 4))
    waiting = list(range(len(parts)))
    for _ in range(drop.rounds):
        if not waiting:
            return T_world_part
        _throw(config, drop, parts, T_world_part, waiting, rng)
        set_parts(model, data, T_world_part)
        still = _fall(model, data, drop, len(parts))
        T_world_part = _poses(model, data, len(parts))
        waiting = _badly_placed(config, drop, parts, T_world_part, still)
        for i in waiting:
            T_world_part[i] = transform(t=[0.1 * i, 0.0, PARKED_M])
    raise SceneError(
        f"{len(parts)} parts did not come to rest in the pick area {config.pick_area_half_m} m with gaps of "
        f"{drop.gap_m} m after {drop.rounds} rounds; use fewer parts or a larger pick_area_half_m"
    )


def footprint(part: Part, T_board_part: Array) -> tuple[Array, float]:
    """Centre (2,) in ``board`` of the rectangle round a part seen from above, and its circle's radius."""
    points = apply(T_board_part, part.mesh.vertices)[:, :2]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _throw(
    config: CellConfig,
    drop: DropConfig,
    parts: Sequence[Part],
    T_world_part: Array,
    waiting: Sequence[int],
    rng: np.random.Generator,
) -> None:
    """Hold each waiting part above a free place in the pick area, turned at random; changes ``T_world_part``."""
    T_world_board = config.T_world_board
    lying = [i for i in range(len(parts)) if i not in waiting]
    taken = [footprint(parts[i], inverse(T_world_board) @ T_world_part[i]) for i in lying]
    for i in waiting:
        radius = parts[i].radius_m
        half = np.array(config.pick_area_half_m) - radius
        place = _free_place(half, radius + drop.gap_m, taken, rng)
        if place is None:
            continue
        taken.append((place, radius))
        R = Rotation.random(rng=rng).as_matrix()
        middle = parts[i].mesh.bounds.mean(axis=0)
        t = np.array([*place, drop.height_m + radius]) - R @ middle
        T_world_part[i] = T_world_board @ transform(R, t)


def _free_place(
    half: Array, reach: float, taken: Sequence[tuple[Array, float]], rng: np.random.Generator
) -> Array | None:
    for _ in range(100):
        place = rng.uniform(-half, half)
        if all(np.linalg.norm(place - centre) >= reach + radius for centre, radius in taken):
            return place
    return None


def _fall(model: mujoco.MjModel, data: mujoco.MjData, drop: DropConfig, count: int) -> list[bool]:
    """Step until all parts on the board lie still or the time is up; says of each whether it does."""
    velocities = [
        slice(model.joint(part_body(i)).dofadr[0], model.joint(part_body(i)).dofadr[0] + 6) for i in range(count)
    ]
    still = [False] * count
    for step in range(round(drop.longest_s / drop.timestep_s)):
        mujoco.mj_step(model, data)
        if step * drop.timestep_s < drop.shortest_s or step % 10:
            continue
        speeds = [data.qvel[v : v + 6] for v in first]
        still = [
            bool(np.linalg.norm(v[:3]) < drop.still_speed and np.linalg.norm(v[3:]) < drop.still_rate) for v in speeds
        ]
        if all(ok or data.body(part_body(i)).xpos[2] < PARKED_M / 2 for i, ok in enumerate(still)):
            break
    return still


def _poses(model: mujoco.MjModel, data: mujoco.MjData, count: int) -> Array:
    poses = np.empty((count, 4, 4))
    for i in range(count):
        q = model.joint(part_body(i)).qposadr[0]
        poses[i] = transform(rotation_from_quat_wxyz(data.qpos[q + 3 : q + 7]), data.qpos[q : q + 3])
    return poses


def _badly_placed(
    config: CellConfig, drop: DropConfig, parts: Sequence[Part], T_world_part: Array, still: Sequence[bool]
) -> list[int]:
    """Parts that move, have left the pick area or lie too close to one that comes before them."""
    T_board_world = inverse(config.T_world_board)
    good: list[tuple[Array, float]] = []
    bad = []
    for i, part in enumerate(parts):
        centre, radius = footprint(part, T_board_world @ T_world_part[i])
        inside = bool((np.abs(centre) + 0.5 * radius <= config.pick_area_half_m).all()) and T_world_part[i, 2, 3] > 0
        apart = all(np.linalg.norm(centre - c) >= radius + r + drop.gap_m for c, r in good)
        if still[i] and inside and apart:
            good.append((centre, radius))
        else:
            bad.append(i)
    return bad
