"""The shards of a data set as tasks of a Ray cluster (https://docs.ray.io), written into a folder that all share.

A task whose worker or machine dies is done again by Ray; one that raises is not. A shard is written aside under a name
of its own, so attempts of the same shard never meet, and the first one that is complete stays.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, redirect_stdout, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import differences, identity, read_identity
from scenes.errors import SceneError
from scenes.shards import SUMS, shard_path
from scenes.workers import PATIENCE_S, Shard, ShardMaker, use_one_core

LOCAL = "local"
RETRIES = 3
"""How often Ray does a shard again whose worker died."""
AHEAD = 2
"""Tasks asked for per core of the cluster, so that none waits for the next one."""
LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Where it is 0 when Ray is imported, a local Ray listens on 127.0.0.1 only, on every system."""
OBJECT_STORE_BYTES = 100_000_000
"""Of a local Ray: images do not go through the object store."""
TELLS_EVERY_S = 0.5
"""How often a worker says how far it is."""
SHOWS_WITHIN_S = 60.0
"""How long a network file system may take to show a folder that another machine has written."""


class RayWorkers:
    """See :class:`scenes.workers.Workers`. ``address`` as ``ray.init`` takes it; ``local``: ``jobs`` workers here.

    Raises SceneError when Ray is not installed or no cluster answers.
    """

    def __init__(self, config: DatasetConfig, split: Path, address: str, jobs: int) -> None:
        with ExitStack() as stack:
            stack.enter_context(redirect_stdout(sys.stderr))  # Ray prints what went wrong; it is no result
            self._ray = _connect(address, jobs, stack)
            self._stack = stack.pop_all()
        self._split, self._address, self._made = split.resolve(), address, 0
        self._ledger = self._ray.remote(num_cpus=0, max_restarts=-1)(Ledger).remote()
        remote = self._ray.remote(num_cpus=1, max_retries=RETRIES, retry_exceptions=False)
        self._task = remote(make_shard)
        self._arguments = (config, self._split, identity(config))
        self._pending: dict[Any, int] = {}

    @property
    def slots(self) -> int:
        """See :class:`scenes.workers.Workers`; follows a cluster that grows."""
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        return cores if self._address == LOCAL else AHEAD * max(1, cores)

    def submit(self, shard: Shard) -> None:
        """See :class:`scenes.workers.Workers`."""
        self._pending[self._task.remote(*self._arguments, shard, self._ledger)] = shard.index

    def finished(self) -> list[int]:
        """See :class:`scenes.workers.Workers`."""
        ray = self._ray
        done, _ = ray.wait(list(self._pending), num_returns=len(self._pending), timeout=PATIENCE_S)
        try:
            for task in done:
                self._await_shard(self._pending[task], ray.get(task))
        except ray.exceptions.RayTaskError as error:
            raise SceneError(str(error.cause)) from None
        except ray.exceptions.RayError as error:
            first = str(error).strip().splitlines()[0]
            raise SceneError(
                f"workers of the cluster died {RETRIES + 1} times over one shard ({type(error).__name__}: {first}); "
                "see that they have memory enough and run the same command again to go on"
            ) from None
        return [self._pending.pop(task) for task in done]

    def images_made(self) -> int:
        """See :class:`scenes.workers.Workers`."""
        ray = self._ray
        with suppress(ray.exceptions.RayActorError, ray.exceptions.GetTimeoutError):  # it starts anew elsewhere
            self._made = max(self._made, ray.get(self._ledger.images.remote(), timeout=5))
        return self._made

    def close(self) -> None:
        """See :class:`scenes.workers.Workers`. Tasks under way are killed; a Ray that was started for this ends."""
        with self._stack:
            for task in self._pending:
                self._ray.cancel(task, force=True)

    def _await_shard(self, index: int, host: str) -> None:
        """Raise SceneError when what a worker has written does not show here."""
        until = time.monotonic() + SHOWS_WITHIN_S
        while not (shard_path(self._split, index) / SUMS).is_file():
            if time.monotonic() > until:
                raise SceneError(
                    f"shard {index}, written by {host}, does not show in {self._split}: "
                    "--out must be a folder that all machines of the cluster share"
                )
            time.sleep(PATIENCE_S)


class Ledger:
    """Counts the images of each shard; a shard that is done again counts once."""

    def __init__(self) -> None:
        self._images: dict[int, int] = {}

    def note(self, shard: int, images: int) -> None:
        """Take down how many images of a shard are made."""
        self._images[shard] = images

    def images(self) -> int:
        """Images of all shards."""
        return sum(self._images.values())


def make_shard(config: DatasetConfig, split: Path, wanted: dict[str, Any], shard: Shard, ledger: Any) -> str:
    """Make a shard unless it is there; returns the name of the machine. Runs on a worker of the cluster.

    Raises SceneError when the folder is not there or this machine would make other images.
    """
    host = socket.gethostname()
    if (shard_path(split, shard.index) / SUMS).is_file():
        return host
    _check_machine(config, split, wanted, host)
    images, told_at = 0, -math.inf

    def tick() -> None:
        nonlocal images, told_at
        images += 1
        if images == shard.count or time.monotonic() - told_at >= TELLS_EVERY_S:
            told_at = time.monotonic()
            ledger.note.remote(shard.index, images)

    _maker(config, split).make(shard, tick)
    return host


@lru_cache(maxsize=1)
def _maker(config: DatasetConfig, split: Path) -> ShardMaker:
    use_one_core(config.domain)
    return ShardMaker(config, split)


def _check_machine(config: DatasetConfig, split: Path, wanted: dict[str, Any], host: str) -> None:
    if not split.is_dir() or read_identity(split.parent) != wanted:
        raise SceneError(
            f"{host} does not see the data set in {split.parent}: --out must be a folder that all machines of the "
            "cluster share, under the same name"
        )
    differing = differences(identity(config), wanted)
    if differing:
        raise SceneError(
            f"{host} would make other images, with {'; '.join(differing)}; install the same versions there"
        )


def _connect(address: str, jobs: int, stack: ExitStack) -> Any:
    """Ray, connected; ``stack`` ends it, and removes the logs of one that was started for this."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address == LOCAL:
        os.environ.setdefault(LOOPBACK, "0")
    try:
        import ray
    except ImportError as error:
        raise SceneError("--ray needs Ray; run: pip install 'tagcell[ray]'") from error
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == LOCAL:
        folder = tempfile.mkdtemp(prefix="ray-")
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        settings |= {"num_cpus": jobs, "include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
        settings |= {"_node_ip_address": "127.0.0.1", "_temp_dir": folder}
    stack.callback(ray.shutdown)
    usual = signal.getsignal(signal.SIGTERM)
    try:
        _knock(address)
        ray.init(address, **settings)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, usual)  # Ray's own ends the process with a trace and leaves its workers
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        raise SceneError(
            f"no Ray cluster at {address!r}: {error}; start one (ray start --head), or use --ray {LOCAL}"
        ) from error
    return ray


def _knock(address: str) -> None:
    """Raise OSError where nobody listens, which Ray takes minutes to say."""
    named = re.fullmatch(r"(?:ray://)?(.+):(\d+)", address)
    if named:
        socket.create_connection((named[1].strip("[]"), int(named[2])), timeout=10).close()
