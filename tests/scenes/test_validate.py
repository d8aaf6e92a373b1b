"""The check of data sets: nothing is wrong with what is generated, and whatever is changed is found and named."""

import json
import shutil

import cv2
import numpy as np
import pytest

from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.generate import generate
from scenes.shards import write_sums
from scenes.validate import validate

CONFIG = DatasetConfig(kind="window", split="test", count=4, shard=2, seed=4, parts=("main", "top"))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "set"
    generate(CONFIG, out)
    return out


@pytest.fixture
def ours(made, tmp_path):
    return shutil.copytree(made, tmp_path / "ours")


@pytest.fixture
def foreign(ours):
    """The same as anybody's BOP data set: without our files and keys."""
    for name in ("dataset.json", "manifest.json", "camera.json", "rests.npz", "models/keypoints.json"):
        (ours / name).unlink()
    for shard in ours.glob("test/*"):
        (shard / "SHA256SUMS").unlink()
        edit(shard / "scene_gt.json", each(lambda entry: entry.pop("stable_pose")))
    return ours


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def each(change):
    """Applies a change to every entry of every image."""
    return lambda content: [change(e) for v in content.values() for e in (v if isinstance(v, list) else [v])]


def scaled(key, factor):
    def change(entry):
        value = entry[key]
        entry[key] = [factor * x for x in value] if isinstance(value, list) else factor * value

    return each(change)


def told(folder, sample=0):
    report = validate(folder, sample=sample)
    assert report.ok == (not report.problems)
    return "\n".join(map(str, report.problems))


def a_part(folder):
    """Folder, image id and number of a part that is well visible, and the file name of its masks."""
    for shard in sorted(folder.glob("test/*")):
        for image, infos in json.loads((shard / "scene_gt_info.json").read_text()).items():
            for k, info in enumerate(infos):
                (x, y, w, h), visible = info["bbox_obj"], info["visib_fract"] == 1
                if visible and min(x, y) > 10 and max(x + w, y + h) < 310 and info["px_count_all"] > 400:
                    return shard, image, k, f"{int(image):06d}_{k:06d}.png"
    raise AssertionError("no part is well visible")


def test_nothing_is_wrong_with_what_was_generated(made):
    report = validate(made)
    assert str(report).endswith("nothing is wrong"), str(report)
    assert report.counts["folders"] == 2 and report.counts["images"] == 4 and report.counts["models"] == 2
    assert report.counts["parts"] >= 4 and report.counts["images compared with their labels"] == 4
    assert validate(made, sample=2).counts["images compared with their labels"] == 2
    content = json.loads(json.dumps(report.to_json()))
    assert content["ok"] and content["problems"] == []


def test_foreign_data_sets_are_checked_too(foreign):
    assert told(foreign, 4) == ""
    for shard in foreign.glob("test/*"):
        for name in ("scene_gt_coco.json", "scene_gt_info.json"):
            (shard / name).unlink()
        shutil.rmtree(shard / "mask")
        shutil.rmtree(shard / "depth")
    assert told(foreign, 4) == ""
    edit(foreign / "test" / "000001" / "scene_gt.json", scaled("cam_t_m2c", 1e-3))
    assert "seems to be in metres; write translations in millimetres" in told(foreign)


def test_what_is_no_data_set_is_refused(tmp_path):
    with pytest.raises(SceneError, match="holds no images in BOP layout"):
        validate(tmp_path)


@pytest.mark.parametrize("name", ["000000/rgb/000001.png", "000001/scene_gt.json", "000000/mask/000000_000000.png"])
def test_a_changed_byte_is_found(ours, name):
    path = ours / "test" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert f"{name}" in told(ours) and "was changed" in told(ours)


def test_missing_and_unlisted_files_are_found(ours):
    (ours / "test" / "000000" / "rgb" / "000001.png").unlink()
    (ours / "test" / "000001" / "mask" / "000009_000000.png").write_bytes(b"")
    (ours / "letter.txt").write_text("mine")
    (ours / "test" / "more").mkdir()
    found = told(ours)
    assert "000000/rgb: 000001 is missing" in found.replace(", image 000001", "")
    assert "000009_000000.png belongs to no label" in found and "000009_000000.png was not made with" in found
    assert "letter.txt: was not made with the data set" in found
    assert "test/more: is no part of the data set" in found


def test_unfinished_and_rearranged_sets_are_found(ours):
    shutil.copytree(ours / "test" / "000001", ours / "test" / "000002")
    found = told(ours)
    assert "test/000002: is not listed in manifest.json" in found
    assert "has the id of one in" not in found.split("000002/scene_gt_coco")[0]
    assert "images 1000 has the id of one in" in found
    shutil.rmtree(ours / "test" / "000002")
    shutil.rmtree(ours / "test" / "000001")
    assert "test/000001: is missing though manifest.json lists it" in told(ours)
    (ours / "manifest.json").unlink()
    assert "manifest.json: is missing: the data set is not finished; render the data set again" in told(ours)


def test_a_shard_that_was_made_anew_is_found(ours):
    shard = ours / "test" / "000000"
    (shard / "scene_gt.json").write_text((shard / "scene_gt.json").read_text() + "\n")
    write_sums(shard)
    assert "test/000000: SHA256SUMS is not the one that manifest.json lists" in told(ours)


@pytest.mark.parametrize(
    ("name", "key", "factor", "says"),
    [
        ("scene_gt", "cam_t_m2c", 1e-3, "seems to be in metres; write translations in millimetres"),
        ("scene_gt", "cam_t_m2c", 1e3, "seems to be in micrometres; write translations in millimetres"),
        ("scene_camera", "cam_t_w2c", 1e-3, "cam_t_w2c is 0.7"),
        ("scene_camera", "depth_scale", 1e-3, "is not the millimetres of a unit of depth"),
        ("scene_camera", "depth_scale", 1e3, "mm from where its pose has it, 1e+03 times as far"),
        ("scene_camera", "depth_scale", 5.0, "mm from where its pose has it, 5 times as far"),
    ],
)
def test_wrong_units_are_found(foreign, name, key, factor, says):
    for shard in foreign.glob("test/*"):
        edit(shard / f"{name}.json", scaled(key, factor))
    assert says in told(foreign, 2)


@pytest.mark.parametrize(
    ("factor", "says"), [(1e-3, "it seems to be in metres"), (1e3, "it seems to be in micrometres")]
)
def test_models_in_another_unit_are_found(foreign, factor, says):
    edit(foreign / "models" / "models_info.json", scaled("diameter", factor))
    found = told(foreign)
    assert says in found and f"the mesh is {1 / factor:.3g} times as large as told" in found


def test_a_model_that_is_not_the_one_in_the_images_is_found(foreign):
    for name in ("obj_000002.ply", "models_info.json"):
        (foreign / "models" / name).write_bytes((foreign / "models" / name).read_bytes())
    a, b = (foreign / "models" / f"obj_{i:06d}.ply" for i in (2, 3))
    swapped = a.read_bytes(), b.read_bytes()
    a.write_bytes(swapped[1])
    b.write_bytes(swapped[0])
    edit(foreign / "models" / "models_info.json", lambda infos: infos.update({"2": infos["3"], "3": infos["2"]}))
    assert "in its pose disagrees in" in told(foreign, 4)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ({"symmetries_discrete": [[1, 0, 0]]}, r"symmetries_discrete[0] of object 2 is not 16 numbers"),
        ({"symmetries_discrete": [[2.0, *[0] * 15]]}, "is no proper rotation"),
        ({"symmetries_discrete": [[-1, 0, 0, 900, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}, "the unit is wrong"),
        ({"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [0, 0, 0]}]}, "is 2 long, not 1"),
        ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, "lacks axis or offset"),
        ({"diameter": "large"}, "object 2 lacks the numbers diameter"),
    ],
)
def test_models_info_is_checked(foreign, entry, says):
    edit(foreign / "models" / "models_info.json", lambda infos: infos["2"].update(entry))
    assert says in told(foreign)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("scene_gt", lambda e: e.pop("cam_R_m2c"), "cam_R_m2c and cam_t_m2c are not 9 and 3 numbers"),
        ("scene_gt", lambda e: e.update(cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1]), "is no rotation"),
        ("scene_gt", lambda e: e.update(obj_id=77), "obj_id 77 is none of the models (2, 3)"),
        ("scene_gt", lambda e: e.update(obj_id="2"), "obj_id '2' is no whole number"),
        ("scene_gt", lambda e: e.update(stable_pose=-2), "stable_pose -2 is no face"),
        ("scene_gt", lambda e: e.update(cam_t_m2c=[0, 0, -700]), "is behind the camera"),
        ("scene_gt_info", lambda e: e.update(px_count_visib=10**6), "1000000 visible"),
        ("scene_gt_info", lambda e: e.update(visib_fract=0.4321), "visib_fract 0.4321 is not"),
        ("scene_gt_info", lambda e: e.update(bbox_visib=[1, 2, 3]), "lacks bbox_obj or bbox_visib of 4 numbers"),
        ("scene_gt_info", lambda e: e.update(bbox_visib=[1, 2, 3, 4]), "bbox_visib [1, 2, 3, 4], mask"),
        ("scene_gt_info", lambda e: e.update(bbox_obj=[1, 2, 3, 4]), "bbox_obj [1, 2, 3, 4], mask"),
        ("scene_camera", lambda e: e.update(cam_K=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "cam_K is no camera matrix"),
        ("scene_camera", lambda e: e.pop("cam_t_w2c"), "has one of cam_R_w2c and cam_t_w2c without the other"),
    ],
)
def test_entries_are_checked(foreign, name, change, says):
    edit(foreign / "test" / "000000" / f"{name}.json", each(change))
    report = validate(foreign, sample=4 if "mask" in says else 0)
    found = [problem for problem in report.problems if says in str(problem)]
    assert found and found[0].file == f"test/000000/{name}.json" and found[0].image and found[0].remedy


def test_lengths_and_images_must_agree(foreign):
    shard = foreign / "test" / "000000"
    edit(shard / "scene_gt.json", lambda content: content.pop("1"))
    edit(shard / "scene_gt_info.json", lambda content: content["0"].append(content["0"][0] if content["0"] else {}))
    found = told(foreign)
    assert "scene_gt.json, image 1: has no entry for an image that others have" in found
    assert "scene_gt_info.json, image 0: is not the facts of the" in found
    (shard / "scene_camera.json").write_text("[")
    assert "scene_camera.json: cannot be read" in told(foreign, 4)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda c: c["annotations"][1].update(id=c["annotations"][0]["id"]),
            "ids of annotations are not all different",
        ),
        (lambda c: c["annotations"][0].update(category_id=9), "category 9 is not listed"),
        (lambda c: c["annotations"][0].update(area=1), "area 1, scene_gt_info.json has"),
        (lambda c: c["annotations"][0]["segmentation"].update(size=[3, 4]), "no run-length code of the image's size"),
        (lambda c: c["annotations"][0].update(keypoints=[1, 2, 2]), "keypoints are not u, v, v for each"),
        (lambda c: c["annotations"][0].update(image_id=555), "is of no image: 555"),
        (lambda c: c["annotations"].pop(), "is visible but has no annotation"),
        (lambda c: c["images"][0].update(file_name="rgb/no.png"), "which is no image here"),
        (lambda c: c.pop("categories"), "lacks the lists categories"),
        (lambda c: c["images"].append([]), "no objects with a whole number as id"),
    ],
)
def test_coco_files_are_checked(ours, change, says):
    path = ours / "test" / "000000" / "scene_gt_coco.json"
    edit(path, change)
    write_sums(path.parent)
    assert says in told(ours)


def test_masks_that_are_not_the_labels_are_found(foreign):
    shard, image, _, name = a_part(foreign)
    path = shard / "mask_visib" / name
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    moved = np.roll(mask, 6, axis=1)
    cv2.imwrite(str(path), moved)
    found = told(foreign, 4)
    assert f"mask_visib/{name}, image {image}: shows" in found and "pixels that mask/ does not" in found
    assert "its runs are not mask_visib" in found and "bbox_visib" in found
    cv2.imwrite(str(shard / "mask" / name), moved)
    assert f"mask/{name}, image {image}: object" in told(foreign, 4)
    cv2.imwrite(str(path), mask // 255)
    assert "not 8 bits of 0 and 255" in told(foreign, 4)


def test_depth_and_images_that_are_not_the_labels_are_found(foreign):
    shard, image, _, _ = a_part(foreign)
    path = shard / "depth" / f"{int(image):06d}.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), depth + np.uint16(50))  # one millimetre
    found = told(foreign, 4)
    assert "is +1.0" in found and "mm from where its pose has it; write depth again" in found
    cv2.imwrite(str(path), (depth >> 8).astype(np.uint8))
    assert "not 16 bits of (320, 320)" in told(foreign, 4)
    path = shard / "rgb" / f"{int(image):06d}.png"
    path.write_bytes(b"no image")
    assert f"rgb/{path.name}, image {image}: is no image that can be read" in told(foreign, 4)


def test_a_pose_in_another_frame_is_found(foreign):
    for shard in foreign.glob("test/*"):
        edit(
            shard / "scene_gt.json",
            each(lambda e: e.update(cam_R_m2c=np.reshape(e["cam_R_m2c"], (3, 3)).T.ravel().tolist())),
        )
    assert "check unit, direction and frame of the poses" in told(foreign, 4)


def test_many_like_problems_are_gathered(foreign):
    for shard in foreign.glob("test/*"):
        edit(shard / "scene_gt.json", scaled("cam_t_m2c", 1e-3))
    report = validate(foreign, sample=0)
    assert len([p for p in report.problems if p.file.endswith("scene_gt.json")]) <= 12
    assert any("more problems like the last" in p.what for p in report.problems)
