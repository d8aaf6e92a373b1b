import numpy as np
import pytest

from cad.parts import Part
from perception.contour import ContourConfig, Refinement, refine_all
from perception.edges import visible_edges
from perception.gradients import EdgeImage
from perception.profiles import ProfileConfig, ProfileModel
from perception.table_camera import TableCamera


def refine(*arguments, **options) -> Refinement:
    """The best of the places found."""
    return refine_all(*arguments, **options)[0]


def test_jacobian_agrees_with_finite_differences(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=1)
    camera = TableCamera(intrinsics=picture.intrinsics, T_cam_table=picture.T_cam_table)
    pose = np.array([picture.x, picture.y, picture.yaw])
    samples = visible_edges(stepped, 0, camera.eye(pose))
    _, normals, jacobian = camera.project(samples, pose)
    for k, step in enumerate((1e-7, 1e-7, 1e-5)):
        d = np.zeros(3)
        d[k] = step
        ahead, behind = camera.project(samples, pose + d)[0], camera.project(samples, pose - d)[0]
        numeric = ((ahead - behind) * normals).sum(axis=1) / (2 * step)
        np.testing.assert_allclose(jacobian[:, k], numeric, rtol=1e-5, atol=1e-4 * np.abs(jacobian[:, k]).max())


def test_shifted_pose_moves_the_picture_by_that_much(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=2)
    camera = TableCamera(intrinsics=picture.intrinsics, T_cam_table=picture.T_cam_table)
    pose = np.array([picture.x, picture.y, picture.yaw])
    samples = visible_edges(stepped, 0, camera.eye(pose))
    moved = camera.project(samples, camera.shifted(pose, 3.0, -2.0))[0] - camera.project(samples, pose)[0]
    np.testing.assert_allclose(moved, np.broadcast_to([3.0, -2.0], moved.shape), atol=0.1)


@pytest.mark.parametrize(("stable_pose", "seed"), [(0, 3), (0, 4), (0, 5), (1, 6), (1, 7)])
def test_a_displaced_start_comes_back(stepped: Part, picture_of, stable_pose: int, seed: int) -> None:
    picture = picture_of(stepped, stable_pose, seed)
    rng = np.random.default_rng(seed)
    off = rng.uniform(-1, 1, 3) * [3e-4, 3e-4, np.radians(4)]
    found = refine(
        EdgeImage.of(picture.gray),
        picture.intrinsics,
        stepped,
        stable_pose,
        picture.T_cam_table,
        picture.x + off[0],
        picture.y + off[1],
        picture.yaw + off[2],
    )
    assert np.hypot(found.x - picture.x, found.y - picture.y) < 2e-5
    assert abs(found.yaw - picture.yaw) < np.radians(0.1)
    assert found.matched_fraction > 0.6 and found.explained > 0.8
    eigenvalues = np.linalg.eigvalsh(found.covariance)
    assert (eigenvalues > 0).all()
    assert np.allclose(found.covariance, found.covariance.T)


def test_the_wrong_face_matches_worse(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=8)
    place = picture.T_cam_table, picture.x, picture.y
    right = refine(picture.gray, picture.intrinsics, stepped, 0, *place, picture.yaw)
    turned = refine(picture.gray, picture.intrinsics, stepped, 0, *place, picture.yaw + np.pi)
    assert right.matched_fraction > turned.matched_fraction
    assert right.explained > turned.explained


def test_the_profile_model_peaks_at_the_truth(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=9)
    camera = TableCamera(intrinsics=picture.intrinsics, T_cam_table=picture.T_cam_table)
    pose = np.array([picture.x, picture.y, picture.yaw])
    samples = visible_edges(stepped, 0, camera.eye(pose))
    model = ProfileModel(samples, camera, camera.metres_per_pixel(pose))
    shifts = np.array([[u, v] for u in (-2.0, 0.0, 2.0) for v in (-2.0, 0.0, 2.0)])
    explained = model.explained_at(picture.gray.astype(np.float32), pose, shifts)
    assert explained.argmax() == 4
    fit = model.fit(picture.gray.astype(np.float32), pose, rounds=3)
    assert np.hypot(*(fit.pose - pose)[:2]) < 1e-5


def test_an_empty_picture_gives_an_answer_with_poor_scores(stepped: Part, picture_of) -> None:
    picture = picture_of(stepped, 0, seed=10)
    noise = np.random.default_rng(0).normal(100, 2, picture.gray.shape).astype(np.uint8)
    found = refine(noise, picture.intrinsics, stepped, 0, picture.T_cam_table, picture.x, picture.y, picture.yaw)
    assert found.matched_fraction < 0.3
    assert np.isfinite(found.covariance).all()


def test_settings_that_make_no_sense_are_errors() -> None:
    with pytest.raises(ValueError, match="reach"):
        ContourConfig(reach_px=(0.5,))
    with pytest.raises(ValueError, match="starts"):
        ContourConfig(starts=0)
    with pytest.raises(ValueError, match="step"):
        ProfileConfig(step_px=9.0)
