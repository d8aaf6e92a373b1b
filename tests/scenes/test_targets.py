"""The list of what is to be found in the images of a test set says what their labels say."""

import json

import pytest
from painted import PaintedMaker

from scenes.dataset_config import DatasetConfig
from scenes.generate import generate
from scenes.ranges import Split
from scenes.targets import TARGETS
from scenes.validate import validate


def config(count=6, split: Split = "test"):
    return DatasetConfig(kind="crop", split=split, size=(32, 32), downscale=4, count=count, shard=4, seed=7)


@pytest.fixture(autouse=True)
def painted(monkeypatch):
    """Quick images; too little is seen of the parts in image 2."""
    monkeypatch.setattr("scenes.workers.ImageMaker", PaintedMaker)


@pytest.fixture
def made(tmp_path):
    out = tmp_path / "data"
    generate(config(), out)
    return out


def read(folder):
    return json.loads((folder / TARGETS).read_text())


def change(folder, edit):
    targets = read(folder)
    edit(targets)
    (folder / TARGETS).write_text(json.dumps(targets))


def told(folder):
    return "\n".join(str(p) for p in validate(folder, sample=0).problems if p.file == TARGETS)


def as_anybodys(folder):
    for name in ("dataset.json", "manifest.json"):
        (folder / name).unlink()
    return folder


def test_targets_are_the_instances_that_are_seen(made):
    where = [(t["scene_id"], t["im_id"], t["obj_id"]) for t in read(made)]
    assert where == [(0, 0, 1), (0, 1, 1), (0, 1, 2), (0, 3, 1), (1, 0, 1), (1, 0, 2), (1, 1, 1), (1, 1, 2), (1, 1, 3)]
    manifest = json.loads((made / "manifest.json").read_text())
    assert sum(t["inst_count"] for t in read(made)) == sum(manifest["instances"].values())
    assert told(made) == ""


def test_several_of_one_kind_are_one_target(made):
    for name in ("scene_gt", "scene_gt_info"):
        path = made / "test" / "000000" / f"{name}.json"
        content = json.loads(path.read_text())
        content["0"] = content["0"] * 3
        path.write_text(json.dumps(content))
    generate(config(), made)
    assert read(made)[0] == {"scene_id": 0, "im_id": 0, "obj_id": 1, "inst_count": 3}


def test_a_longer_set_has_the_targets_of_one_made_at_once(made, tmp_path):
    generate(config(10), made)
    generate(config(10), tmp_path / "at once")
    assert (made / TARGETS).read_bytes() == (tmp_path / "at once" / TARGETS).read_bytes()


def test_only_test_sets_have_targets(tmp_path):
    generate(config(split="val"), tmp_path)
    assert not (tmp_path / TARGETS).exists()
    assert told(tmp_path) == ""


@pytest.mark.parametrize(
    ("edit", "of_ours", "of_others"),
    [
        (lambda targets: targets.pop(), "entry 8 is None, the labels say {'scene_id': 1", ""),
        (lambda targets: targets.reverse(), "entry 0 is {'scene_id': 1", ""),
        (lambda targets: targets[0].update(inst_count=9), "'inst_count': 9", "lists 9 instances of object 1"),
        (lambda targets: targets[0].update(im_id=77), "'im_id': 77", "image 77: scene 0 lists 1 instances"),
        (lambda targets: targets[0].update(obj_id="2"), "whole numbers scene_id", "whole numbers scene_id"),
    ],
)
def test_targets_that_are_not_the_labels_are_found(made, edit, of_ours, of_others):
    change(made, edit)
    assert of_ours in told(made)
    others = told(as_anybodys(made))
    assert of_others in others if of_others else others == ""


def test_a_test_set_needs_its_targets_and_others_do_not(made):
    (made / TARGETS).unlink()
    assert "cannot be read" in told(made)
    assert told(as_anybodys(made)) == ""
