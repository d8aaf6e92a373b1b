"""Photographs with their calibration: a lens, a smaller size or a window of the sensor change no pose."""

import json
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from cad.parts import load_part, planar
from cad.spatial import BASLER, inverse, rotation_from_rotvec, transform, yaw_of
from cad.tagboard import TagboardConfig
from perception.calibration import camera_from_tags, table_from_board
from perception.calibration_file import CellCalibration
from perception.contour import refine_all
from perception.estimates import FrameEstimate, PartEstimate
from perception.gradients import brightness
from perception.photo_estimate import PhotoEstimator, result_names
from perception.silhouette import silhouette_mask
from perception.standard_view import frame_scale, standard_crop
from scenes.camera import set_camera_pose
from scenes.classic import ClassicRenderer
from scenes.distorted import DistortedRenderer
from scenes.gl import mujoco
from scenes.lens import Lens
from scenes.sensor import SensorConfig, expose
from scenes.workcell import CellConfig, build_board_scene, set_parts

CAMERA = BASLER.crop(1368, 912, 2736, 1824)  # the middle of the sensor: a quarter of the pixels to draw
CELL = CellConfig(
    tagboard=TagboardConfig(width_m=0.17, height_m=0.11, tag_m=0.014, columns=8, rows=5), pick_area_half_m=(0.05, 0.025)
)
LENS = Lens(k1=-0.5, k2=0.4, p1=0.002, p2=-0.003)
LYING = (("main", 0, -0.045, 0.022, 0.4), ("main", 1, 0.01, 0.0, 0.7), ("inserted", 1, 0.045, -0.02, -1.2))
PARTS = {name: load_part(name) for name, *_ in LYING}
T_BOARD_PARTS = [planar(x, y, yaw) @ PARTS[name].stable_poses[k].T_table_part for name, k, x, y, yaw in LYING]
T_BOARD_CAM = CELL.T_board_cam @ transform(rotation_from_rotvec([0.008, -0.006, 0.03]), [0.002, -0.003, 0.004])


@dataclass
class ContourEstimator:
    """Knows roughly which part lies where (0.2 mm and 1.5 degrees off) and refines that; networks are not asked."""

    seen: int = len(LYING)

    def estimate(self, frame):
        tags = camera_from_tags(frame, CELL.tagboard)
        T_cam_table = table_from_board(tags.T_cam_board)
        scale = frame_scale(frame.intrinsics, T_cam_table)
        found = []
        for (name, k, *_), T_board_part in list(zip(LYING, T_BOARD_PARTS, strict=True))[: self.seen]:
            part = PARTS[name]
            rest = part.stable_poses[k].T_table_part
            T = inverse(T_cam_table) @ tags.T_cam_board @ T_board_part @ inverse(rest)
            x, y, yaw = float(T[0, 3]) + 2e-4, float(T[1, 3]) - 1e-4, yaw_of(T[:3, :3]) + 0.026
            centre = frame.intrinsics.project((T_cam_table @ planar(x, y, yaw))[:3, 3])
            crop, camera = standard_crop(frame.image, frame.intrinsics, centre, 256, scale)
            places = refine_all(brightness(crop), camera, part, k, T_cam_table, x, y, yaw)
            r = min(places, key=lambda place: np.hypot(place.x - T[0, 3], place.y - T[1, 3]))
            T_cam_part = T_cam_table @ planar(r.x, r.y, r.yaw) @ rest
            mask, origin = silhouette_mask(part, T_cam_part, frame.intrinsics)
            found.append(
                PartEstimate(
                    part=name,
                    T_cam_part=T_cam_part,
                    stable_pose=k,
                    score=0.9,
                    covariance=np.diag([1e-10, 4e-10, 9e-10, 1e-6, 1e-6, 4e-6]),
                    mask=mask,
                    mask_origin=origin,
                )
            )
        return FrameEstimate(
            T_cam_board=tags.T_cam_board, parts=tuple(found), tags_seen=tags.tags_seen, tag_rms_px=tags.rms_px
        )


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """One scene photographed without and with a lens that distorts (by 20 pixels in the corners)."""
    folder = tmp_path_factory.mktemp("photos")
    names = [name for name, *_ in LYING]
    model = build_board_scene(CELL, names).compile()
    data = mujoco.MjData(model)
    set_parts(model, data, np.stack([CELL.T_world_board @ T for T in T_BOARD_PARTS]))
    set_camera_pose(model, data, T_BOARD_CAM)
    size = CAMERA.width, CAMERA.height
    renderer = DistortedRenderer(
        ClassicRenderer(model, max_width=size[0], max_height=size[1]), max_width=size[0], max_height=size[1]
    )
    images = {}
    for name, lens in (("straight", Lens()), ("distorted", LENS)):
        renderer.lens = lens
        rgb = renderer.render(data, CAMERA, ("rgb",)).rgb
        assert rgb is not None
        images[name] = expose(rgb, SensorConfig(), np.random.default_rng(5))
        cv2.imwrite(str(folder / f"{name}.bmp"), cv2.cvtColor(images[name], cv2.COLOR_RGB2BGR))
    renderer.close()
    straight = images["straight"]
    half = cv2.resize(straight, (CAMERA.width // 2, CAMERA.height // 2), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / "half.bmp"), cv2.cvtColor(half, cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(folder / "window.bmp"), cv2.cvtColor(straight[50:1800, 20:2700], cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(folder / "other.png"), np.zeros((300, 300), np.uint8))
    cv2.imwrite(str(folder / "empty.png"), np.full((912, 1368), 90, np.uint8))
    return folder


NOMINAL = CellCalibration(intrinsics=CAMERA)
WITH_LENS = replace(NOMINAL, distortion=LENS.coefficients)


@pytest.fixture(scope="module")
def results(photos, tmp_path_factory):
    """Results by photograph, and the folder they are in."""
    out = tmp_path_factory.mktemp("out")
    both = PhotoEstimator(estimator=ContourEstimator(), parts=PARTS, calibration=NOMINAL, out=out)
    (straight, half) = both.run([photos / "straight.bmp", photos / "half.bmp"])
    moved = replace(WITH_LENS, T_board_cam=CELL.T_board_cam, T_base_board=transform(None, [0.4, 0.0, 0.1]))
    (distorted,) = replace(both, calibration=moved, export_crops=True).run([photos / "distorted.bmp"])
    (window,) = replace(both, offset=(20, 50)).run([photos / "window.bmp"])
    return out, {"straight": straight, "half": half, "distorted": distorted, "window": window}


def places_mm(result):
    return np.array([1e3 * np.array(part["T_board_part"])[:3, 3] for part in result["parts"]])


@pytest.mark.parametrize(("name", "within_mm"), [("distorted", 0.02), ("window", 0.02), ("half", 0.05)])
def test_poses_are_those_of_the_plain_photograph(results, name, within_mm):
    _, by_name = results
    truth = 1e3 * np.stack(T_BOARD_PARTS)[:, :3, 3]
    assert np.abs(places_mm(by_name["straight"]) - truth).max() < 0.05
    assert np.abs(places_mm(by_name[name]) - places_mm(by_name["straight"])).max() < within_mm
    for a, b in zip(by_name[name]["parts"], by_name["straight"]["parts"], strict=True):
        assert abs(a["yaw_board_deg"] - b["yaw_board_deg"]) < 0.15
    assert by_name[name]["tags_seen"] >= 12  # of 22, some of them out of view


def test_without_its_calibration_a_distorted_photograph_is_off(photos, tmp_path):
    estimator = PhotoEstimator(estimator=ContourEstimator(1), parts=PARTS, calibration=NOMINAL, out=tmp_path)
    (result,) = estimator.run([photos / "distorted.bmp"])
    assert "error" in result or np.abs(places_mm(result)[0] - 1e3 * T_BOARD_PARTS[0][:3, 3]).max() > 0.03


def test_pixels_are_those_of_the_photograph_as_taken(results):
    _, by_name = results
    T_cam_board = inverse(T_BOARD_CAM)
    for part, T_board_part in zip(by_name["distorted"]["parts"], T_BOARD_PARTS, strict=True):
        seen = LENS.project(CAMERA, (T_cam_board @ T_board_part)[:3, 3])
        np.testing.assert_allclose(part["origin_px"], seen, atol=1.5)
        outline, box = np.array(part["outline_px"]), part["box_px"]
        vertices = LENS.project(CAMERA, (part_vertices(part["part"]) @ (T_cam_board @ T_board_part).T)[:, :3])
        np.testing.assert_allclose(outline.min(axis=0), vertices.min(axis=0), atol=2.5)
        np.testing.assert_allclose([box["u"] + box["width"], box["v"] + box["height"]], vertices.max(axis=0), atol=2.5)


def part_vertices(name):
    vertices = PARTS[name].mesh.vertices
    return np.hstack([vertices, np.ones((len(vertices), 1))])


def test_results_are_complete_and_consistent(results):
    out, by_name = results
    result = by_name["distorted"]
    stored = json.loads((out / "distorted.estimate.json").read_text())
    assert stored == {name: value for name, value in result.items() if name != "result"}
    T_cam_board, T_base_board = np.array(stored["T_cam_board"]), transform(None, [0.4, 0.0, 0.1])
    for part, (name, k, *_) in zip(stored["parts"], LYING, strict=True):
        assert (part["part"], part["stable_pose"], part["obj_id"]) == (name, k, PARTS[name].obj_id)
        T_board_part = np.array(part["T_board_part"])
        np.testing.assert_allclose(T_cam_board @ T_board_part, part["T_cam_part"], atol=1e-12)
        np.testing.assert_allclose(T_base_board @ T_board_part, part["T_base_part"], atol=1e-12)
        np.testing.assert_allclose(np.array(part["T_board_part"])[0, 3] * 1e3, part["x_board_mm"])
        # the camera looks straight down, so its x and y variances trade places with the board's at most
        assert sorted(part["sigma"][f"{axis}_board_mm"] for axis in "xy") == pytest.approx([0.01, 0.02], rel=0.02)
        assert part["sigma"]["yaw_deg"] == pytest.approx(np.degrees(2e-3), rel=0.01)
    assert stored["moved_since_calibration"]["distance_mm"] == pytest.approx(np.sqrt(4 + 9 + 16), abs=0.3)
    assert "moved_since_calibration" not in by_name["straight"] and "T_base_part" not in by_name["straight"]["parts"][0]


def test_crops_show_the_parts_as_networks_see_them(results):
    out, by_name = results
    files = sorted(p.name for p in (out / "distorted.crops").iterdir())
    assert files == ["00_main.png", "01_main.png", "02_inserted.png"]
    for part in by_name["distorted"]["parts"]:
        crop = cv2.imread(part["crop"]["file"])
        k = part["crop"]["intrinsics"]
        x, y, z = np.array(part["T_cam_part"])[:3, 3]
        assert crop.shape == (256, 256, 3)
        assert 0 < k["fx_px"] * x / z + k["cx_px"] < 256 and 0 < k["fy_px"] * y / z + k["cy_px"] < 256


def test_the_overlay_marks_every_part(results):
    out, by_name = results
    picture = cv2.imread(by_name["straight"]["overlay"])
    assert picture.shape[1] == 1368 and picture.shape[0] > 912 + 300
    assert sorted(p.name for p in out.iterdir() if p.suffix == ".jpg") == [
        f"{name}.overlay.jpg" for name in ("distorted", "half", "straight", "window")
    ]


def test_a_photograph_that_fails_does_not_stop_the_others(photos, tmp_path):
    estimator = PhotoEstimator(estimator=ContourEstimator(1), parts=PARTS, calibration=NOMINAL, out=tmp_path)
    (tmp_path / "other.overlay.jpg").write_bytes(b"of an earlier run")
    names = ("missing.png", "other.png", "empty.png", "straight.bmp")
    missing, other, empty, good = estimator.run([photos / name for name in names])
    assert "there is no picture" in missing["error"]
    assert "300 x 300" in other["error"] and "2736 x 1824" in other["error"]
    assert "0 of the board's" in empty["error"] and "bring the board into view" in empty["error"]
    assert len(good["parts"]) == 1
    assert "error" in json.loads((tmp_path / "other.estimate.json").read_text())
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [f"{name.split('.')[0]}.estimate.json" for name in names] + ["straight.overlay.jpg"]
    )


def test_photographs_of_one_name_get_results_of_their_own(tmp_path):
    assert result_names([tmp_path / "a" / "x.png", tmp_path / "b" / "x.jpg", tmp_path / "x_2.png"]) == [
        "x",
        "x_2",
        "x_2_2",
    ]
