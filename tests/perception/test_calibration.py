import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cad.spatial import (
    BASLER,
    Array,
    Intrinsics,
    apply,
    inverse,
    rotation_angle,
    rotation_from_rotvec,
    rotation_x,
    transform,
)
from cad.tagboard import TagboardConfig
from perception.calibration import camera_from_tags, find_tags, solve_planar_pose, table_from_board
from perception.estimates import Frame, PerceptionError

BOARD = TagboardConfig()
HALF = BASLER.downscaled(2)
PIXELS_PER_M = 12000


def looking_down(tilt_deg: float, seed: int) -> Array:
    """``T_cam_board`` of a camera 0.7 m up, tilted by ``tilt_deg`` about a random level axis."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    rotvec = np.radians(tilt_deg) * np.array([np.cos(angle), np.sin(angle), 0.0]) + [0.0, 0.0, 0.02]
    T_board_cam = transform(rotation_x(np.pi), [*rng.uniform(-0.004, 0.004, 2), 0.70])
    return inverse(T_board_cam @ transform(rotation_from_rotvec(rotvec)))


def photograph(T_cam_board: Array, camera: Intrinsics, noise: float = 2.0) -> NDArray[np.uint8]:
    """The printed board through ``camera``: the texture warped by the plane's homography, area averaged, noisy."""
    ss = 2
    fine = Intrinsics(
        width=camera.width * ss,
        height=camera.height * ss,
        fx=camera.fx * ss,
        fy=camera.fy * ss,
        cx=(camera.cx + 0.5) * ss - 0.5,
        cy=(camera.cy + 0.5) * ss - 0.5,
    )
    to_board = np.array(
        [
            [1 / PIXELS_PER_M, 0, 0.5 / PIXELS_PER_M - BOARD.width_m / 2],
            [0, -1 / PIXELS_PER_M, BOARD.height_m / 2 - 0.5 / PIXELS_PER_M],
            [0, 0, 1],
        ]
    )
    H = fine.matrix @ np.column_stack([T_cam_board[:3, :2], T_cam_board[:3, 3]]) @ to_board
    gray = cv2.warpPerspective(BOARD.texture(PIXELS_PER_M), H, (fine.width, fine.height), borderValue=(120,))
    gray = cv2.resize(gray, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    gray += np.random.default_rng(0).normal(0.0, noise, gray.shape)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def frame(image: NDArray[np.uint8], camera: Intrinsics = HALF) -> Frame:
    return Frame(image=image, intrinsics=camera, time_s=0.0)


@pytest.mark.parametrize(("tilt_deg", "camera"), [(0.0, BASLER), (0.7, HALF), (2.0, HALF)])
def test_pose_of_a_known_view_is_recovered(tilt_deg: float, camera: Intrinsics) -> None:
    T_cam_board = looking_down(tilt_deg, seed=int(10 * tilt_deg))
    found = camera_from_tags(frame(photograph(T_cam_board, camera), camera), BOARD)
    assert found.tags_seen >= 20
    assert np.linalg.norm(found.T_cam_board[:3, 3] - T_cam_board[:3, 3]) < 0.05e-3
    assert rotation_angle(found.T_cam_board[:3, :3], T_cam_board[:3, :3]) < np.radians(0.02)
    assert found.rms_px < 0.25


@pytest.fixture(scope="module")
def level_view() -> tuple[Array, NDArray[np.uint8]]:
    T_cam_board = looking_down(0.3, seed=1)
    return T_cam_board, photograph(T_cam_board, HALF)


def test_pixel_centres_are_integers(level_view: tuple[Array, NDArray[np.uint8]]) -> None:
    """The mean of the corner errors, over the four corners of each tag, shows no shift of half a pixel."""
    T_cam_board, image = level_view
    ids, corners_px = find_tags(frame(image), BOARD)
    truth = HALF.project(apply(T_cam_board, np.stack([BOARD.corners(int(i)) for i in ids])))
    assert np.all(np.abs((corners_px - truth).mean(axis=(0, 1))) < 0.03)


def test_a_covered_tag_and_a_false_corner_do_no_harm(level_view: tuple[Array, NDArray[np.uint8]]) -> None:
    T_cam_board, image = level_view
    spoiled = image.copy()
    spoiled[: HALF.height // 2, : HALF.width // 4] = 90
    u, v = np.round(HALF.project(apply(T_cam_board, BOARD.corners(20)))[0]).astype(int)
    spoiled[v - 9 : v + 9, u - 9 : u + 9] = 128
    found = camera_from_tags(frame(spoiled), BOARD)
    assert 10 <= found.tags_seen <= 23
    assert np.linalg.norm(found.T_cam_board[:3, 3] - T_cam_board[:3, 3]) < 0.1e-3


def test_too_few_tags_say_how_many_and_what_to_do(level_view: tuple[Array, NDArray[np.uint8]]) -> None:
    image = level_view[1].copy()
    with pytest.raises(PerceptionError, match=r"^0 of the board's 26 tags seen, at least 4 are needed: bring"):
        camera_from_tags(frame(np.full_like(image, 100)), BOARD)
    image[:, HALF.width // 5 :] = 90
    image[HALF.height // 3 :] = 90
    with pytest.raises(PerceptionError, match=r"^[123] of the board's 26 tags"):
        camera_from_tags(frame(image), BOARD)


def test_tags_of_another_board_are_not_this_board(level_view: tuple[Array, NDArray[np.uint8]]) -> None:
    with pytest.raises(PerceptionError, match="tags seen"):
        camera_from_tags(frame(level_view[1]), TagboardConfig(first_id=100))


@pytest.mark.parametrize("seed", range(5))
def test_planar_pose_of_exact_pixels_is_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = looking_down(rng.uniform(0, 20), seed)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (8, 2)), np.zeros(8)])
    np.testing.assert_allclose(solve_planar_pose(points, BASLER.project(apply(T, points)), BASLER), T, atol=1e-6)


def test_table_frame_shares_plane_and_origin_and_faces_the_image() -> None:
    T_cam_board = looking_down(5.0, seed=2)
    T = table_from_board(T_cam_board)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(T[:3, 2:], T_cam_board[:3, 2:])
    assert np.linalg.det(T[:3, :3]) > 0
    assert T[0, 0] > 0.99 and T[1, 1] < -0.99
    assert np.cross(T[:3, 0], [1.0, 0.0, 0.0]) @ T[:3, 2] == pytest.approx(0.0, abs=1e-12)


def test_a_camera_that_looks_along_the_board_has_no_table_frame() -> None:
    T_cam_board = transform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [0.0, 0.0, 0.7])
    with pytest.raises(PerceptionError, match="from above"):
        table_from_board(T_cam_board)
