import numpy as np
import pytest
import trimesh

from cad.keypoints import KEYPOINTS, farthest_points, surface_keypoints
from cad.nearest import Surface
from cad.parts import load_part


def test_the_first_keypoints_of_a_box_are_opposite_corners_and_all_lie_on_it():
    mesh = trimesh.creation.box((8e-3, 6e-3, 5e-3)).apply_translation([1e-3, 2e-3, 0])
    keypoints = surface_keypoints(mesh)
    assert keypoints.shape == (KEYPOINTS, 3)
    np.testing.assert_allclose(keypoints[0] + keypoints[1], 2 * mesh.centroid, atol=1e-12)
    assert np.linalg.norm(keypoints[0] - keypoints[1]) == pytest.approx(np.linalg.norm(mesh.extents))
    assert Surface(mesh).largest(keypoints) < 1e-9
    np.testing.assert_array_equal(keypoints, surface_keypoints(mesh))


def test_each_keypoint_is_the_farthest_from_those_before():
    points = np.random.default_rng(0).normal(size=(200, 3))
    chosen = farthest_points(points, 6, np.zeros(3))
    for i in range(1, 6):
        gap = np.linalg.norm(points[:, None] - chosen[None, :i], axis=-1).min(axis=1)
        assert np.linalg.norm(chosen[i] - chosen[:i], axis=1).min() == pytest.approx(gap.max())


@pytest.mark.parametrize("count", [0, 201])
def test_impossible_counts_are_refused(count):
    with pytest.raises(ValueError, match="200 points"):
        farthest_points(np.zeros((200, 3)), count, np.zeros(3))


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_stored_keypoints_are_those_of_the_stored_mesh(name):
    part = load_part(name)
    assert part.keypoints.shape == (KEYPOINTS, 3)
    assert Surface(part.mesh).largest(part.keypoints) < 1e-8
    np.testing.assert_allclose(part.keypoints, surface_keypoints(part.mesh), atol=1e-8)
    gaps = np.linalg.norm(part.keypoints[:, None] - part.keypoints[None], axis=-1)
    assert gaps[~np.eye(KEYPOINTS, dtype=bool)].min() > 2e-3
