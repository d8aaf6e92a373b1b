"""Makes labelled data sets: shards by several workers, resumed where a run was interrupted."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2

from scenes.bop import ChunkWriter, write_camera, write_models
from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.image_maker import ImageMaker

MANIFEST = "dataset.json"
RASTERISER_THREADS = "LP_NUM_THREADS"
"""Environment variable of Mesa's software rasteriser; 0 draws in the calling thread."""


def generate(config: DatasetConfig, out: Path, *, jobs: int = 1, report: Callable[[str], None] = print) -> None:
    """Write the data set ``config`` describes into ``out``; chunks that are there already are kept.

    Raises SceneError when ``out`` holds a data set made with another config or cannot be written.
    """
    split = _open_folder(config, out)
    assert config.count is not None
    chunks = -(-config.count // config.shard_size)
    missing = [k for k in range(chunks) if not (split / f"{k:06d}").exists()]
    sizes = {k: min(config.shard_size, config.count - k * config.shard_size) for k in missing}
    started, done, total = time.monotonic(), 0, sum(sizes.values())
    for k in _finished_chunks(config, split, sizes, jobs):
        done += sizes[k]
        rate = done / (time.monotonic() - started)
        report(f"{out.name}: {config.count - total + done} of {config.count} images, {rate:.1f} images/s")


def _open_folder(config: DatasetConfig, out: Path) -> Path:
    """Create or check the folder; returns the split's folder, free of what an interrupted run left."""
    parts = config.load_parts()
    manifest = config.manifest()
    path = out / MANIFEST
    try:
        if path.exists():
            if path.read_text() != manifest:
                raise SceneError(f"{out} holds a data set made with other settings ({path}); use another folder")
        elif out.exists() and any(out.iterdir()):
            raise SceneError(f"{out} is not empty and holds no {MANIFEST}; use another folder")
        split = out / config.split
        split.mkdir(parents=True, exist_ok=True)
        write_models(out, parts)
        write_camera(out, config.frame)
        path.write_text(manifest)
    except OSError as error:
        raise SceneError(f"cannot write into {out}: {error}") from error
    for leftover in split.glob(".*.partial"):
        shutil.rmtree(leftover)
    return split


def _finished_chunks(config: DatasetConfig, split: Path, sizes: dict[int, int], jobs: int) -> Iterator[int]:
    tasks = [(k, split / f"{k:06d}", size) for k, size in sizes.items()]
    if jobs == 1 or len(tasks) <= 1:
        worker = ChunkMaker(config)
        try:
            for task in tasks:
                yield worker.make(*task)
        finally:
            worker.close()
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(jobs, len(tasks)), initializer=_start_worker, initargs=(config,)) as pool:
        yield from pool.imap_unordered(_run_task, tasks)


_worker: ChunkMaker | None = None


def _start_worker(config: DatasetConfig) -> None:
    """One core a worker: neither OpenCV nor the software rasteriser starts threads of its own."""
    global _worker
    os.environ.setdefault(RASTERISER_THREADS, "0")
    cv2.setNumThreads(1)
    _worker = ChunkMaker(config)


def _run_task(task: tuple[int, Path, int]) -> int:
    assert _worker is not None
    return _worker.make(*task)


class ChunkMaker:
    """Makes shards of one data set."""

    def __init__(self, config: DatasetConfig) -> None:
        self._config = config
        self._parts = config.load_parts()
        self._maker = ImageMaker(config)

    def make(self, index: int, folder: Path, count: int) -> int:
        """Make shard ``index`` of ``count`` images in ``folder``; returns the index."""
        aside = folder.with_name(f".{folder.name}.partial")
        shutil.rmtree(aside, ignore_errors=True)
        config = self._config
        writer = ChunkWriter(aside, index, self._parts, with_depth=config.depth, jpeg=config.jpeg)
        for k in range(count):
            made = self._maker.make(index * self._config.shard_size + k)
            writer.add(made.image, made.intrinsics, made.T_cam_board, made.annotations, made.depth_m)
        writer.finish()
        aside.rename(folder)
        return index

    def close(self) -> None:
        """Free the renderer."""
        self._maker.close()
