"""Rendering against projected truth, on the board with the real parts."""

import cv2
import numpy as np
import pytest

from cad.parts import load_part
from cad.spatial import BASLER, apply, inverse, rotation_z, transform
from cad.tagboard import DICTIONARY
from scenes.camera import add_camera, camera_pose, set_camera_pose
from scenes.cell_config import CellConfig
from scenes.classic import ClassicRenderer
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.workcell import build_board_scene, set_parts

CONFIG = CellConfig()
NAMES = ("inserted", "main", "top")


@pytest.fixture(scope="module")
def scene():
    """Compiled board with three parts on their most likely faces, and the parts' poses in the camera frame."""
    model = build_board_scene(CONFIG, NAMES).compile()
    data = mujoco.MjData(model)
    T_board_part = [
        transform(rotation_z(0.7 * i), [0.05 * i - 0.05, 0.02 * i, 0.0]) @ load_part(n).stable_poses[0].T_table_part
        for i, n in enumerate(NAMES)
    ]
    set_parts(model, data, CONFIG.T_world_board @ np.stack(T_board_part))
    return model, data, inverse(CONFIG.T_board_cam) @ np.stack(T_board_part)


@pytest.fixture(scope="module")
def renderer(scene):
    with ClassicRenderer(scene[0], max_width=1000, max_height=700) as made:
        yield made


def window_round(pixel, size=256):
    return BASLER.crop(int(pixel[0]) - size // 2, int(pixel[1]) - size // 2, size, size)


def test_compiled_camera_is_the_basler():
    model = build_board_scene(CONFIG, ()).compile()
    i = model.camera("camera").id
    np.testing.assert_allclose(model.cam_sensorsize[i], [0.0131328, 0.0087552], atol=1e-9)
    np.testing.assert_allclose(model.cam_intrinsic[i], [0.025, 0.025, 0.0, 0.0], atol=1e-9)
    assert model.cam_resolution[i].tolist() == [5472, 3648]


def test_camera_moves_even_where_bodies_sleep():
    model = build_board_scene(CONFIG, ()).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(camera_pose(model, data), CONFIG.T_world_cam, atol=1e-12)
    T_board_cam = CONFIG.T_board_cam @ transform(rotation_z(0.2), [0.01, 0.02, 0.03])
    set_camera_pose(model, data, T_board_cam)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(camera_pose(model, data), CONFIG.T_world_board @ T_board_cam, atol=1e-12)


@pytest.mark.parametrize("tag", [0, 8, 12])
def test_detected_tag_corners_match_their_projection(renderer, scene, tag):
    _, data, _ = scene
    truth = BASLER.project(apply(inverse(CONFIG.T_board_cam), CONFIG.tagboard.corners(tag)))
    window = window_round(truth.mean(axis=0), 600)
    grey = cv2.cvtColor(renderer.render(data, window, ("rgb",)).rgb, cv2.COLOR_RGB2GRAY)
    found, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY)).detectMarkers(grey)
    mine = next(c for c, i in zip(found, ids.ravel(), strict=True) if i == tag)
    refined = cv2.cornerSubPix(grey, mine[0][:, None].copy(), (8, 8), (-1, -1), (3, 60, 1e-4))[:, 0]
    expected = window.project(apply(inverse(CONFIG.T_board_cam), CONFIG.tagboard.corners(tag)))
    error = refined - expected
    assert np.sqrt((error**2).mean()) < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("downscale", [1, 2, 4])
def test_mask_is_the_projected_silhouette(renderer, scene, downscale):
    """Pixel (u, v) belongs to a part exactly when the ray through (u, v) hits it."""
    _, data, T_cam_part = scene
    for i, name in enumerate(NAMES):
        window = window_round(BASLER.project(T_cam_part[i, :3, 3])).downscaled(downscale)
        seen = renderer.render(data, window, ("instances",)).instances == i
        part = load_part(name)
        truth = silhouette(part.mesh, window, T_cam_part[i])
        assert (seen & truth).sum() / (seen | truth).sum() > (0.99 if downscale == 1 else 0.97)


def silhouette(mesh, intrinsics, T_cam_part, fine=16):
    """Filled triangles at ``fine`` times the resolution, read at pixel centres."""
    size = (intrinsics.height * fine, intrinsics.width * fine)
    image = np.zeros(size, np.uint8)
    pixels = intrinsics.project(apply(T_cam_part, mesh.vertices))
    corners = np.round(((pixels + 0.5) * fine - 0.5)[mesh.faces]).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(image, triangle, 1)
    return image[fine // 2 :: fine, fine // 2 :: fine] > 0


def test_window_equals_the_same_part_of_a_larger_one(renderer, scene):
    _, data, T_cam_part = scene
    centre = BASLER.project(T_cam_part[1, :3, 3])
    large = BASLER.crop(int(centre[0]) - 400, int(centre[1]) - 300, 800, 600)
    whole = renderer.render(data, large)
    piece = renderer.render(data, large.crop(250, 170, 256, 200))
    there = np.s_[170:370, 250:506]
    np.testing.assert_array_equal(piece.instances, whole.instances[there])
    np.testing.assert_allclose(piece.depth_m, whole.depth_m[there], atol=5e-5)
    assert np.abs(piece.rgb.astype(int) - whole.rgb[there]).mean() < 0.1


def test_labels_do_not_depend_on_the_samples_of_colour_frames(renderer, scene):
    model, data, T_cam_part = scene
    window = window_round(BASLER.project(T_cam_part[0, :3, 3]))
    before = renderer.render(data, window)
    with ClassicRenderer(model, max_width=256, max_height=256, samples=0) as plain:
        once = plain.render(data, window)
    again = renderer.render(data, window)
    np.testing.assert_array_equal(before.instances, once.instances)
    np.testing.assert_array_equal(before.depth_m, once.depth_m)
    np.testing.assert_array_equal(before.rgb, again.rgb)
    assert (before.rgb != once.rgb).any(), "colours are averaged over samples"


def test_depth_is_the_height_of_the_board_in_metres(renderer, scene):
    _, data, _ = scene
    drawn = renderer.render(data, BASLER.crop(2000, 3000, 64, 64), ("depth", "instances"))
    assert drawn.instances.max() == -1
    np.testing.assert_allclose(drawn.depth_m, 0.70 + 5e-5, atol=5e-5)


def test_rendering_again_gives_the_same_bytes(renderer, scene):
    _, data, T_cam_part = scene
    window = window_round(BASLER.project(T_cam_part[0, :3, 3]))
    first, second = renderer.render(data, window).rgb, renderer.render(data, window).rgb
    np.testing.assert_array_equal(first, second)


def test_too_large_a_window_is_refused(renderer, scene):
    with pytest.raises(SceneError, match="does not fit into this renderer's 1000 x 700"):
        renderer.render(scene[1], BASLER)


def test_spheres_appear_where_they_project():
    """Off-centre windows, unequal focal lengths: the centroid of a small sphere is its projection to 0.05 px."""
    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0
    centres = np.array([[x, y, 0.0] for x in (-0.1, 0.0, 0.12) for y in (-0.07, 0.05)])
    for i, centre in enumerate(centres):
        body = spec.worldbody.add_body(pos=centre)
        body.add_geom(name=f"part_{i:02d}_visual", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.004, 0, 0])
    T_world_cam = CONFIG.T_board_cam
    add_camera(spec.worldbody, BASLER, T_world_cam)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with ClassicRenderer(model, max_width=400, max_height=400) as renderer:
        for i, centre in enumerate(centres):
            p = apply(inverse(T_world_cam), centre)
            window = window_round(BASLER.project(p), 300)
            rows, columns = np.nonzero(renderer.render(data, window, ("instances",)).instances == i)
            found = np.array([columns.mean(), rows.mean()])
            assert np.abs(found - sphere_centroid(window, p, 0.004)).max() < 0.05


def sphere_centroid(intrinsics, centre, radius):
    """Centroid of a sphere's image: its outline is an ellipse whose centre lies outside the projected centre."""
    scale = centre[2] ** 2 / (centre[2] ** 2 - radius**2)
    return intrinsics.project(np.array([centre[0] * scale, centre[1] * scale, centre[2]]))
