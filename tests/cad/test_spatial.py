import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cad.spatial import (
    BASLER,
    CAM_FROM_CAMGL,
    Intrinsics,
    angle_between,
    apply,
    inverse,
    quat_wxyz_from_rotation,
    rotation_angle,
    rotation_from_quat_wxyz,
    rotation_from_rotvec,
    rotation_x,
    rotation_y,
    rotation_z,
    rotvec_from_rotation,
    transform,
    wrap_angle,
    yaw_of,
)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def random_rotations(rng, count):
    return Rotation.random(count, rng=rng).as_matrix()


def test_neighbouring_frames_cancel(rng):
    R = random_rotations(rng, 2)
    T_a_b, T_b_c = transform(R[0], [1, 2, 3]), transform(R[1], [-1, 0, 2])
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(apply(T_a_b @ T_b_c, points), apply(T_a_b, apply(T_b_c, points)))
    np.testing.assert_allclose(inverse(T_a_b) @ T_a_b, np.eye(4), atol=1e-14)
    stacked = np.stack([T_a_b, T_b_c])
    np.testing.assert_allclose(inverse(stacked) @ stacked, np.tile(np.eye(4), (2, 1, 1)), atol=1e-14)


@pytest.mark.parametrize(("make", "axis"), [(rotation_x, 0), (rotation_y, 1), (rotation_z, 2)])
def test_axis_rotations_turn_the_right_way(make, axis):
    R = make(np.pi / 2)
    before, after = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    np.testing.assert_allclose(R @ before, after, atol=1e-15)
    np.testing.assert_allclose(R @ np.eye(3)[axis], np.eye(3)[axis])


def test_quaternions_are_wxyz_with_positive_w_and_need_no_norm(rng):
    R = random_rotations(rng, 50)
    quat = quat_wxyz_from_rotation(R)
    assert (quat[:, 0] >= 0).all()
    np.testing.assert_allclose(rotation_from_quat_wxyz(3 * quat), R, atol=1e-12)
    np.testing.assert_allclose(quat_wxyz_from_rotation(np.eye(3)), [1, 0, 0, 0])


def test_angles_between_directions_are_exact_near_zero_and_pi():
    x = np.eye(3)[0]
    turned = np.array([rotation_z(angle) @ x for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi)])
    np.testing.assert_allclose(angle_between(5 * turned, x), [0, 1e-9, 1, np.pi - 1e-9, np.pi], rtol=1e-7)


def test_rotation_vectors_and_angles_agree(rng):
    for rotvec in rng.normal(size=(20, 3)):
        R = rotation_from_rotvec(rotvec)
        np.testing.assert_allclose(rotvec_from_rotation(R), rotvec, atol=1e-12)
        assert rotation_angle(np.eye(3), R) == pytest.approx(np.linalg.norm(rotvec))
    tiny = rotation_z(1e-9)
    assert rotation_angle(np.eye(3), tiny) == pytest.approx(1e-9, rel=1e-6)


def test_yaw_is_that_of_the_nearest_rotation_about_z():
    assert yaw_of(rotation_z(2.5)) == pytest.approx(2.5)
    assert yaw_of(rotation_x(0.01) @ rotation_z(-1.2)) == pytest.approx(-1.2, abs=1e-3)


def test_angles_wrap_to_a_half_open_interval():
    np.testing.assert_allclose(wrap_angle([np.pi, -np.pi, 3 * np.pi, 0.1 + 4 * np.pi]), [-np.pi, -np.pi, -np.pi, 0.1])


def test_mujocos_camera_looks_along_minus_z():
    np.testing.assert_allclose(apply(CAM_FROM_CAMGL, [0.1, 0.2, -1.0]), [0.1, -0.2, 1.0])


def test_rays_and_projection_are_inverse(rng):
    pixels = rng.uniform(0, 3000, size=(10, 2))
    np.testing.assert_allclose(BASLER.project(0.7 * BASLER.rays(pixels)), pixels)
    np.testing.assert_allclose(BASLER.matrix @ [0, 0, 1], [BASLER.cx, BASLER.cy, 1])


def test_a_crop_sees_the_same_rays_through_shifted_pixels(rng):
    crop = BASLER.crop(1000, 500, 256, 256)
    point = np.array([-0.02, 0.01, 0.7])
    np.testing.assert_allclose(crop.project(point) + np.array([1000, 500]), BASLER.project(point))
    assert (crop.width, crop.height) == (256, 256)


def test_downscaling_averages_blocks_of_pixels():
    half = BASLER.downscaled(2)
    assert (half.width, half.height) == (2736, 1824)
    block = np.array([[10.0, 20.0], [11.0, 20.0], [10.0, 21.0], [11.0, 21.0]])
    np.testing.assert_allclose(half.project(BASLER.rays(block).mean(axis=0)), [5, 10])
    with pytest.raises(ValueError, match="whole multiple"):
        BASLER.downscaled(7)


@pytest.mark.parametrize("bad", [{"width": 0}, {"height": -1}, {"fx": 0.0}, {"fy": -2.0}])
def test_impossible_cameras_are_refused(bad):
    good = {"width": 10, "height": 10, "fx": 5.0, "fy": 5.0, "cx": 4.5, "cy": 4.5}
    with pytest.raises(ValueError, match="must be"):
        Intrinsics(**good | bad)
