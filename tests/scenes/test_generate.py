"""Data sets on disk: labels that agree with the pixels, seeds that decide every byte, runs that can be interrupted."""

import json

import cv2
import numpy as np
import pytest

from cad.parts import load_part, part_names
from cad.spatial import BASLER, Intrinsics, apply, inverse
from scenes.bop import T_from_bop
from scenes.errors import SceneError
from scenes.generate import DatasetConfig, generate

CROPS = DatasetConfig(kind="crop", split="val", count=24, chunk=12, seed=7)
WINDOWS = DatasetConfig(kind="scene", split="train", count=6, chunk=6, seed=8, depth=True)
PARTS = {load_part(name).obj_id: load_part(name) for name in part_names()}


def quiet(_):
    pass


def files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def crops(tmp_path_factory):
    out = tmp_path_factory.mktemp("crops") / "data"
    generate(CROPS, out, quiet)
    return out


@pytest.fixture(scope="module")
def windows(tmp_path_factory):
    out = tmp_path_factory.mktemp("windows") / "data"
    generate(WINDOWS, out, quiet)
    return out


def images(out):
    """Every image as (rgb, intrinsics, T_cam_board, [(part, stable_pose, T_cam_part, mask, info)])."""
    for chunk in sorted(p for p in out.glob("*/*") if p.name.isdigit()):
        cameras, truths, infos = (
            json.loads((chunk / f"{name}.json").read_text()) for name in ("scene_camera", "scene_gt", "scene_gt_info")
        )
        for i in sorted(cameras, key=int):
            rgb = cv2.imread(str(chunk / "rgb" / f"{int(i):06d}.png"))[..., ::-1]
            K = np.reshape(cameras[i]["cam_K"], (3, 3))
            intrinsics = Intrinsics(
                width=rgb.shape[1], height=rgb.shape[0], fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]
            )
            seen = []
            for k, (truth, info) in enumerate(zip(truths[i], infos[i], strict=True)):
                mask = cv2.imread(str(chunk / "mask_visib" / f"{int(i):06d}_{k:06d}.png"), cv2.IMREAD_GRAYSCALE) > 0
                T_cam_part = T_from_bop(truth["cam_R_m2c"], truth["cam_t_m2c"])
                seen.append((PARTS[truth["obj_id"]], truth["stable_pose"], T_cam_part, mask, info))
            yield rgb, intrinsics, T_from_bop(cameras[i]["cam_R_w2c"], cameras[i]["cam_t_w2c"]), seen


def silhouette(part, intrinsics, T_cam_part, fine=16):
    """The CAD model's filled outline, (H, W) bool, read at pixel centres."""
    image = np.zeros((intrinsics.height * fine, intrinsics.width * fine), np.uint8)
    pixels = intrinsics.project(apply(T_cam_part, part.mesh.vertices))
    for triangle in np.round((pixels * fine + (fine - 1) / 2)[part.mesh.faces]).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 1)
    return image[fine // 2 :: fine, fine // 2 :: fine] > 0


@pytest.mark.parametrize("which", ["crops", "windows"])
def test_masks_are_the_projected_parts(which, request):
    overlaps = []
    for _, intrinsics, _, seen in images(request.getfixturevalue(which)):
        for part, _, T_cam_part, mask, _ in seen:
            truth = silhouette(part, intrinsics, T_cam_part)
            if truth.sum() < 50:  # of a sliver at the border one pixel is a large share
                continue
            overlaps.append((mask & truth).sum() / (mask | truth).sum())
    assert len(overlaps) > 10
    assert np.mean(overlaps) > 0.98
    assert min(overlaps) > 0.93  # a thin side of a part in a quarter-size window is 4 pixels wide


def test_crops_are_128_pixels_round_a_part_or_hold_none(crops):
    none = 0
    for rgb, intrinsics, T_cam_board, seen in images(crops):
        assert rgb.shape == (128, 128, 3)
        np.testing.assert_allclose(intrinsics.fx, BASLER.fx / 2)
        none += not seen
        if seen:
            part, stable_pose, T_cam_part, mask, _ = seen[0]
            T_board_part = inverse(T_cam_board) @ T_cam_part
            middle = (T_board_part @ inverse(part.stable_poses[stable_pose].T_table_part))[:3, 3]
            centre = intrinsics.project(apply(T_cam_board, [middle[0], middle[1], 0.0]))
            assert np.abs(centre - 63.5).max() < 12.5
            assert mask.any()
    assert 0 < none < CROPS.count / 2


def test_parts_rest_on_the_face_that_the_label_names(crops):
    for _, _, T_cam_board, seen in images(crops):
        for part, stable_pose, T_cam_part, _, _ in seen:
            T_board_part = inverse(T_cam_board) @ T_cam_part
            up = part.stable_poses[stable_pose].R_table_part[2]
            assert np.degrees(np.arccos(min(1.0, up @ T_board_part[2, :3]))) < 0.31
            assert abs(apply(T_board_part, part.mesh.vertices)[:, 2].min()) < 1e-4


def test_counts_and_boxes_tell_whole_from_cut_parts(windows):
    for rgb, _, _, seen in images(windows):
        assert rgb.shape == (320, 320, 3)
        for _, _, _, mask, info in seen:
            x, y, w, h = info["bbox_obj"]
            cut = x < 0 or y < 0 or x + w > 320 or y + h > 320
            assert info["px_count_visib"] == mask.sum()
            assert (info["visib_fract"] < 1) == cut


def test_depth_is_the_distance_of_the_board(windows):
    chunk = windows / "train" / "000000"
    scale = json.loads((chunk / "scene_camera.json").read_text())["0"]["depth_scale"]
    depth_mm = cv2.imread(str(chunk / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED) * scale
    assert 680 < np.median(depth_mm) < 720


def test_models_are_written_in_millimetres(crops):
    infos = json.loads((crops / "models" / "models_info.json").read_text())
    for obj_id, part in PARTS.items():
        assert (crops / "models" / f"obj_{obj_id:06d}.ply").exists()
        np.testing.assert_allclose(infos[str(obj_id)]["diameter"], part.diameter_m * 1e3)


def test_an_interrupted_run_leaves_whole_chunks_and_goes_on_to_the_same_bytes(crops, tmp_path):
    class StopError(Exception):
        pass

    def stop(_):
        raise StopError

    out = tmp_path / "data"
    with pytest.raises(StopError):
        generate(CROPS, out, stop)
    (out / "val" / ".000001.partial" / "rgb").mkdir(parents=True)
    assert [p.name for p in (out / "val").iterdir() if p.name.isdigit()] == ["000000"]
    lines = []
    generate(CROPS, out, lines.append)
    assert "24 of 24 images" in lines[-1]
    assert files(out) == files(crops)
    generate(CROPS, out, stop)  # nothing is missing, nothing is reported


def test_the_number_of_workers_does_not_change_a_byte(crops, tmp_path):
    many = DatasetConfig(kind="crop", split="val", count=24, chunk=12, seed=7, jobs=2)
    generate(many, tmp_path / "data", quiet)
    assert files(tmp_path / "data") == files(crops)


def test_a_folder_with_other_data_is_refused(crops, tmp_path):
    with pytest.raises(SceneError, match="made with other settings"):
        generate(DatasetConfig(kind="crop", split="val", count=24, chunk=12, seed=9), crops, quiet)
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(SceneError, match="is not empty"):
        generate(CROPS, tmp_path, quiet)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"kind": "movie"}, "is not one of crop, fine, scene"),
        ({"split": "test"}, "is not one of train, val"),
        ({"count": 0}, "count 0"),
        ({"chunk": 2000}, "at most 1000"),
    ],
)
def test_wrong_settings_are_refused(settings, says):
    with pytest.raises(SceneError, match=says):
        DatasetConfig(**settings)
