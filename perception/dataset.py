"""Rendered data sets as arrays, mapped from a cache beside the data. Metres; world = board frame."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.resting import as_rest
from cad.spatial import Array, apply, inverse, yaw_of
from perception.bop_files import DATASET, Entry, manifest_hash, read_entries, read_json
from perception.calibration import table_from_board
from perception.estimates import PerceptionError

CACHE = "cache"
"""Folder of a data set with its arrays, one file each: they are read where they are needed, and shared."""
KEY = "key.txt"
MAX_INSTANCES = 255


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Resting poses in the table frame seen by the camera, of M parts.

    ``T_cam_part = T_cam_table @ planar(x, y, yaw) @ stable_pose.T_table_part``. ``part_index`` is the place in the
    sequence of parts, -1 where there is none (then the rest is NaN). ``centre_px`` is the projection of the footprint's
    centre on the table, ``body_px`` that of the point above it at half the part's height.
    """

    part_index: NDArray[np.int64]  # (M,)
    T_cam_table: Array  # (M, 4, 4)
    x: Array  # (M,)
    y: Array  # (M,)
    yaw: Array  # (M,)
    centre_px: Array  # (M, 2)
    body_px: Array  # (M, 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class CropSet:
    """N crops, each with at most one target part, the first of its list; none in a set whose ``target_share`` is 0.

    Where there is none, or nothing is seen of it, ``obj_id`` is 0 and the pose the identity.
    """

    images: NDArray[np.uint8]  # (N, H, W, 3) RGB
    obj_id: NDArray[np.int64]  # (N,)
    stable_pose: NDArray[np.int64]  # (N,), -1 where there is no target
    T_cam_part: Array  # (N, 4, 4)
    T_cam_board: Array  # (N, 4, 4)
    K: Array  # (N, 3, 3)
    packed_masks: NDArray[np.uint8]  # (N, H, ceil(W / 8)), visible pixels of the target

    def __len__(self) -> int:
        return len(self.images)

    def masks(self, index: Any = slice(None)) -> NDArray[np.bool_]:
        """Visible masks (..., H, W) of the chosen crops."""
        return np.unpackbits(self.packed_masks[index], axis=-1, count=self.images.shape[2]).astype(bool)

    def labels(self, parts: Sequence[Part]) -> Labels:
        """Resting pose of each crop's target; raises PerceptionError for an obj_id that is none of ``parts``."""
        return resting_poses(parts, self.obj_id, self.stable_pose, self.T_cam_part, self.T_cam_board, self.K)


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowSet:
    """N windows or frames with any number of parts each; M parts in all, in flat arrays.

    ``instance_map`` is 0 on the background and 1 + ``instance`` on the visible pixels of an instance.
    """

    images: NDArray[np.uint8]  # (N, H, W, 3) RGB
    instance_map: NDArray[np.uint8]  # (N, H, W)
    T_cam_board: Array  # (N, 4, 4)
    K: Array  # (N, 3, 3)
    image_index: NDArray[np.int64]  # (M,)
    instance: NDArray[np.int64]  # (M,), position in its image's list
    obj_id: NDArray[np.int64]  # (M,)
    stable_pose: NDArray[np.int64]  # (M,)
    T_cam_part: Array  # (M, 4, 4)

    def __len__(self) -> int:
        return len(self.images)

    def labels(self, parts: Sequence[Part]) -> Labels:
        """Resting pose of each instance; raises PerceptionError for an obj_id that is none of ``parts``."""
        i = self.image_index
        return resting_poses(parts, self.obj_id, self.stable_pose, self.T_cam_part, self.T_cam_board[i], self.K[i])

    @cached_property
    def instances_of(self) -> list[NDArray[np.int64]]:
        """For each image the rows of the flat arrays that belong to it."""
        order = np.argsort(self.image_index, kind="stable")
        return np.split(order, np.searchsorted(self.image_index[order], np.arange(1, len(self))))


def resting_poses(
    parts: Sequence[Part],
    obj_id: NDArray[np.int64],
    stable_pose: NDArray[np.int64],
    T_cam_part: Array,
    T_cam_board: Array,
    K: Array,
) -> Labels:
    """Planar coordinates and projected centres of M parts from their poses; ``obj_id`` 0 stands for no part.

    A part in a pose that may roll is taken back to the stored roll first.
    """
    index_of = {part.obj_id: i for i, part in enumerate(parts)} | {0: -1}
    unknown = sorted(set(obj_id.tolist()) - set(index_of))
    if unknown:
        known = ", ".join(f"{part.obj_id} ({part.name})" for part in parts)
        raise PerceptionError(f"the data holds obj_id {unknown}, which is none of the parts {known}")
    part_index = np.array([index_of[i] for i in obj_id.tolist()], np.int64)
    T_cam_table = np.stack([table_from_board(T) for T in T_cam_board]) if len(obj_id) else np.zeros((0, 4, 4))
    planar = np.full((len(obj_id), 3), np.nan)
    centres = np.full((2, len(obj_id), 2), np.nan)
    half_heights: dict[tuple[int, int], float] = {}
    for m in np.nonzero(part_index >= 0)[0]:
        part, k = parts[part_index[m]], int(stable_pose[m])
        if not 0 <= k < len(part.stable_poses):
            raise PerceptionError(
                f"the data holds stable pose {k} of {part.name}, which has {len(part.stable_poses)}: render it again"
            )
        pose = part.stable_poses[k]
        if (part_index[m], k) not in half_heights:
            half_heights[part_index[m], k] = apply(pose.T_table_part, part.mesh.vertices)[:, 2].max() / 2
        T_table_part = inverse(T_cam_table[m]) @ T_cam_part[m]
        if pose.roll is not None:
            T_table_part = as_rest(part, pose, T_table_part)
        T = T_table_part @ inverse(pose.T_table_part)
        planar[m] = T[0, 3], T[1, 3], yaw_of(T[:3, :3])
        for row, z in enumerate((0.0, half_heights[part_index[m], k])):
            u, v, w = K[m] @ apply(T_cam_table[m], [planar[m, 0], planar[m, 1], z])
            centres[row, m] = u / w, v / w
    return Labels(
        part_index=part_index,
        T_cam_table=T_cam_table,
        x=planar[:, 0],
        y=planar[:, 1],
        yaw=planar[:, 2],
        centre_px=centres[0],
        body_px=centres[1],
    )


def load_crops(*data_dirs: Path) -> CropSet:
    """All crops of some data sets, one after the other, each from the cache beside it when that is of its manifest."""
    return _joined([_cached(path, CropSet, _read_crops) for path in data_dirs])


def load_windows(data_dir: Path) -> WindowSet:
    """All windows or frames of a data set; see :func:`load_crops`."""
    return _cached(data_dir, WindowSet, _read_windows)


Kind = TypeVar("Kind", CropSet, WindowSet)


def _joined(sets: Sequence[CropSet]) -> CropSet:
    if len(sets) == 1:
        return sets[0]
    sizes = {s.images.shape[1:] for s in sets}
    if len(sizes) != 1:
        raise PerceptionError(f"data sets of images of shapes {sorted(sizes)}: give one or more of one size")
    return CropSet(**{f.name: np.concatenate([getattr(s, f.name) for s in sets]) for f in fields(CropSet)})


def _cached(data_dir: Path, kind: type[Kind], read: Callable[[Path], Kind]) -> Kind:
    """The arrays of a data set, mapped read-only from its cache, which is made anew when it is of other data."""
    key, path = f"{kind.__name__} {manifest_hash(data_dir)}", data_dir / CACHE
    if not (path / KEY).exists() or (path / KEY).read_text() != key:
        loaded = read(data_dir)
        aside = path.with_name(f".{os.getpid()}.{CACHE}")
        aside.mkdir()
        for f in fields(kind):
            np.save(aside / f"{f.name}.npy", getattr(loaded, f.name))
        (aside / KEY).write_text(key)
        shutil.rmtree(path, ignore_errors=True)
        os.replace(aside, path)
    return kind(**{f.name: np.load(path / f"{f.name}.npy", mmap_mode="r") for f in fields(kind)})


def _read_images(entries: Sequence[Entry]) -> NDArray[np.uint8]:
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        images = pool.map(Entry.image, entries)
        first = next(images)
        out = np.empty((len(entries), *first.shape), np.uint8)
        out[0] = first
        for i, image in enumerate(images, start=1):
            if image.shape != first.shape:
                raise PerceptionError(
                    f"image {entries[i].image_id} of {entries[i].shard} is {image.shape[1]} x {image.shape[0]}, the "
                    f"first one {first.shape[1]} x {first.shape[0]}: all must be of one size"
                )
            out[i] = image
    return out


def _read_crops(data_dir: Path) -> CropSet:
    entries = read_entries(data_dir)
    images = _read_images(entries)
    aimless = read_json(data_dir / DATASET).get("shots", {}).get("target_share") == 0
    targets = [e.instances[0] if e.places[:1] == [0] and not aimless else None for e in entries]
    empty = np.zeros(images.shape[1:3], bool)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        masks = pool.map(lambda e, t: np.packbits(e.mask(0) if t else empty, axis=-1), entries, targets)
        packed = np.stack(list(masks))
    return CropSet(
        images=images,
        obj_id=np.array([t["obj_id"] if t else 0 for t in targets], np.int64),
        stable_pose=np.array([t["stable_pose"] if t else -1 for t in targets], np.int64),
        T_cam_part=np.stack([e.T_cam_part(0) if t else np.eye(4) for e, t in zip(entries, targets, strict=True)]),
        T_cam_board=np.stack([e.T_cam_board for e in entries]),
        K=np.stack([e.K for e in entries]),
        packed_masks=packed,
    )


def _instance_map(entry: Entry, shape: tuple[int, int]) -> NDArray[np.uint8]:
    if len(entry.instances) > MAX_INSTANCES:
        raise PerceptionError(f"image {entry.image_id} of {entry.shard} has more than {MAX_INSTANCES} instances")
    out = np.zeros(shape, np.uint8)
    for k in range(len(entry.instances)):
        out[entry.mask(k)] = k + 1
    return out


def _read_windows(data_dir: Path) -> WindowSet:
    return windows_of(read_entries(data_dir))


def windows_of(entries: Sequence[Entry]) -> WindowSet:
    """Windows or frames, read from their files; all must be of one size."""
    images = _read_images(entries)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        maps = np.stack(list(pool.map(lambda e: _instance_map(e, images.shape[1:3]), entries)))
    flat = [(i, k, instance) for i, e in enumerate(entries) for k, instance in enumerate(e.instances)]
    return WindowSet(
        images=images,
        instance_map=maps,
        T_cam_board=np.stack([e.T_cam_board for e in entries]),
        K=np.stack([e.K for e in entries]),
        image_index=np.array([i for i, _, _ in flat], np.int64),
        instance=np.array([k for _, k, _ in flat], np.int64),
        obj_id=np.array([g["obj_id"] for _, _, g in flat], np.int64),
        stable_pose=np.array([g["stable_pose"] for _, _, g in flat], np.int64),
        T_cam_part=np.array([entries[i].T_cam_part(k) for i, k, _ in flat]).reshape(-1, 4, 4),
    )
