"""Lens distortion against OpenCV's, and labels against what is seen through the lens."""

import cv2
import numpy as np
import pytest

from cad.parts import load_part
from cad.spatial import BASLER, apply, inverse
from cad.tagboard import TagboardConfig
from scenes.errors import SceneError
from scenes.lens import Lens, Warp, magnified
from scenes.randomize import DEFAULT_LOOK, camera_above, draw_lens
from scenes.ranges import LensRanges, LookRanges
from scenes.shots import Shot
from scenes.stage import Stage, StageConfig

LENS = Lens(k1=-0.08, k2=0.05, p1=0.001, p2=-0.002)


def corner_points(rng, count=200):
    """Normalised points (N, 2) all over the frame."""
    pixels = rng.uniform(0, [BASLER.width, BASLER.height], (count, 2))
    return BASLER.rays(pixels)[:, :2]


def test_distortion_is_opencvs():
    points = corner_points(np.random.default_rng(0))
    expected, _ = cv2.projectPoints(
        np.column_stack([points, np.ones(len(points))]),
        np.zeros(3),
        np.zeros(3),
        np.eye(3),
        np.array(LENS.coefficients),
    )
    np.testing.assert_allclose(LENS.distort(points), expected[:, 0], atol=1e-12)


def test_undistorting_undoes_distorting():
    points = corner_points(np.random.default_rng(1))
    np.testing.assert_allclose(LENS.distort(LENS.undistort(points)), points, atol=1e-10)
    np.testing.assert_allclose(LENS.undistort(LENS.distort(points)), points, atol=1e-10)


def test_a_straight_lens_is_the_pinhole_camera_and_resamples_nothing():
    window = BASLER.crop(100, 200, 64, 48)
    p_cam = np.random.default_rng(0).uniform(1, 2, (20, 3))
    np.testing.assert_allclose(Lens().project(window, p_cam), window.project(p_cam), atol=1e-9)
    warp, image = Warp(Lens(), window), np.zeros((48, 64, 3), np.uint8)
    assert warp.source == warp.label_source == window
    assert warp.colours(image) is image and warp.labels(image) is image


def blobs(intrinsics, at, sigma=2.5):
    """Bright Gaussian spots of a pinhole image at pixels (N, 2), and which spot is nearest (H, W)."""
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width]
    distance = (u[..., None] - at[:, 0]) ** 2 + (v[..., None] - at[:, 1]) ** 2
    image = 200 * np.exp(-distance / (2 * sigma**2)).sum(axis=-1)
    return np.repeat(image[..., None], 3, 2).astype(np.float32), distance.argmin(axis=-1).astype(np.int16)


@pytest.mark.parametrize("corner", [(0, 0), (5300, 3500), (2600, 1700), (0, 3500)])
def test_projected_points_lie_on_what_is_seen(corner):
    window = BASLER.crop(*corner, 120, 100)
    wanted = np.array([[20.3, 25.1], [60.0, 50.5], [100.4, 80.2], [30.7, 75.9]])
    p_cam = np.column_stack([LENS.undistort(window.rays(wanted)[:, :2]), np.ones(4)]) * 0.7
    np.testing.assert_allclose(LENS.project(window, p_cam), wanted, atol=1e-6)
    warp = Warp(LENS, window)
    seen = warp.colours(blobs(warp.source, warp.source.project(p_cam))[0])[..., 0]
    v, u = np.mgrid[:100, :120]
    for x, y in wanted:
        near = np.where((u - x) ** 2 + (v - y) ** 2 < 81, seen, 0.0)
        centre = np.array([(near * u).sum(), (near * v).sum()]) / near.sum()
        np.testing.assert_allclose(centre, [x, y], atol=0.05)


def test_labels_are_within_a_quarter_of_a_pixel():
    """A straight border between two labels lies where the lens puts it: checked column by column."""
    window = BASLER.crop(150, 100, 160, 120)
    warp = Warp(LENS, window)
    source = warp.label_source
    slope, level = 0.137, 0.4321
    u, v = np.meshgrid(np.arange(source.width), np.arange(source.height))
    rays = source.rays(np.stack([u, v], -1))
    base = LENS.undistort(window.rays([80.0, 60.0])[:2])
    above = (rays[..., 1] - base[1] - slope * (rays[..., 0] - base[0])) * BASLER.fy > level
    labels = warp.labels(above.astype(np.int16))
    assert labels.shape == (120, 160)
    x = np.linspace(-100, 100, 4001) / BASLER.fx
    line = np.stack([base[0] + x, base[1] + slope * x + level / BASLER.fy], -1)
    pixels = LENS.distort(line) * [window.fx, window.fy] + [window.cx, window.cy]
    border = np.interp(np.arange(160), pixels[:, 0], pixels[:, 1])
    first = labels.argmax(axis=0)  # the first row below the border
    assert (first - border).max() < 1 + 0.27
    assert (first - border).min() > -0.27


def test_a_magnified_camera_sees_the_same_rays():
    window = BASLER.crop(10, 20, 32, 24)
    fine = magnified(window, 2)
    np.testing.assert_allclose(fine.rays([-0.5, -0.5]), window.rays([-0.5, -0.5]), atol=1e-12)
    np.testing.assert_allclose(fine.rays([63.5, 47.5]), window.rays([31.5, 23.5]), atol=1e-12)


def test_a_lens_that_folds_the_image_is_refused():
    with pytest.raises(SceneError, match=r"k1=|\(-4"):
        Lens(k1=-4.0)
    with pytest.raises(SceneError, match="finite"):
        Lens(k1=float("nan"))


def test_drawn_lenses_keep_their_ranges():
    ranges, rng = LensRanges(k1=(-0.1, -0.02), p2=(0.0, 0.001)), np.random.default_rng(0)
    for _ in range(50):
        lens = draw_lens(ranges, rng)
        assert -0.1 <= lens.k1 <= -0.02 and 0 <= lens.p2 <= 0.001
        assert lens.k2 == 0 and lens.p1 == 0


@pytest.fixture(scope="module")
def stage():
    stage = Stage(
        [load_part("main")], [], StageConfig(slots=1, max_size=(200, 200), shadow_half_m=0.02, shadow_size=256)
    )
    yield stage
    stage.close()


def test_a_stage_is_seen_through_its_lens(stage):
    """A tag near the frame's corner: its printed corners are found where the lens projects them; tiles join."""

    board, T_board_cam = TagboardConfig(), camera_above(0.7)
    tag = board.ids[0]
    x, y = board.centre(tag)
    half = board.tag_m / 2
    p_board = np.array(
        [[x - half, y + half, 0.0], [x + half, y + half, 0], [x + half, y - half, 0], [x - half, y - half, 0]]
    )
    p_cam = apply(inverse(T_board_cam), p_board)
    camera = BASLER.downscaled(2)
    seen = LENS.project(camera, p_cam)
    low = np.floor(seen.min(axis=0)).astype(int) - 40
    size = np.ceil(seen.max(axis=0)).astype(int) + 40 - low
    window = camera.crop(int(low[0]), int(low[1]), int(size[0]), int(size[1]))
    assert size.max() > 200  # more than one tile
    shot = Shot(intrinsics=window, downscale=2, T_board_cam=T_board_cam, focus_board=(x, y), parts=(), distractors=())
    stage.arrange(shot)
    stage.lens = LENS
    stage.dress(shot, DEFAULT_LOOK, LookRanges(), np.random.default_rng(0))
    drawn = stage.render(window, ("rgb", "instances", "depth"))
    assert drawn.rgb.shape[:2] == drawn.instances.shape == drawn.depth_m.shape == (window.height, window.width)
    gray = drawn.rgb[..., 1].copy()
    corners = (seen - low).astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(
        gray, corners.copy(), (5, 5), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    )
    assert np.abs(found - corners).max() < 0.15
    pinhole = camera.project(p_cam) - low
    assert np.abs(pinhole - corners[:, 0]).max() > 2.0
