"""Parts dropped one at a time onto a table, thousands of them, until they lie still.

Each falls from a uniformly random orientation without spin. The fall itself is not simulated: a drop begins as the part
is about to touch the table, at the speed it has then. Drops are stepped side by side (``mujoco.rollout``); those that
lie still for a whole stage are taken out, so that the few that roll on do not cost the time of all.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cad.parts import Part
from cad.spatial import Array, quat_wxyz_from_rotation, rotation_from_quat_wxyz
from scenes.contacts import PART, Touches, make_collision, set_options
from scenes.errors import SceneError
from scenes.free_part import add_piece, set_mass_properties
from scenes.gl import mujoco, rollout

_CLEARANCE_M = 5e-5
_GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class DropsConfig:
    """How to drop, and when a part lies still.

    A drop is over when, in a stage of ``stage_s``, the part kept within ``rocking_m`` and ``rocking_rad`` and its mean
    place moved by less than ``drift_m`` and ``drift_rad`` from one half of the stage to the other; or after
    ``duration_s``. Speeds would not do: on a face of many corners contacts come and go, and a part trembles to and fro
    at 0.1 rad/s by hundredths of a degree, while one that starts to tip over an edge turns at a tenth of that speed.
    """

    drops: int = 2000
    seed: int = 0
    height_m: float = 0.02
    duration_s: float = 2.0
    stage_s: float = 0.05
    timestep_s: float = 1e-3
    rocking_m: float = 1e-5
    rocking_rad: float = 1e-3
    drift_m: float = 2e-6
    drift_rad: float = 2e-4
    threads: int = os.cpu_count() or 1

    def __post_init__(self) -> None:
        if self.drops < 1 or self.threads < 1:
            raise SceneError(f"drops {self.drops}, threads {self.threads}: both must be at least 1")
        if self.seed < 0:
            raise SceneError(f"seed {self.seed}: it must not be negative")
        for name in ("height_m", "timestep_s", "rocking_m", "rocking_rad", "drift_m", "drift_rad"):
            if not getattr(self, name) > 0:
                raise SceneError(f"{name} {getattr(self, name)}: it must be positive")
        if not 2 * self.timestep_s <= self.stage_s <= self.duration_s:
            raise SceneError(
                f"timestep {self.timestep_s} s, stage {self.stage_s} s, duration {self.duration_s} s: a stage must be "
                "at least two steps long, a drop at least one stage"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Drops:
    """Where N dropped parts ended: ``R_table_part`` (N, 3, 3), ``height_m`` of the part's origin above the table (N,),
    which lie ``still`` (N,), and ``seconds`` (N,) from touching the table until the end.
    """

    R_table_part: Array
    height_m: Array
    still: NDArray[np.bool_]
    seconds: Array


def drop_part(
    part: Part,
    pieces: Sequence[trimesh.Trimesh],
    config: DropsConfig | None = None,
    progress: Callable[[float], None] = lambda done: None,
    R_start: Array | None = None,
) -> Drops:
    """Drop ``part``, whose convex ``pieces`` touch the table, ``config.drops`` times.

    ``R_start`` (N, 3, 3) are the orientations ``R_table_part`` to fall in; they are drawn from the seed where it is
    left out. ``progress`` is told the share of the drops that are over. The result depends on the seed, not on the
    threads. Raises SceneError for a part without pieces and for another number of orientations than drops.
    """
    config = config or DropsConfig()
    if not pieces:
        raise SceneError(f"part {part.name!r} has no convex pieces to lie on (hulls/ in {part.folder}); add it again")
    R = _any_orientation(config) if R_start is None else R_start
    if R.shape != (config.drops, 3, 3):
        raise SceneError(f"R_start has shape {R.shape}; {config.drops} drops need ({config.drops}, 3, 3)")
    model = _model(part, pieces, config)
    state = _starts(part, model, R, config)
    workers = [mujoco.MjData(model) for _ in range(config.threads)]
    steps = round(config.stage_s / config.timestep_s)
    still = np.zeros(config.drops, dtype=bool)
    seconds = np.zeros(config.drops)
    going = np.arange(config.drops)
    for _ in range(round(config.duration_s / config.stage_s)):
        states = np.asarray(rollout.rollout(model, workers, state[going], nstep=steps)[0])
        state[going] = states[:, -1]
        seconds[going] += steps * config.timestep_s
        still[going] = _is_still(states[:, :, 1:4], states[:, :, 4:8], config)
        going = np.flatnonzero(~still)
        progress(float(still.mean()))
        if not len(going):
            break
    R = rotation_from_quat_wxyz(state[:, 4:8])
    return Drops(R_table_part=R, height_m=state[:, 3], still=still, seconds=seconds)


def _is_still(positions: Array, quats_wxyz: Array, config: DropsConfig) -> NDArray[np.bool_]:
    """Which of N parts lay still, from their positions (N, steps, 3) and quaternions (N, steps, 4) over a stage."""
    rocked_m, drifted_m = _travel(positions)
    rocked, drifted = _travel(2 * quats_wxyz)  # unit quaternions a small angle apart differ by half of it
    return (
        (rocked_m < config.rocking_m)
        & (drifted_m < config.drift_m)
        & (rocked < config.rocking_rad)
        & (drifted < config.drift_rad)
    )


def _travel(values: Array) -> tuple[Array, Array]:
    """Of values (N, steps, D): the largest distance (N,) from the last, and between the means of the two halves."""
    half = values.shape[1] // 2
    largest = np.linalg.norm(values - values[:, -1:], axis=-1).max(axis=1)
    return largest, np.linalg.norm(values[:, half:].mean(axis=1) - values[:, :half].mean(axis=1), axis=-1)


def _any_orientation(config: DropsConfig) -> Array:
    return Rotation.random(config.drops, rng=np.random.default_rng(config.seed)).as_matrix()


def _starts(part: Part, model: mujoco.MjModel, R: Array, config: DropsConfig) -> Array:
    """(N, 14) time, position, quaternion and velocity of parts about to touch the table, turned by ``R`` (N, 3, 3)."""
    lowest = (R[:, 2] @ np.asarray(part.mesh.convex_hull.vertices).T).min(axis=1)
    start = np.zeros((config.drops, 1 + model.nq + model.nv))
    start[:, 3] = _CLEARANCE_M - lowest
    start[:, 4:8] = quat_wxyz_from_rotation(R)
    start[:, 10] = -np.sqrt(2 * _GRAVITY * config.height_m)
    return start


def _model(part: Part, pieces: Sequence[trimesh.Trimesh], config: DropsConfig) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    set_options(spec, config.timestep_s)
    spec.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    table = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE.value, size=[0.1, 0.1, 0.01])
    make_collision(table, Touches.CELL, PART)
    body = spec.worldbody.add_body()
    body.add_freejoint()
    set_mass_properties(body, part.mesh, part.mass_kg)
    for k, piece in enumerate(pieces):
        name = f"piece_{k}"
        add_piece(spec, name, piece)
        make_collision(body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH.value, meshname=name), Touches.PART, PART)
    return spec.compile()
