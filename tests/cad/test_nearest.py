import numpy as np
import pytest
import trimesh

from cad.nearest import Surface

SIZE = (10e-3, 6e-3, 3e-3)
POINTS = np.array([[0, 0, 1.53e-3], [0, 0, 0], [6e-3, 4e-3, 0], [1e-3, 3e-3, 1.5e-3]])
DISTANCES = np.array([3e-5, 1.5e-3, np.sqrt(2e-6), 0])


@pytest.fixture(scope="module")
def surface():
    return Surface(trimesh.creation.box(SIZE))


def test_distances_are_exact_at_the_size_of_the_parts(surface):
    np.testing.assert_allclose(surface.distance(POINTS), DISTANCES, atol=1e-9)
    assert surface.distance(np.empty((0, 3))).shape == (0,)
    assert surface.largest(POINTS) == pytest.approx(1.5e-3)


def test_bounds_are_never_below_the_distances(surface):
    points = np.random.default_rng(0).uniform(-8e-3, 8e-3, (500, 3))
    exact = surface.distance(points)
    for samples in (1, 8):
        assert (surface.upper_bounds(points, samples) > exact - 1e-9).all()
    assert surface.largest(points) == pytest.approx(exact.max())


def test_the_nearest_points_lie_on_the_surface_with_its_outward_normals(surface):
    points = np.array([[1e-3, 1e-3, 2e-3], [-7e-3, 0.5e-3, 0.2e-3]])
    found, normals = surface.nearest(points)
    np.testing.assert_allclose(found, [[1e-3, 1e-3, 1.5e-3], [-5e-3, 0.5e-3, 0.2e-3]], atol=1e-12)
    np.testing.assert_allclose(normals, [[0, 0, 1], [-1, 0, 0]], atol=1e-12)


def test_limits_are_judged_on_either_side(surface):
    assert surface.all_within(POINTS, 1.501e-3)
    assert not surface.all_within(POINTS, 1.499e-3)
    assert surface.surely_beyond(POINTS, 1e-3)
    assert not surface.surely_beyond(POINTS, 1.6e-3)
