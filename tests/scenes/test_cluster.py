"""Shards by a Ray cluster: a real one of two workers on this machine, one of which is killed."""

import builtins
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from scenes.cluster import Ledger, make_shard
from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import identity, opened
from scenes.errors import SceneError
from scenes.generate import generate
from scenes.shards import PARTIAL
from scenes.workers import Shard

CONFIG = DatasetConfig(kind="crop", split="val", size=(64, 64), downscale=4, count=160, shard=20, seed=7)


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def busy():
    """Process ids of Ray's workers that make a shard just now."""
    titles = {int(p.name): p / "cmdline" for p in Path("/proc").iterdir() if p.name.isdigit()}
    return [pid for pid, path in titles.items() if path.exists() and path.read_bytes().startswith(b"ray::make_shard")]


def kill_one(out, killed):
    """Kill the first worker that is seen at work."""
    end = time.monotonic() + 120
    while not killed and time.monotonic() < end:
        time.sleep(0.02)
        if list(out.glob(f"val/{PARTIAL}/rgb/*")) and (pids := busy()):
            os.kill(pids[0], signal.SIGKILL)
            killed.append(pids[0])


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing_but_time(tmp_path, capfd):
    generate(CONFIG, tmp_path / "plain")
    out, killed, told, addresses = tmp_path / "ray", [], [], set()
    killer = threading.Thread(target=kill_one, args=(out, killed))
    killer.start()

    def report(progress):
        import ray  # not before the run has said how

        told.append(progress)
        addresses.update(node["NodeManagerAddress"] for node in ray.nodes())

    generate(CONFIG, out, jobs=2, ray="local", report=report)
    killer.join()
    assert len(killed) == 1
    assert files(out) == files(tmp_path / "plain")
    assert (told[-1].done, told[-1].total) == (160, 160)
    assert any(progress.done % 20 for progress in told)  # images of unfinished shards are counted, too
    assert addresses == {"127.0.0.1"}  # nobody else can reach it
    assert capfd.readouterr().out == ""


def test_a_machine_without_the_folder_or_with_other_versions_says_so(tmp_path):
    wanted, shard = identity(CONFIG), Shard(index=0, first=0, count=20)
    with pytest.raises(SceneError, match=r"does not see the data set in .*nowhere: --out must be a folder that all"):
        make_shard(CONFIG, tmp_path / "nowhere" / "val", wanted, shard, None)
    with opened(CONFIG, tmp_path / "data") as split, pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenes.dataset_folder.GENERATOR", wanted["generator"] + 1)
        with pytest.raises(SceneError, match=r"would make other images, with generator 2, not 1; install the same"):
            make_shard(CONFIG, split, wanted, shard, None)


def test_a_shard_that_is_done_again_counts_once():
    ledger = Ledger()
    for shard, images in [(3, 1), (3, 2), (4, 1), (3, 1)]:
        ledger.note(shard, images)
    assert ledger.images() == 2


def test_without_ray_the_remedy_is_named(tmp_path, monkeypatch):
    found = builtins.__import__

    def absent(name, *rest):
        if name == "ray":
            raise ImportError(name)
        return found(name, *rest)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(SceneError, match=r"pip install 'tagcell\[ray\]'"):
        generate(CONFIG, tmp_path / "data", ray="local")


def test_an_address_where_nobody_listens_is_refused_at_once(tmp_path):
    with pytest.raises(SceneError, match=r"no Ray cluster at '127\.0\.0\.1:9': .*use --ray local"):
        generate(CONFIG, tmp_path / "data", ray="127.0.0.1:9")
