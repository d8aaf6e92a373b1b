"""Image-based environments: geometry of the cube, levels, kinds and seeds."""

import itertools

import numpy as np
import pytest

from scenes.environments import CAMERA_HALF_DEG, FACES, KINDS, directions, irradiance, make_environments
from scenes.gl import mujoco
from scenes.scene_export import environment_panorama

COUNT = 2 * len(KINDS)


@pytest.fixture(scope="module")
def cubes():
    return make_environments(np.random.default_rng(0), COUNT, size=64)


def test_the_faces_of_a_cube_map_cover_every_direction_once():
    d = directions(32)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1)
    solid_angle = np.abs(d).max(axis=-1) ** 3 * (2 / 32) ** 2
    assert solid_angle.sum() == pytest.approx(4 * np.pi, rel=1e-3)
    np.testing.assert_allclose((solid_angle[..., None] * d).sum(axis=(0, 1, 2)), 0, atol=1e-9)
    for forward, column, row in np.array(FACES):
        assert forward @ column == forward @ row == column @ row == 0
        # seen from within, columns count up to the left and rows down, on every face
        assert np.linalg.det([forward, column, row]) == pytest.approx(-1)


def test_neighbouring_faces_meet():
    """The direction at the middle of a face's border is halfway to the middle of another face."""
    middles = np.array([face[0] for face in FACES])
    for forward, column, row in np.array(FACES):
        for towards in (column, -column, row, -row):
            assert (middles == towards).all(axis=1).sum() == 1
            assert (towards != forward).any()


def test_irradiance_of_simple_skies():
    white = np.full((6, 32, 32, 3), 255, np.uint8)
    assert irradiance(white) == pytest.approx(1.0)
    assert irradiance(white // 2) == pytest.approx(127 / 255)
    below = np.where(directions(32)[..., 2:] < 0, white, 0).astype(np.uint8)
    assert irradiance(below) == 0
    half = np.where(directions(32)[..., :1] > 0, white, 0).astype(np.uint8)
    assert irradiance(half) == pytest.approx(0.5, abs=1e-6)
    zenith = directions(64)[..., 2:] > np.cos(np.radians(30))
    cap = np.where(zenith, np.uint8(255), np.uint8(0)) * np.ones(3, np.uint8)
    assert irradiance(cap) == pytest.approx(np.sin(np.radians(30)) ** 2, rel=0.03)


def test_environments_come_from_the_seed(cubes):
    again = make_environments(np.random.default_rng(0), COUNT, size=64)
    other = make_environments(np.random.default_rng(1), COUNT, size=64)
    for a, b, c in zip(cubes, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.1


def test_environments_use_the_range_and_light_the_board(cubes):
    assert {cube.shape for cube in cubes} == {(6, 64, 64, 3)}
    for cube in cubes:
        assert cube.dtype == np.uint8 and cube.max() == 255
        assert 0.03 < irradiance(cube) < 0.95
        assert np.median(cube) > 2  # no part of a room is black


def test_environments_differ_and_mostly_are_not_even(cubes):
    contrasts = [cube.max() / max(np.median(cube), 1) for cube in cubes]
    assert max(contrasts) > 10 and min(contrasts) < 5
    for a, b in itertools.pairwise(cubes):
        assert np.abs(a.astype(int) - b).mean() > 4


def test_the_camera_is_seen_as_a_dark_spot_straight_above(cubes):
    d = directions(64)
    up = d[..., 2]
    inside = up > np.cos(np.radians(CAMERA_HALF_DEG - 1))
    round_it = (up < np.cos(np.radians(CAMERA_HALF_DEG + 2))) & (up > np.cos(np.radians(CAMERA_HALF_DEG + 6)))
    for cube in cubes:
        assert cube[inside].mean() < 0.4 * cube[round_it].mean() + 1


def test_the_bench_below_is_even(cubes):
    below = directions(64)[..., 2] < -0.2
    for cube in cubes:
        assert np.ptp(cube[below], axis=0).max() <= 1


def test_a_cube_map_stands_in_the_world_as_its_faces_say():
    """Each pixel holds its direction: so does the panorama that MuJoCo's texture of it stands for."""
    cube = np.rint(127.5 + 127.5 * directions(32)).astype(np.uint8)
    spec = mujoco.MjSpec()
    texture = spec.add_texture(name="environment_00", type=mujoco.mjtTexture.mjTEXTURE_CUBE)
    texture.height, texture.width, texture.nchannel = 6 * 32, 32, 3
    texture.data = cube.tobytes()
    panorama = environment_panorama(spec.compile(), 0) * 2 - 1
    zenith, nadir, north, east = panorama[0, 64], panorama[-1, 64], panorama[32, 64], panorama[32, 96]
    for seen, expected in ((zenith, (0, 0, 1)), (nadir, (0, 0, -1)), (north, (0, 1, 0)), (east, (1, 0, 0))):
        np.testing.assert_allclose(seen, expected, atol=0.06)
