"""A part's file becomes a folder that everything reads, or nothing at all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cad.materials import MATERIALS, MaterialError, material
from cad.meshes import MeshError
from cad.parts import BUILT_IN, PartError, load_part, part_names
from twin import new_part
from twin.cli import main
from twin.new_part import NewPartConfig, NewPartError, add_part, remove_part
from twin.part_cli import PartAdd

EXAMPLES = Path(__file__).parents[2] / "examples" / "parts"
FILES = ("mesh.ply", "part.json", "symmetries.json", "collision.json", "stable_poses.json", "keypoints.json")


def block(path: Path, sides_mm: tuple[float, float, float] = (6.0, 5.0, 3.0)) -> Path:
    trimesh.creation.box(sides_mm).export(path)
    return path


@pytest.fixture(scope="module")
def brick(tmp_path_factory):
    root = tmp_path_factory.mktemp("own")
    stages: list[str] = []
    config = NewPartConfig(file=block(root.parent / "brick.STL"), name="brick", parts_dir=root, drops=1000)
    return root, add_part(config, stages.append), stages


def test_a_file_becomes_a_whole_part(brick):
    root, added, stages = brick
    assert sorted(p.name for p in root.iterdir() if p.is_dir()) == ["brick"]
    for file in (*FILES, "grasps.json", "preview.png", "source.stl"):
        assert (root / "brick" / file).is_file(), file
    assert list(added.seconds) == stages
    part = load_part("brick", root)
    assert part.obj_id == 1 + max(load_part(name).obj_id for name in BUILT_IN)
    assert part_names(root) == [*BUILT_IN, "brick"]
    assert len(part.symmetries.elements) == 4
    assert part.keypoints.shape == (8, 3)
    assert part.mass_kg == pytest.approx(part.mesh.volume * MATERIALS["steel"].density_kg_m3)
    assert sum(pose.probability for pose in part.stable_poses) > 0.995


def test_every_pose_of_a_brick_can_be_gripped(brick):
    _, added, _ = brick
    assert {grasp["stable_pose"] for grasp in added.part.grasps} == {pose.index for pose in added.part.stable_poses}


def test_a_failing_run_leaves_the_part_of_that_name_as_it_was(brick, tmp_path):
    root, added, _ = brick
    config = {"file": EXAMPLES / "hex_nut.step", "name": "brick", "parts_dir": root, "drops": 1000}
    with pytest.raises(NewPartError, match="--replace"):
        add_part(NewPartConfig(**config))
    broken = tmp_path / "broken.step"
    broken.write_text("ISO-10303-21;")
    with pytest.raises(MeshError):
        add_part(NewPartConfig(**config | {"file": broken, "replace": True}))
    assert load_part("brick", root).mesh_hash == added.part.mesh_hash


def test_a_weighed_part_has_its_mass_and_keeps_its_number_when_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(new_part, "write_grasps", lambda part: None)
    file = block(tmp_path / "block.stl")
    config = NewPartConfig(file=file, name="block", mass_g=0.5, parts_dir=tmp_path / "own", drops=1000)
    first = add_part(config).part
    assert first.mass_kg == pytest.approx(0.5e-3)
    again = add_part(
        NewPartConfig(
            file=file,
            name="block",
            material="nylon",
            density=1500.0,
            replace=True,
            parts_dir=config.parts_dir,
            drops=1000,
        )
    ).part
    assert again.obj_id == first.obj_id
    assert again.mass_kg == pytest.approx(1500.0 * 90e-9)
    gone = remove_part("block", config.parts_dir)
    assert not gone.exists() and part_names(config.parts_dir) == list(BUILT_IN)
    with pytest.raises(PartError, match="block"):
        load_part("block", config.parts_dir)


def test_a_part_without_grasps_is_shown(brick, tmp_path, capsys):
    shutil.copytree(brick[0] / "brick", tmp_path / "brick")
    (tmp_path / "brick" / "grasps.json").unlink()
    main(["part", "show", "brick", "--parts-dir", str(tmp_path)])
    text = capsys.readouterr().out
    assert "1 convex piece (hull)" in text and text.count("none") == 3
    main(["part", "show", "brick", "--parts-dir", str(tmp_path), "--json"])
    shown = json.loads(capsys.readouterr().out)
    assert shown["grasps"] == 0 and [pose["grasps"] for pose in shown["stable_poses"]] == [0, 0, 0]


def test_a_stopped_run_leaves_nothing_behind(tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(new_part, "stable_pose_report", stop)
    file = block(tmp_path / "block.stl")
    with pytest.raises(SystemExit) as stopped:
        main(["part", "add", str(file), "--name", "block", "--parts-dir", str(tmp_path / "own")])
    assert stopped.value.code == 130
    assert capsys.readouterr().err.endswith("tagcell: stopped; no part was added\n")
    assert list((tmp_path / "own").iterdir()) == []


def test_what_a_killed_run_left_is_swept_away(tmp_path):
    left = tmp_path / ".adding-4194305-abc"  # above the largest process number
    (left / "x").mkdir(parents=True)
    with new_part._aside(tmp_path, "y") as folder:
        assert folder.is_dir() and not left.exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.step", "--name", "x"], "none.step"),
        (["FILE", "--name", "2x"], "letters, digits and underscores"),
        (["FILE", "--name", "main"], "built-in"),
        (["FILE", "--name", "x", "--material", "cheese"], "nylon"),
        (["FILE", "--name", "x", "--mass-g", "1", "--density", "2"], "one of them"),
        (["FILE", "--name", "x", "--mass-g", "-1"], "must be positive"),
        (["FILE", "--name", "x", "--unit", "m"], "--accept-size"),
        (["FILE", "--name", "x", "--seed", "-1"], "--seed -1"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(capsys, tmp_path, arguments, said):
    file = block(tmp_path / "block.stl")
    own = tmp_path / "own"
    words = [str(file) if a == "FILE" else a for a in arguments]
    with pytest.raises(SystemExit) as stopped:
        main(["part", "add", *words, "--parts-dir", str(own)])
    text = capsys.readouterr().err
    assert stopped.value.code == 1
    assert said in text and text.strip().splitlines()[-1].startswith("tagcell: ")
    assert not own.exists() or not any(own.iterdir())


def test_built_in_parts_cannot_be_removed(capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["part", "remove", "main", "--parts-dir", str(tmp_path)])
    assert "built in" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["part", "remove", "../main", "--parts-dir", str(tmp_path)])
    assert "not among your parts" in capsys.readouterr().err


def test_the_help_names_every_material():
    help_text = " ".join(str(PartAdd.__doc__).split()) + Path(new_part.__file__).with_name("part_cli.py").read_text()
    assert all(name in help_text for name in MATERIALS)
    with pytest.raises(MaterialError, match="brass"):
        material("brasss")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["m2_screw", "hex_nut", "pin_header", "bracket"])
def test_a_new_part_is_picked_by_the_oracle(tmp_path, capsys, name):
    main(["part", "add", str(EXAMPLES / f"{name}.step"), "--name", name, "--parts-dir", str(tmp_path)])
    common = ["--parts-dir", str(tmp_path), "--out", str(tmp_path / "out"), "--no-pictures", "--json"]
    capsys.readouterr()
    main(["pick", "--parts", name, "--estimator", "oracle", "--scenes", "4", "--parts-per-class", "3", *common])
    card = json.loads(capsys.readouterr().out)
    assert (tmp_path / name / "source.step").is_file()
    gripped = {grasp["stable_pose"] for grasp in load_part(name, tmp_path).grasps}
    share = sum(p.probability for p in load_part(name, tmp_path).stable_poses if p.index in gripped)
    assert card["picks"]["success_rate"] >= np.floor(12 * share * 0.9) / 12
