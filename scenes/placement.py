"""Parts as physics leaves them: dropped into the pick area from any orientation, settled, apart from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part, load_part
from cad.resting import nearest_rest
from cad.spatial import Array, apply, inverse, rotation_from_quat_wxyz, transform
from scenes.cell_config import CellConfig
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.workcell import build_board_scene, part_body, set_parts


@dataclass(frozen=True, kw_only=True)
class DropConfig:
    """How parts are dropped and when they count as lying apart; metres, seconds, radians."""

    height_m: float = 0.02
    gap_m: float = 0.006
    timestep_s: float = 0.001
    settle_s: float = 1.5
    still_speed: float = 1e-3
    still_rate: float = 0.05
    leaning_rad: float = np.radians(1.0)
    rounds: int = 60

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} {value} must be positive")


def settle_parts(
    config: CellConfig, part_names: Sequence[str], rng: np.random.Generator, drop: DropConfig | None = None
) -> Array:
    """``T_world_part`` (N, 4, 4) of one part for each name, at rest in the pick area and ``gap_m`` apart.

    Parts that leave the pick area, come to lie on or near another one, or lean are dropped again. Raises SceneError
    when they do not fit after ``rounds`` rounds.
    """
    drop = drop or DropConfig()
    parts = [load_part(name, config.parts_dir) for name in part_names]
    spec = build_board_scene(config, part_names)
    spec.option.timestep = drop.timestep_s
    model = spec.compile()
    data = mujoco.MjData(model)
    T_board_part = np.tile(np.eye(4), (len(parts), 1, 1))
    again = np.ones(len(parts), bool)
    for _ in range(drop.rounds):
        spots = _spots(config, parts, T_board_part, again, rng, drop)
        for i in np.flatnonzero(again).tolist():
            T_board_part[i] = _tumbled(parts[i], spots[i], rng, drop.height_m)
        set_parts(model, data, config.T_world_board @ T_board_part)
        still = _settle(model, data, len(parts), drop)
        T_board_part = inverse(config.T_world_board) @ _poses(model, data, len(parts))
        again = ~still | _misplaced(config, parts, T_board_part, drop)
        if not again.any():
            return config.T_world_board @ T_board_part
    half = 1e3 * np.array(config.pick_area_half_m)
    raise SceneError(
        f"{len(parts)} parts do not settle {1e3 * drop.gap_m:.0f} mm apart in a pick area of {2 * half[0]:.0f} x "
        f"{2 * half[1]:.0f} mm; drop fewer parts or enlarge pick_area_half_m"
    )


def _spots(
    config: CellConfig,
    parts: Sequence[Part],
    T_board_part: Array,
    again: NDArray[np.bool_],
    rng: np.random.Generator,
    drop: DropConfig,
) -> Array:
    """Where to drop (N, 2) on the board: far enough from the parts that lie and from each other."""
    spots = T_board_part[:, :2, 3].copy()
    taken = [i for i in range(len(parts)) if not again[i]]
    for i in np.flatnonzero(again).tolist():
        half = np.array(config.pick_area_half_m) - parts[i].radius_m
        for _ in range(1000):
            spot = rng.uniform(-half, half)
            if all(
                np.linalg.norm(spot - spots[j]) >= parts[i].radius_m + parts[j].radius_m + drop.gap_m for j in taken
            ):
                break
        else:
            raise SceneError(
                f"no room for {len(parts)} parts in a pick area of {2e3 * config.pick_area_half_m[0]:.0f} x "
                f"{2e3 * config.pick_area_half_m[1]:.0f} mm; drop fewer parts or enlarge pick_area_half_m"
            )
        spots[i] = spot
        taken.append(i)
    return spots


def _tumbled(part: Part, spot: Array, rng: np.random.Generator, height_m: float) -> Array:
    """The part's centre above ``spot`` (2,), its orientation uniform over all rotations."""
    quat_wxyz = rng.normal(size=4)
    R = rotation_from_quat_wxyz(quat_wxyz / np.linalg.norm(quat_wxyz))
    return transform(R, [*spot, height_m] - R @ part.mesh.bounds.mean(axis=0))


def _settle(model: mujoco.MjModel, data: mujoco.MjData, count: int, drop: DropConfig) -> NDArray[np.bool_]:
    """Step until every part is at rest or the time is up; returns which are (N,)."""
    dofs = [model.joint(part_body(i)).dofadr[0] for i in range(count)]
    still = np.zeros(count, bool)
    steps = round(0.05 / drop.timestep_s)
    for _ in range(round(drop.settle_s / drop.timestep_s / steps)):
        mujoco.mj_step(model, data, steps)
        speed = np.array([data.qvel[d : d + 6] for d in dofs])
        slow = (np.linalg.norm(speed[:, :3], axis=1) < drop.still_speed) & (
            np.linalg.norm(speed[:, 3:], axis=1) < drop.still_rate
        )
        if (slow & still).all():
            break
        still = slow
    return still


def _misplaced(config: CellConfig, parts: Sequence[Part], T_board_part: Array, drop: DropConfig) -> NDArray[np.bool_]:
    """Which parts (N,) lie outside the pick area, too near another one, or in no stable pose."""
    centres = np.array([apply(T, p.mesh.bounds.mean(axis=0)) for T, p in zip(T_board_part, parts, strict=True)])
    wrong: NDArray[np.bool_] = np.any(np.abs(centres[:, :2]) > config.pick_area_half_m, axis=1)
    for i, part in enumerate(parts):
        if part.stable_poses:
            wrong[i] |= nearest_rest(part, T_board_part[i, :3, :3])[1] > drop.leaning_rad
        for j in range(i):
            apart = np.linalg.norm(centres[i, :2] - centres[j, :2]) - part.radius_m - parts[j].radius_m
            wrong[i] |= apart < drop.gap_m
    return wrong


def _poses(model: mujoco.MjModel, data: mujoco.MjData, count: int) -> Array:
    mujoco.mj_kinematics(model, data)
    bodies = [model.body(part_body(i)).id for i in range(count)]
    return np.array([transform(data.xmat[b].reshape(3, 3), data.xpos[b]) for b in bodies])
