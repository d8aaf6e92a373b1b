"""Photographs of every kind become the same pixels; undoing a lens leaves what a pinhole camera sees."""

import struct

import cv2
import numpy as np
import pytest

from cad.spatial import BASLER, Intrinsics
from perception.photo import LensCorrection, PhotoError, read_photo

CAMERA = Intrinsics(width=400, height=300, fx=500.0, fy=510.0, cx=205.0, cy=143.0)
BARREL = (-0.2, 0.03, 0.002, -0.001)


@pytest.fixture
def colours():
    return np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


@pytest.mark.parametrize("suffix", ["png", "tiff", "bmp"])
def test_colours_are_rgb_in_every_format(tmp_path, colours, suffix):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), cv2.cvtColor(colours, cv2.COLOR_RGB2BGR))
    np.testing.assert_array_equal(read_photo(path), colours)


def test_gray_and_transparent_pictures_become_rgb(tmp_path, colours):
    cv2.imwrite(str(tmp_path / "gray.png"), colours[..., 0])
    np.testing.assert_array_equal(read_photo(tmp_path / "gray.png"), np.repeat(colours[..., :1], 3, axis=2))
    cv2.imwrite(str(tmp_path / "rgba.png"), np.dstack([colours[..., ::-1], colours[..., 0]]))
    np.testing.assert_array_equal(read_photo(tmp_path / "rgba.png"), colours)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_sixteen_bits_become_eight_whatever_the_camera_fills(tmp_path, bits, suffix):
    values = np.linspace(0, 2**bits - 1, 48).astype(np.uint16).reshape(6, 8)
    cv2.imwrite(str(tmp_path / f"deep.{suffix}"), values)
    expected = values.astype(np.float64) * 255 / (2**bits - 1)
    assert np.abs(read_photo(tmp_path / f"deep.{suffix}")[..., 0] - expected).max() <= 1.0


def test_exif_orientation_is_ignored(tmp_path):
    gray = np.zeros((16, 32), np.uint8)
    gray[:, 16:] = 200
    jpeg = cv2.imencode(".jpg", gray)[1].tobytes()
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)  # orientation: turned by 90 degrees
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    path = tmp_path / "turned.jpg"
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    assert cv2.imread(str(path)).shape[:2] == (32, 16)  # others do turn it
    assert read_photo(path).shape[:2] == (16, 32)


def test_what_is_no_picture_is_said(tmp_path):
    with pytest.raises(PhotoError, match="there is no picture"):
        read_photo(tmp_path / "none.png")
    with pytest.raises(PhotoError, match="there is no picture"):
        read_photo(tmp_path)
    for content in (b"", b"not a picture", b"\x89PNG\r\n\x1a\nbroken"):
        (tmp_path / "bad.png").write_bytes(content)
        with pytest.raises(PhotoError, match="no picture that can be read"):
            read_photo(tmp_path / "bad.png")
    cv2.imwrite(str(tmp_path / "float.tiff"), np.zeros((4, 4, 3), np.float32))
    with pytest.raises(PhotoError, match="float32"):
        read_photo(tmp_path / "float.tiff")


def spots(camera: Intrinsics, at):
    v, u = np.mgrid[: camera.height, : camera.width]
    gray = sum(200 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8) for x, y in at)
    return np.repeat(np.asarray(gray).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def test_points_are_seen_where_the_pinhole_camera_has_them():
    rays = np.array([[x, y, 1.0] for x in (-0.35, 0.0, 0.3) for y in (-0.22, 0.05, 0.24)])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(BARREL))
    lens = LensCorrection.of(CAMERA, BARREL)
    image = lens.undistorted(spots(CAMERA, seen[:, 0])).astype(float)[..., 0]
    assert image.shape == (lens.pinhole.height, lens.pinhole.width)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    for x, y in lens.pinhole.project(rays):
        near = np.where((u - x) ** 2 + (v - y) ** 2 < 100, image, 0.0)
        np.testing.assert_allclose([(near * u).sum() / near.sum(), (near * v).sum() / near.sum()], [x, y], atol=0.15)
    np.testing.assert_allclose(lens.in_photo(lens.pinhole.project(rays)), seen[:, 0], atol=1e-9)


@pytest.mark.parametrize("coefficients", [BARREL, (0.1, 0.0, 0.0, 0.0, 0.02), (0.1, 0, 0, 0, 0, 0.3, 0, 0)])
def test_the_whole_photograph_is_in_the_undistorted_one(coefficients):
    lens = LensCorrection.of(CAMERA, coefficients)
    border = [[0, 0], [399, 0], [0, 299], [399, 299], [200, 0], [0, 150], [399, 150], [200, 299]]
    ideal = cv2.undistortPoints(
        np.array(border, float)[:, None], CAMERA.matrix, np.array(coefficients, float), P=lens.pinhole.matrix
    )[:, 0]
    assert (ideal > -1).all() and (ideal < [lens.pinhole.width, lens.pinhole.height]).all()


def test_without_distortion_nothing_is_resampled():
    lens = LensCorrection.of(CAMERA, (0.0, 0.0, 0.0, 0.0))
    image = np.zeros((300, 400, 3), np.uint8)
    assert lens.pinhole == CAMERA and lens.undistorted(image) is image
    np.testing.assert_array_equal(lens.in_photo(np.array([[3.0, 4.0]])), [[3.0, 4.0]])


def test_a_distortion_that_folds_the_image_is_refused():
    with pytest.raises(PhotoError, match="cannot be undone"):
        LensCorrection.of(BASLER, (-8.0, 0.0, 0.0, 0.0))
