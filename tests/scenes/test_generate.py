"""Data sets come to the same bytes however they were made: at once, in pieces, longer later, by many workers."""

import errno
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from painted import PaintedMaker

from scenes.dataset_config import DatasetConfig
from scenes.dataset_folder import GENERATOR, LOCK, identity, opened
from scenes.errors import SceneError
from scenes.generate import Progress, generate
from scenes.path_traced import GROUND_SAMPLES
from scenes.ranges import SensorRanges
from scenes.shots import TRAIN_SHOTS
from scenes.workers import Processes, Shard, ThisProcess

CONFIG = DatasetConfig(kind="crop", split="val", size=(32, 32), downscale=4, count=10, shard=4, seed=7)


def changed(**changes):
    """CONFIG with other settings."""
    settings = {
        name: getattr(CONFIG, name) for name in ("kind", "split", "size", "downscale", "count", "shard", "seed")
    }
    return DatasetConfig(**settings | changes)


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def rgb(folder, index, shard):
    path = folder / "val" / f"{index // shard:06d}" / "rgb" / f"{index % shard:06d}.png"
    return cv2.imread(str(path))


@pytest.fixture(autouse=True)
def painted(monkeypatch):
    """Quick images; PaintedMaker.made is what was asked for."""
    monkeypatch.setattr("scenes.workers.ImageMaker", PaintedMaker)
    monkeypatch.setattr(PaintedMaker, "made", [])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "data"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenes.workers.ImageMaker", PaintedMaker)
        generate(CONFIG, out)
    return out


def test_shards_hold_their_images_sums_and_labels(whole):
    shards = sorted(p.name for p in (whole / "val").iterdir())
    assert shards == ["000000", "000001", "000002"]
    assert [len(list((whole / "val" / s / "rgb").iterdir())) for s in shards] == [4, 4, 2]
    for shard in shards:
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=whole / "val" / shard, check=True)
        listed = [line.split("  ")[1] for line in (whole / "val" / shard / "SHA256SUMS").read_text().splitlines()]
        there = {p.relative_to(whole / "val" / shard).as_posix() for p in (whole / "val" / shard).rglob("*.*")}
        assert listed == sorted(listed) and set(listed) == there
    assert not list(whole.rglob(".*"))


def test_the_manifest_counts_images_and_instances_that_are_seen(whole):
    manifest = json.loads((whole / "manifest.json").read_text())
    assert manifest["images"] == 10
    assert manifest["instances"] == {"inserted": 8, "main": 4, "top": 1}  # too little of those in images 2 and 8
    assert {name: entry["images"] for name, entry in manifest["shards"].items()} == {
        "000000": 4,
        "000001": 4,
        "000002": 2,
    }


def test_nothing_is_made_twice(whole):
    before = files(whole)
    generate(CONFIG, whole)
    assert PaintedMaker.made == []
    assert files(whole) == before


def test_a_run_that_is_stopped_keeps_whole_shards_and_goes_on_to_the_same_bytes(whole, tmp_path, monkeypatch):
    out, make = tmp_path / "data", PaintedMaker.make

    def stop(self, index):
        if index == 6:
            raise KeyboardInterrupt
        return make(self, index)

    monkeypatch.setattr(PaintedMaker, "make", stop)
    with pytest.raises(KeyboardInterrupt):
        generate(CONFIG, out)
    assert [p.name for p in (out / "val").iterdir()] == ["000000"]
    assert not (out / "manifest.json").exists()
    monkeypatch.setattr(PaintedMaker, "make", make)
    PaintedMaker.made.clear()
    (out / "val" / ".000001.killed.partial" / "rgb").mkdir(parents=True)
    told = []
    generate(CONFIG, out, report=told.append)
    assert PaintedMaker.made == [4, 5, 6, 7, 8, 9]
    assert (told[-1].done, told[-1].total, told[-1].made) == (10, 10, 6)
    assert [p.done for p in told] == sorted(p.done for p in told)
    assert files(out) == files(whole)


def test_a_data_set_may_be_made_longer(whole, tmp_path):
    short, out = changed(count=6), tmp_path / "data"
    generate(short, out)
    with pytest.raises(SceneError, match=r"count 6, not 5; a data set can grow but not shrink"):
        generate(changed(count=5), out)
    PaintedMaker.made.clear()
    generate(CONFIG, out)
    assert PaintedMaker.made == [4, 5, 6, 7, 8, 9]  # the last shard was short
    assert files(out) == files(whole)


def test_an_image_does_not_depend_on_the_size_of_the_shards(whole, tmp_path):
    generate(changed(shard=3), tmp_path / "data")
    for index in range(10):
        np.testing.assert_array_equal(rgb(tmp_path / "data", index, 3), rgb(whole, index, 4))


class OutOfOrder(ThisProcess):
    """Has several shards under way and completes the last one first."""

    slots = 3

    def finished(self):
        self._waiting.reverse()
        return super().finished()


@pytest.mark.parametrize("make_workers", [ThisProcess, OutOfOrder])
def test_a_data_set_ends_with_the_first_shard_that_fulfils_it(tmp_path, monkeypatch, make_workers):
    monkeypatch.setattr("scenes.generate._workers", lambda config, split, *_: make_workers(config, split, lambda: None))
    out = tmp_path / "data"
    manifest = generate(changed(count=None, instances=2), out)
    assert manifest["instances"] == {"inserted": 10, "main": 6, "top": 2}  # image 11 shows the second top
    assert manifest["images"] == 12 == len(list(out.glob("val/*/rgb/*")))
    PaintedMaker.made.clear()
    assert generate(changed(count=None, instances=2), out) == manifest
    assert PaintedMaker.made == []
    assert generate(changed(count=None, instances=3), out)["images"] == 20  # image 17 shows the third


def test_a_part_that_never_shows_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(PaintedMaker, "absent", ("top",))
    monkeypatch.setattr("scenes.generate.BARREN", 4)
    with pytest.raises(SceneError, match="none of the first 12 images shows top"):
        generate(changed(count=None, instances=2), tmp_path / "data")
    assert PaintedMaker.made == list(range(12))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"seed": 9}, "seed 7, not 9"),
        ({"jpeg": 90}, "jpeg none, not 90"),
        ({"count": None, "instances": 5}, "count 10, not none; instances none, not 5"),
        ({"parts": ("main", "top")}, "parts inserted, main, top, not main, top"),
        ({"sensor": SensorRanges(gradient=0.0)}, "sensor.gradient 0.1, not 0.0"),
    ],
)
def test_other_settings_are_named_with_both_values(whole, changes, told):
    with pytest.raises(
        SceneError, match=rf"holds another data set, made with {told}\. Choose another folder with --out"
    ):
        generate(changed(**changes), whole)


def test_another_version_of_the_generator_is_refused(whole, monkeypatch):
    monkeypatch.setattr("scenes.dataset_folder.GENERATOR", GENERATOR + 1)
    with pytest.raises(SceneError, match=f"generator {GENERATOR}, not {GENERATOR + 1}"):
        generate(CONFIG, whole)


def test_settings_that_came_later_leave_earlier_data_sets_what_they_are():
    """They are told apart only where they change the images."""
    none = TRAIN_SHOTS.empty_beside_px
    assert none is None and "empty_beside_px" not in identity(CONFIG)["shots"]
    beside = replace(TRAIN_SHOTS, target_share=0.0, empty_beside_px=(40, 130))
    assert identity(changed(shots=beside))["shots"]["empty_beside_px"] == [40, 130]
    frame = DatasetConfig(kind="scene", domain="mitsuba")
    assert "samples" not in identity(frame)
    assert identity(replace(frame, size=(5472, 3648)))["samples"]["ground"] == GROUND_SAMPLES
    assert "samples" not in identity(replace(frame, size=(5472, 3648), domain="classic"))


def test_a_folder_with_other_things_in_it_is_refused(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(SceneError, match=r"is not empty and holds no dataset\.json"):
        generate(CONFIG, tmp_path)
    with pytest.raises(SceneError, match="is a file"):
        generate(CONFIG, tmp_path / "letter.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["letter.txt"]


def test_two_runs_do_not_write_into_one_folder(whole):
    with opened(CONFIG, whole), pytest.raises(SceneError, match=rf"process {os.getpid()} on .* writes into"):
        generate(CONFIG, whole)
    assert not (whole / LOCK).exists()
    (whole / LOCK).write_text("process 1 on elsewhere\n")  # left by one that was killed
    generate(CONFIG, whole)


def test_a_full_disk_leaves_nothing_half_written_under_a_final_name(whole, tmp_path, monkeypatch):
    out, write = tmp_path / "data", Path.write_bytes

    def full(self, content):
        if self.name == "000002.png" and self.parent.parent.name.startswith(".000001"):
            write(self, content[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self))
        return write(self, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        SceneError, match=r"(?s)No space left on device.*000002\.png.*1 of 3 shards are finished and kept"
    ):
        generate(CONFIG, out)
    assert [p.name for p in (out / "val").iterdir()] == ["000000"]
    monkeypatch.setattr(Path, "write_bytes", write)
    generate(CONFIG, out)
    assert files(out) == files(whole)


def test_damage_is_found_and_mended(whole, tmp_path):
    out = tmp_path / "data"
    shutil.copytree(whole, out)
    damaged = out / "val" / "000001"
    (damaged / "rgb" / "000000.png").write_bytes(b"rubbish")
    (damaged / "depth" / "000003.png").unlink()
    with pytest.raises(SceneError) as found:
        generate(CONFIG, out, verify=True)
    assert "rgb/000000.png was changed" in str(found.value) and "depth/000003.png is missing" in str(found.value)
    assert f"delete {damaged}" in str(found.value)
    shutil.rmtree(damaged)
    generate(CONFIG, out, verify=True)
    assert files(out) == files(whole)


def test_the_time_left_follows_from_this_runs_rate():
    progress = Progress(done=150, total=250, made=50, seconds=10.0)
    assert (progress.rate, progress.seconds_left) == (5.0, 20.0)
    assert Progress(done=100, total=250, made=0, seconds=3.0).seconds_left is None


def test_less_than_one_worker_is_refused(tmp_path):
    with pytest.raises(SceneError, match="jobs 0"):
        generate(CONFIG, tmp_path / "data", jobs=0)
    assert not (tmp_path / "data").exists()


def test_a_worker_that_dies_is_told_with_what_to_do(tmp_path):
    with opened(CONFIG, tmp_path / "data") as split, closing(Processes(CONFIG, split, 1)) as workers:
        workers.submit(Shard(index=0, first=0, count=4))
        os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)
        with pytest.raises(SceneError, match=r"a worker died \(signal 9.*run the same command again"):
            while not workers.finished():
                pass
