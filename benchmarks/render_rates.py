"""How many labelled images a second reach the disk, in the steady state, and what starting takes."""

from __future__ import annotations

import gc
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.synchronize import Barrier
from pathlib import Path

import numpy as np

from benchmarks.render_stages import measure_stages
from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import opened
from scenes.workers import Shard, ShardMaker, use_one_core

_barrier: Barrier | None = None


@dataclass(frozen=True, kw_only=True)
class Rate:
    """What ``workers`` processes together did: images/s on the wall's clock, and CPU milliseconds of one image.

    ``start_s`` is the wall's time from a worker's birth to its first image on disk, ``memory_mb`` the largest a worker
    had, ``kilobytes`` an image's share of all files.
    """

    workers: int
    images: int
    rate: float
    cpu_ms: float
    start_s: float
    memory_mb: float
    kilobytes: float


@dataclass(frozen=True, kw_only=True)
class _Work:
    """One worker's part."""

    images: int
    wall_s: float
    cpu_s: float
    start_s: float
    memory_mb: float


def measure_rate(config: DatasetConfig, out: Path, workers: int, seconds: float) -> Rate:
    """Make images in the new folder ``out`` with so many processes until ``seconds`` are over, in whole shards.

    The clock starts when every worker has made its first image; each makes at least one shard then.
    """
    context = multiprocessing.get_context("spawn")
    with opened(config, out) as split:
        pool = ProcessPoolExecutor(workers, context, initializer=_start, initargs=(context.Barrier(workers),))
        with pool:
            born = time.time()
            jobs = [pool.submit(_work, config, split, k, workers, seconds, born) for k in range(workers)]
            done = [job.result() for job in jobs]
        size = sum(path.stat().st_size for path in split.rglob("*") if path.is_file())
    images = sum(work.images for work in done)
    return Rate(
        workers=workers,
        images=images,
        rate=sum(work.images / work.wall_s for work in done),
        cpu_ms=1e3 * sum(work.cpu_s for work in done) / images,
        start_s=float(np.mean([work.start_s for work in done])),
        memory_mb=max(work.memory_mb for work in done),
        kilobytes=size / 1e3 / (images + workers),
    )


def stages(config: DatasetConfig, out: Path, images: int) -> dict[str, float]:
    """CPU milliseconds of the stages of an image, made in the new folder ``out`` in a process of their own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, initializer=use_one_core, initargs=(config.domain,)) as pool:
        return pool.submit(measure_stages, config, out, images).result()


def _start(barrier: Barrier) -> None:
    global _barrier
    _barrier = barrier


def _work(config: DatasetConfig, split: Path, k: int, workers: int, seconds: float, born: float) -> _Work:
    assert _barrier is not None
    use_one_core(config.domain)
    maker = ShardMaker(config, split)
    gc.freeze()
    try:
        maker.make(Shard(index=k, first=k, count=1), lambda: None)
        start_s = time.time() - born
        _barrier.wait()
        wall, cpu, images, index = time.perf_counter(), time.process_time(), 0, k
        while time.perf_counter() - wall < seconds or images == 0:
            index += workers
            maker.make(Shard(index=index, first=index * config.shard_size, count=config.shard_size), lambda: None)
            images += config.shard_size
        return _Work(
            images=images,
            wall_s=time.perf_counter() - wall,
            cpu_s=time.process_time() - cpu,
            start_s=start_s,
            memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )
    finally:
        maker.close()
