import numpy as np
import pytest

from cad.parts import planar
from cad.spatial import apply, inverse, rotation_angle, rotation_from_rotvec, transform
from perception.posenets import CropKeypoints
from perception.pvnet_baseline_pose import pose_from_keypoints, refine_to_rest
from perception.silhouette import render_view
from perception.voting import ransac_vote, vector_field


@pytest.mark.parametrize("face", [0, 1])
def test_a_perfect_vector_field_gives_the_exact_pose(stepped, picture_of, face: int) -> None:
    picture = picture_of(stepped, face, seed=40 + face)
    truth = picture.T_cam_table @ planar(picture.x, picture.y, picture.yaw) @ stepped.stable_poses[face].T_table_part
    mask = render_view(stepped, truth, picture.intrinsics).mask
    seen = picture.intrinsics.project(apply(truth, stepped.keypoints))
    v, u = np.argwhere(mask)[::40].T
    pixels, covariances = ransac_vote(
        np.stack([u, v], axis=1), vector_field(mask, seen)[v, u], np.random.default_rng(0)
    )
    voted = CropKeypoints(pixels=pixels, covariances=covariances, mask=mask.astype(float))
    found = pose_from_keypoints(stepped, voted, picture.intrinsics, picture.T_cam_table)
    assert found.stable_pose == face and found.rms_px < 1e-3
    np.testing.assert_allclose(found.raw_T_cam_part, truth, atol=1e-5)
    np.testing.assert_allclose(found.T_cam_part, truth, atol=1e-5)


def test_refinement_puts_a_tilted_pose_onto_the_plane_and_keeps_its_ray(stepped, picture_of) -> None:
    for face in (0, 1):
        picture = picture_of(stepped, face, seed=50 + face)
        pose = stepped.stable_poses[face]
        rest = picture.T_cam_table @ planar(picture.x, picture.y, picture.yaw) @ pose.T_table_part
        tilt = rotation_from_rotvec(np.radians(12.0) * picture.T_cam_table[:3, 0])
        raw = transform(tilt @ rest[:3, :3], 1.07 * rest[:3, 3])  # 49 mm too far along its ray
        refined, stable_pose, lean = refine_to_rest(raw, stepped, picture.intrinsics, picture.T_cam_table)
        assert stable_pose == face and lean == pytest.approx(np.radians(12.0), abs=1e-6)
        on_table = inverse(picture.T_cam_table) @ refined
        assert on_table[2, 3] == pytest.approx(pose.height_m, abs=1e-9)
        np.testing.assert_allclose(on_table[2, :3], pose.R_table_part[2], atol=1e-9)
        before, after = (picture.intrinsics.project(T[:3, 3]) for T in (raw, refined))
        np.testing.assert_allclose(after, before, atol=1e-6)
        np.testing.assert_allclose(refined[:3, 3], rest[:3, 3], atol=1e-9)
        assert rotation_angle(refined[:3, :3], rest[:3, :3]) < np.radians(1.0)


def test_a_pose_at_rest_stays_as_it_is(stepped, picture_of) -> None:
    picture = picture_of(stepped, 1, seed=60)
    rest = picture.T_cam_table @ planar(0.02, -0.01, 2.5) @ stepped.stable_poses[1].T_table_part
    refined, stable_pose, lean = refine_to_rest(rest, stepped, picture.intrinsics, picture.T_cam_table)
    assert stable_pose == 1 and lean < 1e-6
    np.testing.assert_allclose(refined, rest, atol=1e-9)
