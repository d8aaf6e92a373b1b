"""How parts lie when physics has left them: a pool of rests of each part, from drops, to place anywhere on the board.

A rest is ``T_table_part`` with the tilt and the height that contact forces gave it, but with x, y and yaw taken out:
the bounding rectangle seen from above is centred at the table's origin. The board is a plane, the same everywhere and
in every direction, so a rest moved about in the plane is another one:
``T_board_part = planar(x, y, yaw) @ T_table_part``.

How often a part lies on which face is what ``stable_poses.json`` says, the outcome of thousands of the same drops; how
it lies on that face is drawn from the pool. A face that few of the pool's drops end on is filled up by letting the part
fall on it from just above, a little tilted.
"""

from __future__ import annotations

import hashlib
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cad.collision import contact_pieces
from cad.equivalence import Symmetries
from cad.parts import Part, StablePose
from cad.resting import as_rest, nearest_rest
from cad.spatial import Array, angle_between, apply, rotation_from_rotvec, rotation_z, transform, yaw_of
from scenes.drops import Drops, DropsConfig, drop_part
from scenes.errors import SceneError

Faces = Literal["physics", "uniform"]
"""Parts lie on each face as often as physics leaves them there, or equally often on all of them."""
FILE = "rests.npz"
_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class RestConfig:
    """How the pool is made: ``drops`` of each part, then more until every face has ``each`` rests.

    A drop that ends farther than ``leaning_rad`` from every stable pose is rejected. Parts that are to end on a certain
    face fall on it by ``near_height_m``, tilted by up to ``near_rad``, at most ``rounds`` times ``each``.
    """

    drops: int = 96
    each: int = 12
    seed: int = 0
    leaning_rad: float = np.radians(1.0)
    near_rad: float = np.radians(1.5)
    near_height_m: float = 3e-4
    rounds: int = 4

    def __post_init__(self) -> None:
        for name in ("drops", "each", "rounds"):
            if getattr(self, name) < 1:
                raise SceneError(f"{name} {getattr(self, name)}: must be at least 1")
        if self.seed < 0:
            raise SceneError(f"seed {self.seed}: must not be negative")
        for name in ("leaning_rad", "near_rad", "near_height_m"):
            if not getattr(self, name) > 0:
                raise SceneError(f"{name} {getattr(self, name)}: must be positive")


@dataclass(frozen=True, kw_only=True, eq=False)
class Rest:
    """One way that physics left a part: in a stable pose, at ``T_table_part`` (4, 4) in normal form.

    ``radius_m`` is that of the circle round the table's origin that holds the part's footprint.
    """

    stable_pose: int
    T_table_part: Array
    radius_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PartRests:
    """The rests of one part: ``T_table_part`` (N, 4, 4), grouped by ``stable_pose`` (N,).

    ``dropped`` (F,) is how many of the drops from any orientation ended on each of the part's F stable poses,
    ``elsewhere`` how many lay still in none of them, ``moving`` how many did not come to rest.
    """

    T_table_part: Array
    stable_pose: NDArray[np.int64]
    dropped: NDArray[np.int64]
    elsewhere: int
    moving: int


class RestPool:
    """Rests of some parts; see the module's text. Never changes, so workers may share it."""

    def __init__(self, parts: Sequence[Part], rests: Mapping[str, PartRests]) -> None:
        self.parts = tuple(parts)
        self.rests = dict(rests)
        self._first: dict[str, list[int]] = {}
        self._radii: dict[str, Array] = {}
        self._shares: dict[Faces, dict[str, Array]] = {"physics": {}, "uniform": {}}
        for part in parts:
            faces, found = len(part.stable_poses), rests[part.name]
            self._first[part.name] = np.searchsorted(found.stable_pose, np.arange(faces + 1)).tolist()
            seen = [apply(T, part.mesh.convex_hull.vertices)[:, :2] for T in found.T_table_part]
            self._radii[part.name] = np.array([np.linalg.norm(corners, axis=1).max() for corners in seen])
            probability = np.array([pose.probability for pose in part.stable_poses])
            self._shares["physics"][part.name] = np.cumsum(probability / probability.sum())[:-1]
            self._shares["uniform"][part.name] = np.arange(1, faces) / faces

    @classmethod
    def make(cls, parts: Sequence[Part], config: RestConfig | None = None) -> RestPool:
        """Drop every part; the result depends on the parts and the config only, not on cores or threads.

        Raises SceneError for a part without stable poses and for a face that never keeps the part.
        """
        config = config or RestConfig()
        return cls(parts, {part.name: _part_rests(part, config) for part in parts})

    @classmethod
    def load_or_make(cls, parts: Sequence[Part], folder: Path, config: RestConfig | None = None) -> RestPool:
        """The pool stored in ``folder`` (``rests.npz``); made and stored when it is not there or is of other parts.

        The file is written aside and renamed, so several processes may do this at once. Raises SceneError as ``make``
        does, and when the file cannot be written.
        """
        config = config or RestConfig()
        stored = _read(parts, folder / FILE, _key(parts, config))
        if stored is not None:
            return cls(parts, stored)
        pool = cls.make(parts, config)
        try:
            _write(folder, pool.rests, _key(parts, config))
        except OSError as error:
            raise SceneError(f"cannot write {FILE} into {folder}: {error}") from error
        return pool

    def draw(self, part: Part, faces: Faces, rng: np.random.Generator) -> Rest:
        """A rest of a part: its face as ``faces`` says, then any rest on that face."""
        first = self._first[part.name]
        face = int(np.searchsorted(self._shares[faces][part.name], rng.random(), side="right"))
        k = int(rng.integers(first[face], first[face + 1]))
        return Rest(
            stable_pose=face,
            T_table_part=self.rests[part.name].T_table_part[k],
            radius_m=float(self._radii[part.name][k]),
        )


@lru_cache(maxsize=64)
def _part_rests(part: Part, config: RestConfig) -> PartRests:
    if not part.stable_poses:
        raise SceneError(f"part {part.name!r} has no stable poses; compute stable_poses.json first")
    count = len(part.stable_poses)
    drops = DropsConfig(drops=config.drops, seed=config.seed)
    first = drop_part(part, contact_pieces(part, "rest"), drops)
    found = _normal_forms(part, first, config)
    dropped = np.bincount([face for face, _ in found], minlength=count)
    rng = np.random.default_rng([config.seed, count])
    for _ in range(config.rounds):
        have = np.bincount([face for face, _ in found], minlength=count)
        lacking = [k for k in range(count) for _ in range(config.each - have[k])]
        if not lacking:
            break
        R_start = np.array([_near(part.stable_poses[k], config, rng) for k in lacking])
        near = replace(drops, drops=len(lacking), height_m=config.near_height_m)
        again = drop_part(part, contact_pieces(part, "rest"), near, R_start=R_start)
        found += _normal_forms(part, again, config)
    for pose in part.stable_poses:
        if all(face != pose.index for face, _ in found):
            raise SceneError(
                f"part {part.name!r} does not stay on stable pose {pose.index}, though its stable_poses.json says so "
                f"(probability {pose.probability:.4f}); add the part again"
            )
    found.sort(key=lambda item: item[0])
    still = int(first.still.sum())
    return PartRests(
        T_table_part=np.array([T for _, T in found]),
        stable_pose=np.array([face for face, _ in found]),
        dropped=dropped,
        elsewhere=still - int(dropped.sum()),
        moving=config.drops - still,
    )


def _normal_forms(part: Part, drops: Drops, config: RestConfig) -> list[tuple[int, Array]]:
    """Stable pose and normal form of every drop that ended in one."""
    found = []
    for R, height in zip(drops.R_table_part[drops.still], drops.height_m[drops.still], strict=True):
        pose, leaning = nearest_rest(part, R)
        if leaning <= config.leaning_rad:
            found.append((pose.index, _normal_form(part, pose, transform(R, [0.0, 0.0, height]))))
    return found


def _normal_form(part: Part, pose: StablePose, T_table_part: Array) -> Array:
    """A rest with its yaw from the stable pose and its footprint's place taken out."""
    T = _as_listed(part, pose, T_table_part)
    R = rotation_z(-yaw_of(T[:3, :3] @ pose.R_table_part.T)) @ T[:3, :3]
    seen = part.mesh.vertices @ R[:2].T
    centre = (seen.min(axis=0) + seen.max(axis=0)) / 2
    return transform(R, [-centre[0], -centre[1], T[2, 3]])


def _as_listed(part: Part, pose: StablePose, T_table_part: Array) -> Array:
    """Of the transforms that a part's symmetries make of a rest, the one that its stable pose describes; a roll that
    is no symmetry stays as it is.
    """
    if pose.roll is None:
        return as_rest(part, pose, T_table_part)
    rolled, target = Symmetries(continuous=(pose.roll,)), pose.R_table_part[2]
    options = [T_table_part @ S for S in part.symmetries.elements]
    return min(options, key=lambda T: float(angle_between(rolled.nearest_direction(target, T[2, :3]), target)))


def _near(pose: StablePose, config: RestConfig, rng: np.random.Generator) -> Array:
    """(3, 3) orientation a little off a stable pose, rolled at random where it may roll."""
    angle, direction = rng.uniform(0, config.near_rad), rng.uniform(0, 2 * np.pi)
    lean = rotation_from_rotvec(angle * np.array([np.cos(direction), np.sin(direction), 0.0]))
    turn = rng.uniform(-np.pi, np.pi)
    return lean @ pose.R_table_part @ (np.eye(3) if pose.roll is None else pose.roll.turn(turn)[:3, :3])


def _key(parts: Sequence[Part], config: RestConfig) -> str:
    """Changes with all that decides the rests: the config, and the parts' shapes, masses and stable poses."""
    digest = hashlib.sha256(f"{_FORMAT} {config}".encode())
    for part in parts:
        digest.update(f"{part.name} {part.mesh_hash} {part.mass_kg}".encode())
        for pose in part.stable_poses:
            digest.update(np.array([*pose.T_table_part.ravel(), pose.probability, pose.roll is not None]).tobytes())
        for piece in contact_pieces(part, "rest"):
            digest.update(np.asarray(piece.vertices, np.float64).tobytes())
    return digest.hexdigest()


def _read(parts: Sequence[Part], path: Path, key: str) -> dict[str, PartRests] | None:
    """What was stored under ``key``, None when there is no such file or it cannot be read."""
    if not path.is_file():
        return None
    try:
        with np.load(path) as stored:
            if str(stored["key"]) != key:
                return None
            return {
                part.name: PartRests(
                    T_table_part=stored[f"{part.name}/T_table_part"],
                    stable_pose=stored[f"{part.name}/stable_pose"],
                    dropped=stored[f"{part.name}/dropped"],
                    elsewhere=int(stored[f"{part.name}/rejected"][0]),
                    moving=int(stored[f"{part.name}/rejected"][1]),
                )
                for part in parts
            }
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _write(folder: Path, rests: Mapping[str, PartRests], key: str) -> None:
    content: dict[str, NDArray] = {"key": np.array(key)}
    for name, found in rests.items():
        content[f"{name}/T_table_part"] = found.T_table_part
        content[f"{name}/stable_pose"] = found.stable_pose
        content[f"{name}/dropped"] = found.dropped
        content[f"{name}/rejected"] = np.array([found.elsewhere, found.moving])
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".rests-", suffix=".partial", delete=False) as file:
        aside = Path(file.name)
        try:
            np.savez(file, allow_pickle=False, **content)
            aside.chmod(0o644)
            aside.replace(folder / FILE)
        finally:
            aside.unlink(missing_ok=True)
