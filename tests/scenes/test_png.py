"""PNG files hold what was given, in fewer bytes than with the encoder's own settings."""

import cv2
import numpy as np
import pytest

from scenes.png import encode_png

RNG = np.random.default_rng(0)
NOISY = np.clip(np.linspace(40, 200, 96)[None, :, None] + RNG.normal(0, 3, (64, 96, 3)), 0, 255).astype(np.uint8)
GREY = np.ascontiguousarray(NOISY[..., 0])
MASK = np.hypot(*(np.mgrid[:64, :96] - np.array([30, 50])[:, None, None])) < 20
DEPTH = np.rint(35000 + np.add.outer(np.arange(64), np.arange(96)) / 7).astype(np.uint16)


def decoded(image):
    return cv2.imdecode(np.frombuffer(encode_png(image), np.uint8), cv2.IMREAD_UNCHANGED)


def test_colours_are_read_back_in_opencv_order():
    np.testing.assert_array_equal(decoded(NOISY)[..., ::-1], NOISY)


@pytest.mark.parametrize("image", [GREY, DEPTH], ids=["grey", "depth"])
def test_levels_and_depth_are_read_back(image):
    again = decoded(image)
    assert again.dtype == image.dtype
    np.testing.assert_array_equal(again, image)


@pytest.mark.parametrize("mask", [MASK, MASK[::2, ::-1], np.zeros((5, 7), bool)], ids=["disc", "view", "empty"])
def test_masks_are_0_and_255(mask):
    again = decoded(mask)
    assert again.dtype == np.uint8
    np.testing.assert_array_equal(again, np.where(mask, 255, 0))


def test_noisy_colours_take_fewer_bytes_than_with_usual_settings():
    usual = cv2.imencode(".png", NOISY[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    assert len(encode_png(NOISY)) < len(usual)
