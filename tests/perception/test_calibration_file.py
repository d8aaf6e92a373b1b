"""Calibrations survive writing and reading; what is wrong with a file is said by name."""

import json
import re

import cv2
import numpy as np
import pytest

from cad.spatial import BASLER, Intrinsics, rotation_from_rotvec, transform
from perception.calibration_file import CalibrationError, CellCalibration, Covariance

LENS = (-0.08, 0.05, 0.001, -0.002, 0.01)
FULL = CellCalibration(
    intrinsics=Intrinsics(width=5472, height=3648, fx=10420.5, fy=10419.25, cx=2740.125, cy=1820.5),
    distortion=LENS,
    date="2026-11-22T10:00:00+00:00",
    method="tagboard, 24 views",
    residuals={"rms_px": 0.07, "views": 24.0},
    covariance=Covariance(parameters=("fx_px", "fy_px"), matrix=np.array([[4.0, 1.0], [1.0, 9.0]])),
    T_board_cam=transform(rotation_from_rotvec([3.1, 0.02, 0.01]), [0.01, -0.02, 0.7]),
    T_base_board=transform(rotation_from_rotvec([0, 0, 0.5]), [0.4, 0.1, 0.0]),
    gripper_counts={"open": 3, "closed": 230},
    robot_serial="20235500000",
    camera_serial="22890000",
)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "cell" / "calibration.json"
    FULL.save(path)
    read = CellCalibration.load(path)
    for name in ("intrinsics", "distortion", "date", "method", "residuals", "gripper_counts", "robot_serial"):
        assert getattr(read, name) == getattr(FULL, name)
    np.testing.assert_array_equal(read.T_board_cam, FULL.T_board_cam)
    np.testing.assert_array_equal(read.T_base_board, FULL.T_base_board)
    assert read.covariance is not None and read.covariance.parameters == ("fx_px", "fy_px")
    np.testing.assert_array_equal(read.covariance.matrix, [[4.0, 1.0], [1.0, 9.0]])
    assert [p.name for p in path.parent.iterdir()] == ["calibration.json"]


def test_only_the_camera_is_needed(tmp_path):
    CellCalibration(intrinsics=BASLER).save(tmp_path / "c.json")
    stored = json.loads((tmp_path / "c.json").read_text())
    assert set(stored) == {"format", "version", "intrinsics"}
    read = CellCalibration.load(tmp_path / "c.json")
    assert read.intrinsics == BASLER and read.distortion == () and read.T_board_cam is None
    assert CellCalibration.load("nominal").intrinsics == BASLER


@pytest.mark.parametrize("suffix", ["yml", "json"])
def test_opencvs_own_files_are_read(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    K = FULL.intrinsics.matrix
    stored = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 5472), ("image_height", 3648), ("avg_reprojection_error", 0.125)):
        stored.write(name, value)
    stored.write("camera_matrix", K)
    stored.write("distortion_coefficients", np.array([LENS]).T)
    stored.release()
    read = CellCalibration.load(path)
    assert read.intrinsics == FULL.intrinsics and read.distortion == LENS and read.residuals == {"rms_px": 0.125}


ROS = """%YAML:1.0
image_width: 640
image_height: 480
camera_name: narrow
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [800.5, 0, 320, 0, 801, 240, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -2e-1, 1.e-05, 0, 0]}
"""


def test_a_file_of_ros_is_read(tmp_path):
    (tmp_path / "ros.yaml").write_text(ROS)
    read = CellCalibration.load(tmp_path / "ros.yaml")
    assert read.intrinsics == Intrinsics(width=640, height=480, fx=800.5, fy=801.0, cx=320.0, cy=240.0)
    assert read.distortion == (0.1, -0.2, 1e-5, 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("plumb_bob", "equidistant"), "distortion_model is 'equidistant'"),
        (("image_width: 640\n", ""), "image_width is None"),
        (("camera_matrix", "matrix"), "no camera_matrix"),
        (("[800.5, 0,", "[800.5, 3,"), "must be fx 0 cx"),
        (("rows: 3, cols: 3", "rows: 2, cols: 3"), "rows, cols and data"),
        (("[0.1, -2e-1, 1.e-05, 0, 0]", "[0.1]"), "0, 4, 5, 8, 12 or 14"),
        (("800.5", "-800.5"), "must be"),
        ((ROS, "[1, 2"), "neither JSON nor YAML"),
        ((ROS, "just words"), "no mapping"),
    ],
)
def test_what_is_wrong_with_a_camera_file_is_said(tmp_path, change, said):
    path = tmp_path / "ros.yaml"
    path.write_text(ROS.replace(*change).replace("cols: 5, data: [0.1]", "cols: 1, data: [0.1]"))
    with pytest.raises(CalibrationError, match=re.escape(said)) as caught:
        CellCalibration.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 2}, "version is 2"),
        ({"format": "other"}, "format is 'other'"),
        ({"fokus": 1}, "unknown field fokus"),
        ({"intrinsics": None}, "no intrinsics"),
        ({"intrinsics": {"width_px": 10}}, "width_px"),
        ({"distortion": [0.1, 0.2]}, "0, 4, 5, 8, 12 or 14"),
        ({"distortion": "none"}, "form"),
        ({"date": "yesterday"}, "ISO 8601"),
        ({"T_base_board": [[1, 0], [0, 1]]}, "T_base_board is no rigid"),
        ({"T_board_cam": (2 * np.eye(4)).tolist()}, "T_board_cam is no rigid"),
        ({"covariance": {"parameters": ["a"], "matrix": [[1.0, 2.0], [2.0, 1.0]]}}, "one row and column"),
        ({"covariance": {"parameters": ["a", "b"], "matrix": [[1.0, 2.0], [2.0, 1.0]]}}, "eigenvalue"),
    ],
)
def test_what_is_wrong_with_a_calibration_is_said(tmp_path, change, said):
    path = tmp_path / "calibration.json"
    FULL.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(CalibrationError, match=re.escape(said)) as caught:
        CellCalibration.load(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_names_what_may_be_given(tmp_path):
    with pytest.raises(CalibrationError, match=r"No such file.*`nominal`"):
        CellCalibration.load(tmp_path / "none.json")


def test_photographs_of_another_size():
    nominal = CellCalibration.nominal()
    half = nominal.intrinsics_of(2736, 1824)
    assert half == BASLER.downscaled(2)
    p_cam = np.array([0.05, -0.03, 0.7])
    third = nominal.intrinsics_of(1920, 1280)
    np.testing.assert_allclose((third.project(p_cam) + 0.5) / 1920, (BASLER.project(p_cam) + 0.5) / 5472)
    window = nominal.intrinsics_of(1000, 600, (40, 30))
    np.testing.assert_allclose(window.project(p_cam), BASLER.project(p_cam) - [40, 30])
    with pytest.raises(CalibrationError, match=r"1000 x 600 .* 5472 x 3648.*--offset"):
        nominal.intrinsics_of(1000, 600)
    with pytest.raises(CalibrationError, match="on its side"):
        nominal.intrinsics_of(3648, 5472)
    with pytest.raises(CalibrationError, match="reaches out"):
        nominal.intrinsics_of(1000, 600, (5000, 0))
