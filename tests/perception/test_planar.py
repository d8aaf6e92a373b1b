import numpy as np
import pytest

from cad.parts import StablePose, planar
from cad.spatial import BASLER, apply, rotation_from_rotvec, rotation_x, transform, wrap_angle
from perception.planar import PlanarError, on_plane, planar_of, solve_planar

CAMERA = BASLER.crop(3000, 1200, 256, 256).downscaled(2)
T_CAM_TABLE = transform(rotation_from_rotvec([0.02, -0.01, 0.0]) @ rotation_x(np.pi), [0.001, -0.002, 0.7])
POSE = StablePose(
    index=0,
    R_table_part=rotation_from_rotvec([1.2, 0.3, -0.4]),
    t_table_part=np.array([0.4e-3, -0.3e-3, 2e-3]),
    probability=1.0,
    view_class=0,
)
KEYPOINTS = np.random.default_rng(0).uniform(-4e-3, 4e-3, (8, 3))
COVARIANCES = np.tile(np.eye(2), (8, 1, 1))


def see(x: float, y: float, yaw: float):
    return CAMERA.project(apply(T_CAM_TABLE @ planar(x, y, yaw) @ POSE.T_table_part, KEYPOINTS))


def solve(pixels, covariances=COVARIANCES):
    return solve_planar(KEYPOINTS, pixels, covariances, POSE, CAMERA, T_CAM_TABLE)


@pytest.mark.parametrize("yaw", [-3.1, -1.0, 0.0, 2.0])
def test_project_then_solve_gives_the_placement_back(yaw: float) -> None:
    found = solve(see(0.021, 0.035, yaw))
    assert np.allclose([found.x, found.y], [0.021, 0.035], atol=1e-9)
    assert abs(wrap_angle(found.yaw - yaw)) < 1e-6
    T = T_CAM_TABLE @ planar(0.021, 0.035, yaw) @ POSE.T_table_part
    assert np.allclose(found.T_cam_part(T_CAM_TABLE, POSE), T, atol=1e-6)


def test_placement_read_from_a_pose_is_the_placement_it_was_made_of() -> None:
    T = T_CAM_TABLE @ planar(0.01, -0.02, 2.5) @ POSE.T_table_part
    assert np.allclose(planar_of(T, T_CAM_TABLE, POSE), [0.01, -0.02, 2.5], atol=1e-9)


def test_points_on_a_plane_project_back_to_their_pixels() -> None:
    pixels = np.random.default_rng(1).uniform(0, 127, (20, 2))
    points = on_plane(pixels, np.full(20, 1.5e-3), CAMERA, T_CAM_TABLE)
    assert np.allclose(points[:, 2], 1.5e-3)
    assert np.allclose(CAMERA.project(apply(T_CAM_TABLE, points)), pixels, atol=1e-6)


def test_a_stray_keypoint_loses_its_weight() -> None:
    pixels = see(0.0, 0.0, 0.7) + np.random.default_rng(2).normal(0, 0.1, (8, 2))
    pixels[5] += [20.0, 20.0]
    assert abs(solve(pixels).yaw - 0.7) < 0.03


def test_covariance_is_that_of_the_spread() -> None:
    rng = np.random.default_rng(3)
    found = [solve(see(0, 0, 0.3) + rng.normal(0, 1.0, (8, 2))) for _ in range(300)]
    spread = np.std([[f.x, f.y, f.yaw] for f in found], axis=0)
    stated = np.mean([np.sqrt(np.diag(f.covariance)) for f in found], axis=0)
    assert ((stated / spread > 0.6) & (stated / spread < 1.7)).all()


def test_wrong_input_is_named() -> None:
    with pytest.raises(PlanarError, match="K >= 2"):
        solve_planar(KEYPOINTS[:1], np.zeros((1, 2)), COVARIANCES[:1], POSE, CAMERA, T_CAM_TABLE)
    behind = transform(rotation_x(np.pi), [0.0, 0.0, -0.7])
    with pytest.raises(PlanarError, match="do not meet the table plane"):
        on_plane(np.zeros((1, 2)), np.zeros(1), CAMERA, behind)
