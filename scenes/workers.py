"""Who makes the shards of a data set: this process, several processes of this machine, or a cluster.

Each worker keeps one core busy: the software rasteriser, OpenCV, BLAS and Dr.Jit get no threads of their own.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2

from scenes.bop import ShardWriter
from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.image_maker import ImageMaker
from scenes.shards import shard_path, written_aside

ONE_CORE = {
    "LP_NUM_THREADS": "0",  # Mesa's software rasteriser draws in the thread that calls it
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of a worker; what the user has set stays."""
PATIENCE_S = 0.25
DIED = "a worker died (signal 9: killed, or out of memory?); run the same command again, or with fewer --jobs"


@dataclass(frozen=True, kw_only=True)
class Shard:
    """``count`` images from number ``first`` on, in the folder numbered ``index``."""

    index: int
    first: int
    count: int


class Workers(Protocol):
    """Makes shards in any order. ``slots`` is how many may be asked for before one of them is awaited."""

    @property
    def slots(self) -> int:
        """Shards that may be under way."""
        ...

    def submit(self, shard: Shard) -> None:
        """Ask for a shard."""
        ...

    def finished(self) -> list[int]:
        """Wait a moment; the indices of shards that have been completed since. Raises SceneError when one failed."""
        ...

    def images_made(self) -> int:
        """Images made so far, those of unfinished shards among them."""
        ...

    def close(self) -> None:
        """Give up what is under way, and free everything."""
        ...


class StoppedError(Exception):
    """The worker was told to give up its shard."""


class ShardMaker:
    """Makes shards of one data set in the folder of its split, with a renderer that is set up once."""

    def __init__(self, config: DatasetConfig, split: Path) -> None:
        self._config, self._split = config, split
        self._maker = ImageMaker(config, split.parent)

    def make(self, shard: Shard, tick: Callable[[], None]) -> None:
        """Make a shard and give it its name; ``tick`` is called after every image and may raise StoppedError."""
        config = self._config
        try:
            with written_aside(shard_path(self._split, shard.index)) as folder:
                writer = ShardWriter(
                    folder, shard.index, config.load_parts(), with_depth=config.depth, jpeg=config.jpeg
                )
                for index in range(shard.first, shard.first + shard.count):
                    made = self._maker.make(index)
                    writer.add(
                        made.image,
                        made.intrinsics,
                        made.T_cam_board,
                        made.annotations,
                        made.depth_m,
                        distortion=made.lens.coefficients,
                        gamma=made.gamma,
                    )
                    tick()
                writer.finish()
        except OSError as error:
            raise SceneError(f"cannot write shard {shard.index} into {self._split}: {error}") from error

    def close(self) -> None:
        """Free the renderer."""
        self._maker.close()


class ThisProcess:
    """Makes the shards one by one, here."""

    slots = 1

    def __init__(self, config: DatasetConfig, split: Path, tick: Callable[[], None]) -> None:
        self._stack = contextlib.ExitStack()
        self._stack.enter_context(one_core(config.domain))
        self._maker = ShardMaker(config, split)
        self._stack.callback(self._maker.close)
        self._waiting: list[Shard] = []
        self._tick, self._made = tick, 0

    def submit(self, shard: Shard) -> None:
        """See :class:`Workers`."""
        self._waiting.append(shard)

    def finished(self) -> list[int]:
        """See :class:`Workers`."""
        shard = self._waiting.pop(0)
        self._maker.make(shard, self._count)
        return [shard.index]

    def images_made(self) -> int:
        """See :class:`Workers`."""
        return self._made

    def close(self) -> None:
        """See :class:`Workers`."""
        self._stack.close()

    def _count(self) -> None:
        self._made += 1
        self._tick()


class Processes:
    """Makes the shards in ``jobs`` processes, which end when this one does, however it ends."""

    def __init__(self, config: DatasetConfig, split: Path, jobs: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.slots = jobs
        self._made, self._stop = context.Value("q", 0), context.RawValue("b", 0)
        arguments = (config, split, self._made, self._stop)
        self._pool = ProcessPoolExecutor(jobs, context, initializer=_start, initargs=arguments)
        self._pending: dict[Future[None], int] = {}

    def submit(self, shard: Shard) -> None:
        """See :class:`Workers`."""
        with one_core(), _without_interrupts():  # some libraries read the environment when they are loaded
            self._pending[self._pool.submit(_make, shard)] = shard.index

    def finished(self) -> list[int]:
        """See :class:`Workers`."""
        done, _ = wait(self._pending, PATIENCE_S, return_when=FIRST_COMPLETED)
        try:
            for future in done:
                future.result()
        except BrokenProcessPool as error:
            raise SceneError(DIED) from error
        return [self._pending.pop(future) for future in done]

    def images_made(self) -> int:
        """See :class:`Workers`. Read without the lock, which a worker that was killed may hold for ever."""
        return self._made.get_obj().value

    def close(self) -> None:
        """See :class:`Workers`. The workers give up their shards after the image that they are at."""
        self._stop.value = 1
        self._pool.shutdown(cancel_futures=True)


def use_one_core(domain: str = "") -> None:
    """Keep the libraries of this process, and of those that it starts, from having threads of their own."""
    for name, value in ONE_CORE.items():
        os.environ.setdefault(name, value)
    cv2.setNumThreads(1)
    if domain == "mitsuba":
        with contextlib.suppress(ImportError):
            import drjit

            drjit.set_thread_count(1)


@contextlib.contextmanager
def one_core(domain: str = "") -> Iterator[None]:
    """``use_one_core`` for a while."""
    absent, threads = [name for name in ONE_CORE if name not in os.environ], cv2.getNumThreads()
    try:
        use_one_core(domain)
        yield
    finally:
        cv2.setNumThreads(threads)
        for name in absent:
            os.environ.pop(name, None)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Hold Ctrl-C back; what is started meanwhile never sees it, as it is this process that ends its workers."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_arguments: tuple[DatasetConfig, Path, Any, Any] | None = None
_maker: ShardMaker | None = None


def _start(config: DatasetConfig, split: Path, made: Any, stop: Any) -> None:
    global _arguments
    _arguments = (config, split, made, stop)
    use_one_core(config.domain)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that was killed cannot tell its workers; the pipe that they share with it can."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _make(shard: Shard) -> None:
    """Make a shard; what the renderer needs is set up with the first one, so that its errors reach the parent."""
    global _maker
    assert _arguments is not None
    config, split, made, stop = _arguments

    def tick() -> None:
        with made.get_lock():
            made.value += 1
        if stop.value:
            raise StoppedError

    if stop.value:
        return
    if _maker is None:
        _maker = ShardMaker(config, split)
        gc.freeze()  # what lasts is not looked through again and again
    _maker.make(shard, tick)
