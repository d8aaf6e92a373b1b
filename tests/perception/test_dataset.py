import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from data_sets import Picture, patch, write_data_set

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose, planar
from cad.spatial import BASLER, Array, Intrinsics, inverse, rotation_from_rotvec, rotation_x, rotation_y, transform
from perception.calibration import table_from_board
from perception.dataset import load_crops, load_windows
from perception.estimates import PerceptionError

SIZE = 64
WINDOW = BASLER.crop(2700, 1700, 2 * SIZE, 2 * SIZE).downscaled(2)
T_CAM_BOARD = inverse(
    transform(rotation_x(np.pi), [0.0, 0.0, 0.7]) @ transform(rotation_from_rotvec([0.01, 0.005, 0.3]))
)
X, Y, YAW = 0.0004, -0.0003, 0.8


def part(obj_id: int) -> Part:
    """A 4 x 6 x 2 mm block with two faces to rest on."""
    rotations = [np.eye(3), rotation_y(np.pi / 2)]
    heights = [1e-3, 2e-3]
    return Part(
        name=f"block{obj_id}",
        obj_id=obj_id,
        folder=Path(),
        mass_kg=1e-3,
        material="steel",
        rgba=(0.5, 0.5, 0.5, 1.0),
        metallic=1.0,
        roughness=0.5,
        mesh=trimesh.creation.box((4e-3, 6e-3, 2e-3)),
        symmetries=Symmetries(),
        stable_poses=tuple(
            StablePose(index=i, R_table_part=R, t_table_part=np.array([0.0, 0.0, h]), probability=0.5, view_class=i)
            for i, (R, h) in enumerate(zip(rotations, heights, strict=True))
        ),
        keypoints=np.eye(8, 3) * 1e-3,
        mesh_hash="0" * 16,
    )


PARTS = [part(4), part(9)]


def pose_of(k: int) -> Array:
    return table_from_board(T_CAM_BOARD) @ planar(X, Y, YAW) @ PARTS[0].stable_poses[k].T_table_part


def picture(i: int, parts: list[tuple[int, int]], size: int = SIZE) -> Picture:
    """An image with parts of these (obj_id, stable_pose); part k is a 5-pixel square at (10 k, 8)."""
    rgb = np.full((size, size, 3), (10 + i, 20, 30), np.uint8)
    annotations = [patch(obj_id, face, pose_of(face), 10 * k, 8) for k, (obj_id, face) in enumerate(parts)]
    return Picture(rgb, WINDOW, T_CAM_BOARD, annotations)


def write_split(folder: Path, instances: list[list[tuple[int, int]]], jpeg: int | None = None) -> Path:
    """A data set with one image per list of parts."""
    return write_data_set(folder, "val", PARTS, [picture(i, parts) for i, parts in enumerate(instances)], jpeg)


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return write_split(tmp_path / "train", [[(4, 1), (9, 0)], [], [(9, 0)]])


def test_crops_hold_their_first_instance(split: Path) -> None:
    crops = load_crops(split)
    assert crops.images.shape == (3, SIZE, SIZE, 3) and crops.images[1, 0, 0].tolist() == [11, 20, 30]
    assert crops.obj_id.tolist() == [4, 0, 9] and crops.stable_pose.tolist() == [1, -1, 0]
    np.testing.assert_allclose(crops.T_cam_part[0], pose_of(1), atol=1e-12)
    np.testing.assert_allclose(crops.T_cam_board, np.stack([T_CAM_BOARD] * 3), atol=1e-12)
    masks = crops.masks()
    assert masks.shape == (3, SIZE, SIZE) and masks.sum((1, 2)).tolist() == [25, 0, 25]
    assert masks[0, 8:13, :5].all()
    np.testing.assert_array_equal(crops.masks(np.array([2, 0])), masks[[2, 0]])


def test_where_no_crop_has_a_target_parts_beside_the_middle_are_none(split: Path) -> None:
    dataset = json.loads((split / "dataset.json").read_text())
    (split / "dataset.json").write_text(json.dumps(dataset | {"shots": {"target_share": 0.0}}))
    crops = load_crops(split)
    assert not crops.obj_id.any() and not crops.masks().any() and (crops.stable_pose == -1).all()
    assert len(load_windows(split).obj_id) == 3


def test_resting_poses_come_back_from_the_poses(split: Path) -> None:
    labels = load_crops(split).labels(PARTS)
    assert labels.part_index.tolist() == [0, -1, 1]
    for m in (0, 2):
        np.testing.assert_allclose([labels.x[m], labels.y[m], labels.yaw[m]], [X, Y, YAW], atol=1e-9)
    assert np.isnan(labels.yaw[1]) and np.isnan(labels.centre_px[1]).all()
    T_cam_table = table_from_board(T_CAM_BOARD)
    for z, seen in ((0.0, labels.centre_px[0]), (2e-3, labels.body_px[0])):
        np.testing.assert_allclose(seen, WINDOW.project((T_cam_table @ [X, Y, z, 1.0])[:3]), atol=1e-6)


def test_windows_hold_all_instances(split: Path) -> None:
    windows = load_windows(split)
    assert len(windows) == 3
    assert [rows.tolist() for rows in windows.instances_of] == [[0, 1], [], [2]]
    assert windows.image_index.tolist() == [0, 0, 2] and windows.obj_id.tolist() == [4, 9, 9]
    assert np.bincount(windows.instance_map[0].ravel()).tolist() == [SIZE * SIZE - 50, 25, 25]
    assert windows.instance_map[0, 8, 10] == 2 and not windows.instance_map[1].any()
    assert windows.labels(PARTS).yaw == pytest.approx([YAW] * 3)


def test_the_cache_gives_the_same_and_follows_the_manifest(split: Path) -> None:
    first = load_windows(split)
    (split / "val" / "000000" / "scene_gt.json").unlink()
    again = load_windows(split)
    np.testing.assert_array_equal(first.images, again.images)
    np.testing.assert_array_equal(first.T_cam_part, again.T_cam_part)
    (split / "manifest.json").write_text(json.dumps({"images": 3, "instances": {}}))
    with pytest.raises(PerceptionError, match="scene_gt"):
        load_windows(split)


def test_a_data_set_without_manifest_or_unfinished_is_not_read(split: Path) -> None:
    (split / "manifest.json").write_text(json.dumps({"images": 500}))
    with pytest.raises(PerceptionError, match="holds 3 of the 500 images"):
        load_crops(split)
    (split / "manifest.json").unlink()
    with pytest.raises(PerceptionError, match="its rendering did not finish; run the same command again"):
        load_crops(split)
    (split / "dataset.json").unlink()
    with pytest.raises(PerceptionError, match=r"no dataset\.json in "):
        load_crops(split)


def test_missing_files_and_wrong_sizes_are_named(split: Path) -> None:
    path = split / "val" / "000000" / "mask_visib" / "000002_000000.png"
    content = path.read_bytes()
    path.unlink()
    with pytest.raises(PerceptionError, match=r"000002_000000\.png is missing"):
        load_crops(split)
    path.write_bytes(content)
    cv2.imwrite(str(split / "val" / "000000" / "rgb" / "000001.png"), np.zeros((8, 9, 3), np.uint8))
    with pytest.raises(PerceptionError, match=r"image 1 .* is 9 x 8"):
        load_crops(split)
    (split / "val" / "000000" / "rgb" / "000001.png").unlink()
    with pytest.raises(PerceptionError, match=r"no image 000001"):
        load_crops(split)


def test_parts_and_faces_that_do_not_exist_are_named(split: Path) -> None:
    windows = load_windows(split)
    with pytest.raises(PerceptionError, match=r"obj_id \[9\].*4 \(block4\)"):
        windows.labels(PARTS[:1])
    other = replace(windows, stable_pose=np.array([7, *windows.stable_pose[1:]]))
    with pytest.raises(PerceptionError, match="stable pose 7 of block4, which has 2"):
        other.labels(PARTS)


def edit(path: Path, change: Callable[[Any], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def scaled(entry: dict[str, Any], key: str, factor: float) -> None:
    entry[key] = [factor * x for x in entry[key]]


@pytest.mark.parametrize(("factor", "says"), [(1e-3, "seems to be in metres"), (1e3, "or was scaled twice")])
def test_translations_in_another_unit_are_refused(split: Path, factor: float, says: str) -> None:
    shard = split / "val" / "000000"
    edit(shard / "scene_gt.json", lambda truth: scaled(truth["2"][0], "cam_t_m2c", factor))
    with pytest.raises(PerceptionError, match=rf"image 2 of .*cam_t_m2c.*{says}: BOP's unit is the millimetre"):
        load_crops(split)
    edit(shard / "scene_gt.json", lambda truth: scaled(truth["2"][0], "cam_t_m2c", 1 / factor))
    edit(shard / "scene_camera.json", lambda camera: scaled(camera["1"], "cam_t_w2c", factor))
    with pytest.raises(PerceptionError, match=rf"image 1 of .*cam_t_w2c.*{says}"):
        load_windows(split)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_models_in_another_unit_are_refused(split: Path, factor: float) -> None:
    def change(models: dict[str, Any]) -> None:
        models["9"]["diameter"] *= factor

    edit(split / "models" / "models_info.json", change)
    with pytest.raises(PerceptionError, match=r"diameter of part 9 is .*BOP's unit is the millimetre"):
        load_crops(split)


def test_a_lens_that_distorts_and_foreign_labels_are_refused(split: Path) -> None:
    shard = split / "val" / "000000"
    edit(shard / "scene_camera.json", lambda camera: camera["0"].update(cam_dist=[0, 0, 0, 0]))
    assert len(load_crops(split)) == 3
    shutil.rmtree(split / "cache")
    edit(shard / "scene_camera.json", lambda camera: camera["0"].update(cam_dist=[0.01, 0, 0, 0]))
    with pytest.raises(PerceptionError, match=r"image 0 .*lens that distorts"):
        load_crops(split)
    edit(shard / "scene_camera.json", lambda camera: camera["0"].pop("cam_dist"))
    edit(shard / "scene_gt.json", lambda truth: truth["2"][0].pop("stable_pose"))
    with pytest.raises(PerceptionError, match=r"image 2 .*no stable_pose"):
        load_crops(split)


def test_parts_of_which_nothing_is_seen_are_left_out(tmp_path: Path) -> None:
    shown = picture(0, [(9, 0), (4, 1), (4, 0)])
    hidden = shown.annotations[1]
    shown.annotations[1] = replace(hidden, visible=np.zeros_like(hidden.visible))
    windows = load_windows(write_data_set(tmp_path / "set", "test", PARTS, [shown]))
    assert windows.obj_id.tolist() == [9, 4] and windows.instance.tolist() == [0, 1]
    assert windows.stable_pose.tolist() == [0, 0]
    assert windows.instance_map[0, 8, 0] == 1 and windows.instance_map[0, 8, 20] == 2
    assert (windows.instance_map > 0).sum() == 50
    shown.annotations[0] = replace(shown.annotations[0], visible=np.zeros((5, 5), bool))
    crops = load_crops(write_data_set(tmp_path / "crops", "test", PARTS, [shown]))
    assert crops.obj_id.tolist() == [0] and not crops.masks().any()


def test_jpeg_files_are_read(tmp_path: Path) -> None:
    crops = load_crops(write_split(tmp_path / "set", [[(4, 1)], []], jpeg=95))
    assert not list((tmp_path / "set").rglob("rgb/*.png"))
    assert np.abs(crops.images[1].astype(int) - [11, 20, 30]).max() <= 3


def test_camera_of_a_crop_is_the_crop_of_the_camera() -> None:
    """What the labels rest on: a point projects to the same place of the window whichever way its camera is made."""
    whole = Intrinsics(width=5472, height=3648, fx=BASLER.fx, fy=BASLER.fy, cx=BASLER.cx, cy=BASLER.cy)
    p = np.array([0.001, 0.002, 0.7])
    np.testing.assert_allclose(WINDOW.project(p), (whole.project(p) - [2700, 1700] + 0.5) / 2 - 0.5)
