"""Real runs of `tagcell render` that are killed and stopped, and what comes of them when they are run again."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scenes.dataset_config import DatasetConfig
from scenes.generate import generate
from scenes.shards import PARTIAL

CONFIG = DatasetConfig(kind="crop", split="val", size=(64, 64), downscale=4, count=240, shard=20, seed=7)
SETTINGS = {"kind": "crop", "split": "val", "size": "64x64", "downscale": 4, "count": 240, "shard": 20, "seed": 7}
COMMAND = ["render", "--jobs", "2", *(word for name, value in SETTINGS.items() for word in (f"--{name}", str(value)))]
PATIENCE_S = 120


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def start(out, *more):
    command = [sys.executable, "-m", "twin", *COMMAND, "--out", str(out), *more]
    return subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=hear_ctrl_c,
    )


def hear_ctrl_c():
    """Processes started in the background by a shell ignore Ctrl-C, and so do their children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def until(condition):
    """The first true value of ``condition()``."""
    end = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return value


def children(process):
    return [int(pid) for pid in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def workers(process):
    """Processes that the run has started to make images, not the one that tracks their resources."""
    return [pid for pid in children(process) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def runs(pid):
    """Whether a process is there and is no zombie, which nobody may be left to wait for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def images_under_way(out):
    """Images in folders that have no final name yet."""
    return list(out.glob(f"val/{PARTIAL}/rgb/*"))


def shards(out):
    return sorted(out.glob("val/[0-9]*"))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "data"
    generate(CONFIG, out)
    return files(out)


def test_a_run_that_is_killed_and_stopped_is_finished_to_the_byte(undisturbed, tmp_path):
    out = tmp_path / "data"

    run = start(out)
    until(lambda: shards(out) and images_under_way(out))
    pids = workers(run.pid)
    assert len(pids) == 2
    os.kill(run.pid, signal.SIGKILL)
    run.communicate()
    until(lambda: not any(map(runs, pids)))
    kept = {shard: (shard / "SHA256SUMS").stat().st_mtime_ns for shard in shards(out)}
    assert 0 < len(kept) < 12 and not (out / "manifest.json").exists()

    run = start(out)
    until(lambda: len(workers(run.pid)) == 2)
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does; the workers are still importing
    _, told = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130 and told.strip().endswith("tagcell: stopped; what was finished is kept")
    assert "Traceback" not in told

    generate(CONFIG, out)
    assert {shard: (shard / "SHA256SUMS").stat().st_mtime_ns for shard in kept} == kept
    assert files(out) == undisturbed


@pytest.mark.slow
def test_a_worker_that_is_killed_ends_the_run_which_is_finished_to_the_byte(undisturbed, tmp_path):
    out = tmp_path / "data"
    run = start(out)
    until(lambda: shards(out) and images_under_way(out))
    os.kill(workers(run.pid)[0], signal.SIGKILL)
    _, told = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert "a worker died (signal 9" in told and "run the same command again" in told
    assert f"of 12 shards are finished and kept in {out}" in told and "Traceback" not in told
    run = start(out)
    run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0
    assert files(out) == undisturbed
