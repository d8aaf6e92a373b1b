"""BOP and COCO files to the letter: layout, keys, units, boxes and counts, run lengths, models."""

import contextlib
import io
import json

import cv2
import numpy as np
import pytest
import trimesh
from data_sets import Picture, write_data_set
from made_parts import part_of
from pycocotools import mask as run_lengths
from pycocotools.coco import COCO

from cad.equivalence import Axis, Symmetries, symmetries_from_json
from cad.parts import load_mesh
from cad.run_lengths import encode_runs
from cad.spatial import BASLER, rotation_x, rotation_z, transform
from scenes.bop import DEPTH_SCALE, Annotation, ShardWriter, depth_units, write_camera, write_models
from scenes.coco import merged
from scenes.errors import SceneError

SHAPE = (48, 64)
WINDOW = BASLER.crop(2700, 1800, SHAPE[1], SHAPE[0])
T_CAM_BOARD = transform(rotation_x(np.pi), [0.01, 0.02, 0.7])
T_CAM_PART = transform(rotation_x(np.pi) @ rotation_z(0.7), [0.0001, -0.0002, 0.699])
TURNS = Symmetries(
    discrete=np.array([transform(rotation_z(np.pi), [1e-4, 0, 0])]),
    continuous=(Axis(direction=np.array([0.0, 0, 1]), point=np.array([0.0, 1e-3, 0])),),
)
PARTS = [
    part_of(trimesh.creation.box((6e-3, 4e-3, 2e-3)), [np.eye(3)], TURNS, name="block", obj_id=1),
    part_of(trimesh.creation.box((9e-3, 1e-3, 2e-3)), [np.eye(3)], name="bar", obj_id=5),
]


def ellipse(h, w):
    v, u = np.mgrid[:h, :w]
    return ((u - (w - 1) / 2) / (w / 2)) ** 2 + ((v - (h - 1) / 2) / (h / 2)) ** 2 <= 1


def annotation(corner, silhouette, visible=None, obj_id=1):
    return Annotation(
        obj_id=obj_id,
        stable_pose=0,
        T_cam_part=T_CAM_PART,
        corner=corner,
        silhouette=silhouette,
        visible=silhouette if visible is None else visible,
        keypoints=np.column_stack([np.arange(8) + 0.25, np.arange(8) * 2.0, [2, 1] * 4]),
    )


def pictures():
    """A part by itself and one that is half hidden; one that the border cuts, and one that is wholly hidden."""
    noise = np.random.default_rng(0).integers(0, 256, (2, *SHAPE, 3), np.uint8)
    half = ellipse(12, 16)
    half[:, 8:] = False
    cut = ellipse(20, 30)
    seen = np.zeros_like(cut)
    seen[8:, 10:] = cut[8:, 10:]
    depth = np.full(SHAPE, 0.7, np.float32)
    depth[:2] = 2.0
    first = [annotation((4, 5), ellipse(10, 14)), annotation((30, 20), ellipse(12, 16), half, obj_id=5)]
    second = [annotation((-10, -8), cut, seen), annotation((40, 10), ellipse(8, 8), np.zeros((8, 8), bool), obj_id=5)]
    return [
        Picture(noise[0], WINDOW, T_CAM_BOARD, first, depth),
        Picture(noise[1], WINDOW, T_CAM_BOARD, second, depth, distortion=np.array([-0.01, 0, 0, 0])),
        Picture(noise[1], WINDOW, T_CAM_BOARD, [], depth, distortion=np.zeros(4)),
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_data_set(tmp_path_factory.mktemp("bop") / "set", "test", PARTS, pictures())


@pytest.fixture(scope="module")
def shard(folder):
    return folder / "test" / "000000"


def read(path):
    return json.loads(path.read_text())


def load_coco(content, tmp_path):
    path = tmp_path / "coco.json"
    path.write_text(json.dumps(content))
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(str(path))


def test_the_folders_are_bops(folder, shard):
    assert sorted(path.name for path in (folder / "models").iterdir()) == [
        "keypoints.json",
        "models_info.json",
        "obj_000001.ply",
        "obj_000005.ply",
    ]
    jsons = [f"{name}.json" for name in ("scene_camera", "scene_gt", "scene_gt_coco", "scene_gt_info")]
    assert sorted(path.name for path in shard.iterdir()) == sorted(["rgb", "depth", "mask", "mask_visib", *jsons])
    images = ["000000.png", "000001.png", "000002.png"]
    masks = ["000000_000000.png", "000000_000001.png", "000001_000000.png", "000001_000001.png"]
    for name, files in (("rgb", images), ("depth", images), ("mask", masks), ("mask_visib", masks)):
        assert sorted(path.name for path in (shard / name).iterdir()) == files


def test_the_entries_are_bops_in_millimetres(shard):
    cameras, truths = read(shard / "scene_camera.json"), read(shard / "scene_gt.json")
    infos = read(shard / "scene_gt_info.json")
    assert list(cameras) == list(truths) == list(infos) == ["0", "1", "2"]
    assert list(cameras["0"]) == ["cam_K", "depth_scale", "cam_R_w2c", "cam_t_w2c"]
    np.testing.assert_array_equal(np.reshape(cameras["0"]["cam_K"], (3, 3)), WINDOW.matrix)
    np.testing.assert_allclose(cameras["0"]["cam_t_w2c"], [10, 20, 700])
    np.testing.assert_array_equal(np.reshape(cameras["0"]["cam_R_w2c"], (3, 3)), T_CAM_BOARD[:3, :3])
    assert set(truths["0"][0]) == {"cam_R_m2c", "cam_t_m2c", "obj_id", "stable_pose"}
    np.testing.assert_allclose(truths["0"][0]["cam_t_m2c"], [0.1, -0.2, 699])
    np.testing.assert_array_equal(np.reshape(truths["0"][1]["cam_R_m2c"], (3, 3)), T_CAM_PART[:3, :3])
    np.testing.assert_allclose(np.array(truths["0"][1]["cam_t_m2c"]) / 1e3, T_CAM_PART[:3, 3], atol=1e-15)
    assert [t["obj_id"] for t in truths["0"]] == [1, 5] and truths["2"] == []
    assert set(infos["0"][0]) == {
        *("bbox_obj", "bbox_visib", "px_count_all", "px_count_valid", "px_count_visib", "visib_fract")
    }


def test_distortion_and_gamma_are_told_only_where_there_is_any(shard, tmp_path):
    cameras = read(shard / "scene_camera.json")
    assert cameras["1"]["cam_dist"] == [-0.01, 0, 0, 0] and "cam_dist" not in cameras["2"]
    writer = ShardWriter(tmp_path / "000000", 0, PARTS)
    writer.add(np.zeros((*SHAPE, 3), np.uint8), WINDOW, T_CAM_BOARD, [], gamma=0.45)
    writer.finish()
    assert read(tmp_path / "000000" / "scene_camera.json")["0"]["gamma"] == 0.45


def test_boxes_and_counts_are_those_of_bops_toolkit(shard):
    first, second = (read(shard / "scene_gt_info.json")[i] for i in "01")
    whole = int(ellipse(12, 16).sum())
    assert first[0]["bbox_obj"] == first[0]["bbox_visib"] == [4, 5, 13, 9]
    assert first[0]["visib_fract"] == 1.0
    assert first[1]["bbox_obj"] == [30, 20, 15, 11] and first[1]["bbox_visib"] == [30, 20, 7, 11]
    assert first[1]["px_count_all"] == first[1]["px_count_valid"] == whole
    assert first[1]["px_count_visib"] * 2 == whole and first[1]["visib_fract"] == 0.5
    inside = ellipse(20, 30)[8:, 10:]
    assert second[0]["bbox_obj"] == [-10, -8, 29, 19] and second[0]["bbox_visib"] == [0, 0, 19, 11]
    assert second[0]["px_count_all"] == ellipse(20, 30).sum() and second[0]["px_count_visib"] == inside.sum()
    assert second[0]["px_count_valid"] == inside[2:].sum()  # two rows are too far for the depth image
    assert second[1]["bbox_obj"] == second[1]["bbox_visib"] == [-1, -1, -1, -1]
    assert second[1]["px_count_all"] > 0 and second[1]["visib_fract"] == 0


def test_masks_are_of_zero_and_255_and_show_whole_and_visible(shard):
    for image, picture in enumerate(pictures()):
        for k, a in enumerate(picture.annotations):
            name = f"{image:06d}_{k:06d}.png"
            whole, visible = (
                cv2.imread(str(shard / kind / name), cv2.IMREAD_UNCHANGED) for kind in ("mask", "mask_visib")
            )
            assert whole.dtype == np.uint8 and whole.shape == SHAPE and set(np.unique(whole)) == {0, 255}
            assert np.array_equal(whole > 0, a.mask(SHAPE)) and np.array_equal(visible > 0, a.mask_visible(SHAPE))
    half = cv2.imread(str(shard / "mask" / "000000_000001.png"), cv2.IMREAD_UNCHANGED) > 0
    assert np.array_equal(half[20:32, 30:46], ellipse(12, 16)) and half.sum() == ellipse(12, 16).sum()


def test_images_and_depth_come_back(shard):
    for image, picture in enumerate(pictures()):
        stored = cv2.imread(str(shard / "rgb" / f"{image:06d}.png"))[..., ::-1]
        assert np.array_equal(stored, picture.rgb)
        depth = cv2.imread(str(shard / "depth" / f"{image:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16 and not depth[:2].any()
        np.testing.assert_allclose(depth[2:] * DEPTH_SCALE, 700.0, atol=DEPTH_SCALE / 2 + 1e-4)
    levels = np.linspace(0.3, 1.31, 5000, dtype=np.float32)
    np.testing.assert_allclose(depth_units(levels) * DEPTH_SCALE, levels * 1e3, atol=DEPTH_SCALE / 2 + 1e-4)


def test_jpeg_files_take_the_place_of_png(tmp_path):
    smooth = np.tile(np.linspace(0, 255, SHAPE[1]).astype(np.uint8)[None, :, None], (SHAPE[0], 1, 3))
    smooth[..., 2] = 40
    folder = write_data_set(tmp_path / "set", "train", PARTS, [Picture(smooth, WINDOW, T_CAM_BOARD)], jpeg=95)
    stored = cv2.imread(str(folder / "train" / "000000" / "rgb" / "000000.jpg"))[..., ::-1]
    assert np.abs(stored.astype(int) - smooth).mean() < 3
    assert read(folder / "train" / "000000" / "scene_gt_coco.json")["images"][0]["file_name"] == "rgb/000000.jpg"


def test_coco_files_load_and_say_what_bops_say(shard, tmp_path):
    coco = load_coco(read(shard / "scene_gt_coco.json"), tmp_path)
    infos = read(shard / "scene_gt_info.json")
    assert len(coco.imgs) == 3 and len(coco.anns) == 3  # what nothing is seen of is left out
    assert {c["id"]: c["name"] for c in coco.cats.values()} == {1: "block", 5: "bar"}
    assert coco.cats[5]["keypoints"] == [f"bar_{k}" for k in range(8)]
    for a in coco.anns.values():
        image = coco.imgs[a["image_id"]]
        assert (image["width"], image["height"]) == (SHAPE[1], SHAPE[0]) and (shard / image["file_name"]).exists()
        number = int(image["file_name"][4:10])
        name, info = f"{number:06d}_{a['gt_id']:06d}.png", infos[str(number)][a["gt_id"]]
        assert np.array_equal(coco.annToMask(a), cv2.imread(str(shard / "mask_visib" / name), 0) // 255)
        assert a["area"] == info["px_count_visib"] and a["visib_fract"] == info["visib_fract"]
        whole = cv2.imread(str(shard / "mask" / name), 0)
        assert a["bbox"] == run_lengths.toBbox(run_lengths.encode(np.asfortranarray(whole // 255))).tolist()
        assert a["iscrowd"] == 0 and a["num_keypoints"] == 8
        np.testing.assert_allclose(np.reshape(a["keypoints"], (8, 3))[3], [3.25, 6.0, 1])
    assert [a["ignore"] for a in coco.anns.values()] == [False, False, False]


def test_run_lengths_are_pycocotools_own():
    rng = np.random.default_rng(3)
    for _ in range(60):
        h, w = rng.integers(1, 20, 2)
        corner = (int(rng.integers(-18, 30)), int(rng.integers(-18, 22)))
        window, shape = rng.random((h, w)) < rng.choice([0.0, 0.3, 1.0]), (20, 28)
        a = annotation(corner, window)
        expected = run_lengths.encode(np.asfortranarray(a.mask(shape).astype(np.uint8)))
        assert encode_runs(window, corner, shape) == {"size": [20, 28], "counts": expected["counts"].decode()}


def test_ids_stay_unique_when_folders_are_merged(tmp_path):
    shards = []
    for scene_id in (0, 7, 8):
        shard = tmp_path / "train" / f"{scene_id:06d}"
        writer = ShardWriter(shard, scene_id, PARTS)
        for p in pictures():
            writer.add(p.rgb, p.intrinsics, p.T_cam_board, p.annotations)
        writer.finish()
        shards.append(shard)
    coco = load_coco(merged(shards, [read(shard / "scene_gt_coco.json") for shard in shards]), tmp_path)
    assert len(coco.imgs) == 9 and len(coco.anns) == 9 and 0 not in coco.anns
    for a in coco.anns.values():
        assert (tmp_path / "train" / coco.imgs[a["image_id"]]["file_name"]).exists()
    assert sorted(coco.getImgIds(catIds=[5])) == [0, 7000, 8000]


def test_models_are_in_millimetres_with_their_symmetries(folder):
    infos, keypoints = read(folder / "models" / "models_info.json"), read(folder / "models" / "keypoints.json")
    assert set(infos["5"]) == {"diameter", *(f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz")}
    np.testing.assert_allclose(infos["1"]["diameter"], np.linalg.norm([6, 4, 2]))
    assert [infos["5"][f"min_{axis}"] for axis in "xyz"] == pytest.approx([-4.5, -0.5, -1])
    assert [infos["5"][f"size_{axis}"] for axis in "xyz"] == pytest.approx([9, 1, 2])
    assert len(infos["1"]["symmetries_discrete"][0]) == 16
    assert infos["1"]["symmetries_discrete"][0][3] == pytest.approx(0.1)
    assert infos["1"]["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 1, 0]}]
    back = symmetries_from_json(infos["1"])
    np.testing.assert_allclose(back.discrete, TURNS.discrete, atol=1e-9)
    np.testing.assert_allclose(back.continuous[0].point, TURNS.continuous[0].point)
    for part in PARTS:
        path = folder / "models" / f"obj_{part.obj_id:06d}.ply"
        np.testing.assert_allclose(load_mesh(path).vertices, part.mesh.vertices * 1e3, atol=1e-6)
        header = path.read_text().split("end_header")[0]
        assert "format ascii 1.0" in header and "property float nx" in header
        assert keypoints[str(part.obj_id)]["name"] == part.name
        np.testing.assert_allclose(keypoints[str(part.obj_id)]["keypoints"], part.keypoints * 1e3, atol=1e-6)


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "millimetres"), (1e-3, "metres taken for millimetres")])
def test_parts_in_another_unit_are_not_written(scale, unit, tmp_path):
    mesh = PARTS[0].mesh.copy()
    mesh.apply_scale(scale)
    with pytest.raises(SceneError, match=f"'block' measures .* seems to be in {unit}; take the part in again"):
        write_models(tmp_path, [part_of(mesh, [np.eye(3)])])


def test_the_cameras_file_is_bops(tmp_path):
    write_camera(tmp_path, BASLER)
    content = read(tmp_path / "camera.json")
    assert content == {
        **{"cx": BASLER.cx, "cy": BASLER.cy, "fx": BASLER.fx, "fy": BASLER.fy},
        **{"width": 5472, "height": 3648, "depth_scale": DEPTH_SCALE},
    }


def test_what_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match=r"cannot write into .*file"):
        ShardWriter(tmp_path / "file", 0, PARTS)
    writer = ShardWriter(tmp_path / "000000", 0, PARTS)
    (tmp_path / "000000" / "rgb").rmdir()
    with pytest.raises(SceneError, match=r"cannot write .*rgb/000000\.png"):
        writer.add(np.zeros((*SHAPE, 3), np.uint8), WINDOW, T_CAM_BOARD, [])


def test_a_folder_takes_a_thousand_images_and_no_more(tmp_path):
    writer = ShardWriter(tmp_path / "000000", 0, PARTS)
    small = BASLER.crop(0, 0, 2, 2)
    for _ in range(1000):
        writer.add(np.zeros((2, 2, 3), np.uint8), small, T_CAM_BOARD, [])
    with pytest.raises(SceneError, match="at most 1000 images a folder"):
        writer.add(np.zeros((2, 2, 3), np.uint8), small, T_CAM_BOARD, [])
