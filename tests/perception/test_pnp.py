import numpy as np
import pytest

from cad.spatial import BASLER, rotation_angle, rotation_from_rotvec, transform
from perception.pnp import PnpError, solve_pnp

POINTS = np.random.default_rng(0).uniform(-4.5e-3, 4.5e-3, (8, 3))
CAMERA = BASLER.crop(2500, 1500, 256, 256).downscaled(2)
COVARIANCES = np.tile(np.eye(2) * 0.25, (8, 1, 1))


def pose(rng: np.random.Generator):
    ray = CAMERA.rays(rng.uniform(50, 78, 2))
    return transform(rotation_from_rotvec(rng.normal(size=3)), ray * rng.uniform(0.6, 0.8))


def see(T):
    return CAMERA.project(POINTS @ T[:3, :3].T + T[:3, 3])


def test_project_then_solve_gives_the_pose_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        T = pose(rng)
        found = solve_pnp(POINTS, see(T), COVARIANCES, CAMERA)
        assert np.allclose(found.T_cam_part[:3, 3], T[:3, 3], atol=2e-5)
        assert rotation_angle(found.T_cam_part[:3, :3], T[:3, :3]) < 1e-3
        assert found.rms_px < 1e-2


def test_covariance_agrees_with_the_spread_of_solutions() -> None:
    rng = np.random.default_rng(2)
    T = pose(rng)
    found = [solve_pnp(POINTS, see(T) + rng.normal(0, 0.02, (8, 2)), COVARIANCES * 0.0016, CAMERA) for _ in range(150)]
    spread = np.cov(np.array([f.T_cam_part[:3, 3] for f in found]).T)
    stated = found[0].covariance[:3, :3]
    ratio = np.sqrt(np.diag(spread) / np.diag(stated))
    assert ((ratio > 0.7) & (ratio < 1.4)).all()


def test_depth_is_much_weaker_than_position_across() -> None:
    found = solve_pnp(POINTS, see(pose(np.random.default_rng(3))), COVARIANCES, CAMERA)
    deviation = np.sqrt(np.diag(found.covariance))
    assert deviation[2] > 20 * deviation[:2].max()


def test_an_uncertain_keypoint_hardly_moves_the_pose() -> None:
    T = pose(np.random.default_rng(4))
    pixels, covariances = see(T), COVARIANCES.copy()
    pixels[3] += [15.0, -10.0]
    trusted = solve_pnp(POINTS, pixels, covariances, CAMERA)
    covariances[3] *= 1e4
    doubted = solve_pnp(POINTS, pixels, covariances, CAMERA)

    def error(found):
        return np.linalg.norm(found.T_cam_part[:2, 3] - T[:2, 3])

    assert error(doubted) < 0.1 * error(trusted)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(PnpError, match="K >= 4"):
        solve_pnp(POINTS[:3], np.zeros((3, 2)), COVARIANCES[:3], CAMERA)
