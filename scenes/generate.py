"""Makes labelled data sets, shard by shard, by any number of workers; takes up what an interrupted run left.

Image ``i`` depends on the config and on ``i`` only, so a data set is the same however its shards were shared out, and
it can be made longer. One that is to hold so many instances of each part ends with the first shard, in order, that
fulfils this; shards beyond it, which workers may have begun ahead, are removed.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import MANIFEST, opened, write_manifest
from scenes.domains import domain_problem
from scenes.errors import SceneError
from scenes.shards import SHARD, clear_partial, instances_in, shard_path, shard_problems
from scenes.workers import Processes, Shard, ThisProcess, Workers

AHEAD = 2
"""Shards begun ahead for each that is under way, where it is not known how many it will take."""
BARREN = 300
"""A part that none of the first BARREN images for each part of the set shows will not come."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """``done`` of ``total`` images are there, ``made`` of them by this run in ``seconds``.

    For a data set that is to hold so many instances, ``total`` is an estimate from those counted so far.
    """

    done: int
    total: int
    made: int
    seconds: float

    @property
    def rate(self) -> float:
        """Images a second of this run."""
        return self.made / self.seconds if self.seconds > 0 else 0.0

    @property
    def seconds_left(self) -> float | None:
        """Seconds that the rest takes at this rate, None before the first image."""
        return (self.total - self.done) / self.rate if self.rate > 0 else None


def generate(
    config: DatasetConfig,
    out: Path,
    *,
    jobs: int = 1,
    ray: str = "",
    verify: bool = False,
    report: Callable[[Progress], None] = lambda progress: None,
) -> dict[str, Any]:
    """Make the data set ``config`` describes in ``out``, as far as it is not there yet; returns its manifest.

    ``jobs`` processes share the work, or a Ray cluster at the address ``ray`` (``local``: one with ``jobs`` workers,
    started for this). ``verify`` first compares all that is there with its sums. ``report`` hears of every few images.
    Raises SceneError when ``out`` holds other data, is damaged, cannot be written or another run writes into it, when a
    worker dies, and when a part never shows; what was finished is kept, and the same call goes on from there.
    """
    if jobs < 1:
        raise SceneError(f"jobs {jobs}: must be at least 1")
    if not ray and (problem := domain_problem(config.domain)):
        raise SceneError(problem)
    with opened(config, out) as split:
        plan = Plan(config, split)
        if verify:
            _verify(plan.kept)
        if not plan.complete:
            (out / MANIFEST).unlink(missing_ok=True)
            try:
                _fill(plan, config, split, jobs, ray, report)
            except (SceneError, OSError) as error:
                raise SceneError(f"{error}\n{plan.state()} in {out}: the same command goes on from there") from error
        clear_partial(split)
        for shard in plan.surplus():
            shutil.rmtree(shard)
        return write_manifest(config, out, plan.counts)


class Plan:
    """Which shards are there, which are wanted, and when it is enough."""

    def __init__(self, config: DatasetConfig, split: Path) -> None:
        self._config, self._split = config, split
        self._names = {part.obj_id: part.name for part in config.load_parts()}
        self.counts: dict[int, Counter[int]] = {}
        self._in_order, self._held = 0, Counter[int]()
        self._end = None if config.count is None else -(-config.count // config.shard_size)
        self._asked = 0
        self.kept = sorted(split.glob(SHARD))
        for shard in self.kept:
            self._count(int(shard.name))

    @property
    def complete(self) -> bool:
        """Whether every shard that is wanted is there."""
        return self._in_order == self._end

    @property
    def total(self) -> int:
        """Images wanted: exact, or estimated from the instances in the first shards."""
        config = self._config
        if config.count is not None:
            return config.count
        assert config.instances is not None
        images = self._in_order * config.shard_size
        fewest = min(self._held[obj_id] for obj_id in self._names)
        if self._end is not None or fewest == 0:
            return max(images, config.shard_size)
        return -(-images * config.instances // fewest // config.shard_size) * config.shard_size

    @property
    def done(self) -> int:
        """Images that count towards ``total``."""
        return min(sum(self._shard(index).count for index in self.counts), self.total)

    def next(self, ahead: int) -> Shard | None:
        """The next shard to make, None when no more is wanted now.

        While the end is not known, none is begun more than ``ahead`` after the first one that is missing.
        """
        while self._asked in self.counts:
            self._asked += 1
        if self._asked >= (self._in_order + ahead if self._end is None else self._end):
            return None
        self._asked += 1
        return self._shard(self._asked - 1)

    def finish(self, index: int) -> None:
        """Take note of a shard that is there now; raises SceneError for parts that never show."""
        self._count(index)

    def surplus(self) -> list[Path]:
        """Shards beyond the end of the data set; they are no longer counted."""
        assert self._end is not None
        for index in [index for index in self.counts if index >= self._end]:
            del self.counts[index]
        return [shard for shard in sorted(self._split.glob(SHARD)) if int(shard.name) >= self._end]

    def state(self) -> str:
        """What there is, in words; workers may have finished more than was counted."""
        wanted = "" if self._end is None else f" of {self._end}"
        return f"{len(list(self._split.glob(SHARD)))}{wanted} shards are finished and kept"

    def _shard(self, index: int) -> Shard:
        first, count = index * self._config.shard_size, self._config.shard_size
        if self._config.count is not None:
            count = max(0, min(count, self._config.count - first))
        return Shard(index=index, first=first, count=count)

    def _count(self, index: int) -> None:
        """Count a shard, and in order of the shards all that now join on: the end depends on nothing else."""
        self.counts[index] = instances_in(shard_path(self._split, index))
        while self._in_order in self.counts and self._in_order != self._end:
            self._held += self.counts[self._in_order]
            self._in_order += 1
            if self._config.instances is not None:
                if all(self._held[obj_id] >= self._config.instances for obj_id in self._names):
                    self._end = self._in_order
                self._refuse_barren()

    def _refuse_barren(self) -> None:
        images = self._in_order * self._config.shard_size
        missing = [name for obj_id, name in self._names.items() if not self._held[obj_id]]
        if missing and images >= BARREN * len(self._names):
            raise SceneError(
                f"none of the first {images} images shows {', '.join(missing)}, so there will never be "
                f"{self._config.instances} instances; use --count, or a size that such a part fits into"
            )


def _fill(
    plan: Plan, config: DatasetConfig, split: Path, jobs: int, ray: str, report: Callable[[Progress], None]
) -> None:
    """Make the shards that are missing."""
    started, before, under_way = time.monotonic(), plan.done, 0

    def tell() -> None:
        made = workers.images_made()
        done = min(before + made, plan.total)
        report(Progress(done=done, total=plan.total, made=made, seconds=time.monotonic() - started))

    with closing(_workers(config, split, jobs, ray, tell)) as workers:
        while not plan.complete:
            while under_way < workers.slots and (shard := plan.next(AHEAD * workers.slots)) is not None:
                workers.submit(shard)
                under_way += 1
            for index in workers.finished():
                plan.finish(index)
                under_way -= 1
            tell()


def _workers(config: DatasetConfig, split: Path, jobs: int, ray: str, tick: Callable[[], None]) -> Workers:
    if ray:
        from scenes.cluster import RayWorkers

        return RayWorkers(config, split, ray, jobs)
    if jobs == 1:
        return ThisProcess(config, split, tick)
    return Processes(config, split, jobs)


def _verify(shards: Iterable[Path]) -> None:
    problems = [problem for shard in shards for problem in shard_problems(shard)]
    if problems:
        raise SceneError("\n".join(problems))
