"""Pictures show the part where the estimate has it, at any camera's resolution."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cad.parts import planar
from cad.spatial import BASLER, rotation_x, transform
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.overlay import BORDER, INSET, colour_of, draw_error_ellipse, draw_overlay, save_picture, with_mask

T_CAM_TABLE = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])


def estimate_of(part, x=0.01, y=0.02, yaw=0.4, **changes):
    T = T_CAM_TABLE @ planar(x, y, yaw) @ part.stable_poses[0].T_table_part
    plain = PartEstimate(part=part.name, T_cam_part=T, stable_pose=0, score=0.9, covariance=1e-10 * np.eye(6))
    return replace(plain, **changes)


def overlay_of(part, camera, estimates):
    frame = Frame(image=np.full((camera.height, camera.width, 3), 60, np.uint8), intrinsics=camera, time_s=0.0)
    seen = FrameEstimate(T_cam_board=T_CAM_TABLE, parts=tuple(estimates), tags_seen=4, tag_rms_px=0.1)
    return draw_overlay(frame, seen, {part.name: part})


@pytest.mark.parametrize("width", [1368, 2736])
def test_an_inset_shows_the_outline_at_one_scale(stepped, width):
    camera = BASLER.resampled(width, width * 2 // 3)
    picture = overlay_of(stepped, camera, [estimate_of(stepped)])
    assert picture.shape == (912 + INSET + 2 * BORDER, 1368, 3)
    inset = picture[-INSET - BORDER : -BORDER, BORDER : INSET + BORDER].astype(int)
    drawn = np.abs(inset - np.array(colour_of(estimate_of(stepped)))).sum(axis=-1) < 60
    drawn[:30] = False  # the label
    v, u = np.nonzero(drawn)
    # 8.6 x 6.2 mm turned by 0.4 rad, at 20 pixels a millimetre
    wide, high = 8.6 * np.cos(0.4) + 6.2 * np.sin(0.4), 8.6 * np.sin(0.4) + 6.2 * np.cos(0.4)
    assert np.ptp(u) == pytest.approx(wide * 20, abs=8) and np.ptp(v) == pytest.approx(high * 20, abs=8)
    assert abs((u.min() + u.max()) / 2 - INSET / 2) < 6 and abs((v.min() + v.max()) / 2 - INSET / 2) < 6


def test_declined_estimates_have_a_red_border(stepped):
    camera = BASLER.resampled(1368, 912)
    picture = overlay_of(stepped, camera, [estimate_of(stepped), estimate_of(stepped, x=-0.03, verdict="ambiguous")])
    assert tuple(picture[-1, 10]) == colour_of(estimate_of(stepped))
    assert tuple(picture[-1, 10 + INSET + 2 * BORDER]) == (200, 0, 0)


def test_a_small_photograph_still_has_room_for_insets(stepped):
    camera = BASLER.resampled(300, 200)
    picture = overlay_of(stepped, camera, [estimate_of(stepped)])
    assert picture.shape == (200 + INSET + 2 * BORDER, INSET + 2 * BORDER, 3)
    assert overlay_of(stepped, camera, []).shape[0] == 200


def test_the_ellipse_has_the_size_that_the_covariance_says(stepped):
    camera = BASLER.crop(2300, 1400, 900, 800)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([1e-5, 2e-5, 3e-5]) ** 2  # of x and y: 0.4 and 0.8 mm as drawn
    image = np.zeros((800, 900, 3), np.uint8)
    estimate = estimate_of(stepped, covariance=covariance)
    draw_error_ellipse(image, camera, estimate, T_CAM_TABLE)
    u, v, w, h = cv2.boundingRect((image[..., 0] > 100).astype(np.uint8))
    um_a_pixel = 1e6 * estimate.T_cam_part[2, 3] / camera.fx
    assert [w, h] == pytest.approx([800 / um_a_pixel, 1600 / um_a_pixel], abs=3)
    np.testing.assert_allclose([u + w / 2, v + h / 2], camera.project(estimate.T_cam_part[:3, 3]), atol=2)


def test_pictures_are_written_whole_or_not_at_all(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    save_picture(tmp_path / "new" / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1], image)
    with pytest.raises((OSError, cv2.error)):
        save_picture(tmp_path / "new" / "a.nonsense", image)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


def test_masks_are_made_where_they_are_missing(stepped):
    made = with_mask(estimate_of(stepped), {stepped.name: stepped}, BASLER)
    assert made.mask is not None and made.mask.sum() > 5000
    assert with_mask(made, {}, BASLER) is made
