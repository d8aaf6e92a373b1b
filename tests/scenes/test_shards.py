"""A shard is complete under its own name or not there at all, and tells when it was changed."""

import json
import subprocess

import pytest

from scenes.errors import SceneError
from scenes.shards import images_in, instances_in, read_sums, shard_digest, shard_problems, written_aside


def fill(folder, images=2):
    (folder / "rgb").mkdir()
    for i in range(images):
        (folder / "rgb" / f"{i:06d}.png").write_bytes(bytes([i]))
    (folder / "scene_gt.json").write_text(json.dumps({"0": [{"obj_id": 1}, {"obj_id": 2}], "1": [{"obj_id": 1}]}))
    infos = {"0": [{"visib_fract": 0.1}, {"visib_fract": 0.09}], "1": [{"visib_fract": 1.0}]}
    (folder / "scene_gt_info.json").write_text(json.dumps(infos))


@pytest.fixture
def shard(tmp_path):
    with written_aside(tmp_path / "000003") as folder:
        fill(folder)
        assert [p.name for p in tmp_path.iterdir()] == [folder.name]
        assert folder.name.startswith(".000003.") and folder.name.endswith(".partial")
    return tmp_path / "000003"


def test_a_shard_gets_its_name_with_sums_that_sha256sum_reads(shard):
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=shard, check=True)
    assert list(read_sums(shard)) == ["rgb/000000.png", "rgb/000001.png", "scene_gt.json", "scene_gt_info.json"]
    assert [p.name for p in shard.parent.iterdir()] == ["000003"]
    assert shard_problems(shard) == []


def test_what_is_interrupted_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), written_aside(tmp_path / "000000") as folder:
        fill(folder)
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_of_two_attempts_the_first_complete_one_stays(shard):
    first = shard_digest(shard)
    with written_aside(shard) as folder:
        fill(folder, images=1)
    assert shard_digest(shard) == first
    assert [p.name for p in shard.parent.iterdir()] == ["000003"]


def test_attempts_of_one_shard_do_not_meet(tmp_path):
    with written_aside(tmp_path / "000000") as one, written_aside(tmp_path / "000000") as other:
        assert one != other
        fill(one)
        fill(other)
    assert [p.name for p in tmp_path.iterdir()] == ["000000"]


def test_a_folder_that_is_no_shard_is_not_taken_for_one(tmp_path):
    (tmp_path / "000000").mkdir()
    (tmp_path / "000000" / "mine.txt").write_text("mine")
    with pytest.raises(OSError, match="not empty"), written_aside(tmp_path / "000000") as folder:
        fill(folder)
    with pytest.raises(SceneError, match="no complete shard"):
        images_in(tmp_path / "000000")
    assert [p.name for p in tmp_path.iterdir()] == ["000000"]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda s: (s / "rgb/000001.png").unlink(), "rgb/000001.png is missing"),
        (lambda s: (s / "rgb/000001.png").write_bytes(b"x"), "rgb/000001.png was changed"),
        (lambda s: (s / "rgb/000002.png").write_bytes(b"x"), "rgb/000002.png was not made with the shard"),
        (lambda s: (s / "SHA256SUMS").unlink(), "is no complete shard"),
        (lambda s: (s / "SHA256SUMS").write_text("rubbish\n"), "is no complete shard"),
    ],
)
def test_every_change_is_found_and_the_remedy_named(shard, spoil, told):
    spoil(shard)
    (problem,) = shard_problems(shard)
    assert told in problem
    assert f"delete {shard} and render again" in problem


def test_images_and_instances_that_are_seen_are_counted(shard):
    assert images_in(shard) == 2
    assert instances_in(shard) == {1: 2}  # less than a tenth is seen of the other one
    (shard / "scene_gt_info.json").write_text("{")
    with pytest.raises(SceneError, match=r"labels of .* cannot be read"):
        instances_in(shard)
