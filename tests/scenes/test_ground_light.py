"""Light on the ground: noise goes, prints and the mean stay; near things is where their shadows are, too."""

import numpy as np
import pytest
import trimesh

from cad.spatial import BASLER, Array, transform
from scenes.drawn_mesh import DrawnMesh
from scenes.ground_light import BAND_ROWS, MARGIN_M, boxes, near_things, smooth_light
from scenes.scene_export import DrawnGeom, DrawnLamp, Finish

ABOVE: Array = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0.7], [0, 0, 0, 1.0]])
PX_M = 0.7 / BASLER.fx


def printed(shape):
    """A ground whose reflectance has sharp edges: cells of 20 pixels, 0.1 or 0.8."""
    y, x = np.indices(shape)
    cells = np.where((x // 20 + y // 20) % 2, 0.8, 0.1).astype(np.float32)
    return np.repeat(cells[..., None], 3, axis=2)


def lit(reflectance):
    """Its colours in light that falls off to the right, with a faint gloss on top."""
    fall = np.linspace(1.0, 0.95, reflectance.shape[1], dtype=np.float32)[None, :, None]
    return reflectance * fall + 0.03 * fall


def test_noise_goes_while_edges_and_the_mean_stay():
    reflectance = printed((200, 240))
    true = lit(reflectance)
    noise = np.random.default_rng(0).normal(1.0, 0.15, true.shape).astype(np.float32)
    noisy = true * noise
    smooth = smooth_light(noisy, reflectance)
    assert smooth.dtype == np.float32
    error = smooth - true
    assert np.abs(error).mean() < 0.12 * np.abs(noisy - true).mean()
    assert abs(error.mean()) < 0.001 * true.mean()
    edge = np.abs(np.diff(reflectance[..., 0], axis=1)) > 0
    np.testing.assert_allclose(np.diff(smooth[..., 0], axis=1)[edge], np.diff(true[..., 0], axis=1)[edge], atol=0.07)


def test_without_noise_nothing_changes():
    reflectance = printed((120, 90))
    np.testing.assert_allclose(smooth_light(lit(reflectance), reflectance), lit(reflectance), atol=0.01)


def test_single_specks_leave_no_halo():
    reflectance = np.full((60, 60, 3), 0.5, np.float32)
    specked = reflectance.copy()
    specked[30, 30] = 400.0
    assert smooth_light(specked, reflectance).max() < 0.52


def test_bands_have_no_seams(monkeypatch):
    rng = np.random.default_rng(1)
    reflectance = printed((BAND_ROWS // 4, 50))
    noisy = lit(reflectance) * rng.uniform(0.8, 1.2, reflectance.shape).astype(np.float32)
    whole = smooth_light(noisy, reflectance)
    monkeypatch.setattr("scenes.ground_light.BAND_ROWS", 17)
    np.testing.assert_allclose(smooth_light(noisy, reflectance), whole, atol=1e-4)


def block(x, y, side=0.004):
    """A cube that lies on z = 0."""
    mesh = trimesh.creation.box((side, side, side))
    drawn = DrawnMesh(
        vertices=np.asarray(mesh.vertices), normals=np.asarray(mesh.vertex_normals), faces=np.asarray(mesh.faces)
    )
    return DrawnGeom(
        geom=0,
        name="block",
        instance=-1,
        mesh_key=(),
        mesh=drawn,
        T_world_geom=transform(None, [x, y, side / 2]),
        finish=Finish(rgb=(1.0, 1.0, 1.0), metallic=0.0, roughness=0.5),
    )


def lamp(position):
    return DrawnLamp(
        name="lamp",
        kind="spot",
        rgb=(1.0, 1.0, 1.0),
        position=np.array(position),
        direction=-np.array(position) / np.linalg.norm(position),
        radius_m=0.01,
        cutoff=1.0,
    )


def pixel(x, y):
    return np.array([BASLER.cx + x / PX_M, BASLER.cy - y / PX_M])


def holds(near, at):
    u, v = np.rint(at).astype(int)
    return bool(near[v, u])


def test_what_is_near_is_the_thing_and_its_shadow_and_little_else():
    """A lamp at 45 degrees from the left: the shadow of a cube of 4 mm ends 4 mm to its right."""
    near = near_things([block(0, 0)], [lamp([-10.0, 0, 10.0])], BASLER, ABOVE)
    assert near.shape == (BASLER.height, BASLER.width)
    for x, y in ((0, 0), (-0.002, 0.002), (0.0059, 0.002), (0.002, -0.002), (-0.002 - 0.9 * MARGIN_M, 0)):
        assert holds(near, pixel(x, y))
    assert not holds(near, pixel(-0.002 - 1.2 * MARGIN_M, 0))
    assert not holds(near, pixel(0.006 + 1.2 * MARGIN_M, 0))
    unlit = near_things([block(0, 0)], [], BASLER, ABOVE)
    assert holds(unlit, pixel(0, 0)) and not holds(unlit, pixel(0.0059, 0))


def test_boxes_hold_each_piece():
    mask = np.zeros((20, 30), bool)
    mask[2:5, 3:9] = mask[5, 9] = mask[15:, 20:] = True
    assert boxes(mask) == [(3, 2, 7, 4), (20, 15, 10, 5)]
    assert boxes(np.zeros((4, 4), bool)) == []


@pytest.mark.parametrize("at", [(0.3, 0.0), (-0.4, 0.2)])
def test_what_the_camera_does_not_see_is_not_near(at):
    assert not near_things([block(*at)], [], BASLER, ABOVE).any()


def test_a_thing_that_fills_the_image_is_near_everywhere():
    small = BASLER.crop(2730, 1820, 21, 17)
    assert near_things([block(0, 0)], [], small, ABOVE).all()
