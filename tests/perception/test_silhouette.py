import dataclasses
import time

import numpy as np
import pytest

from cad.parts import Part, load_part, planar
from cad.spatial import BASLER, apply, rotation_x, rotation_y, rotation_z, transform
from perception.silhouette import rasterise, render_view, silhouette_mask, solid_of

CAMERA = BASLER.crop(2736 - 128, 1824 - 128, 256, 256)
T_CAM_TABLE = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])


def inside_convex(hull, pixels):
    """Whether pixels (N, 2) lie in a convex polygon (M, 2), either way round."""
    step = np.roll(hull, -1, axis=0) - hull
    side = step[None, :, 0] * (pixels[:, None, 1] - hull[None, :, 1]) - step[None, :, 1] * (
        pixels[:, None, 0] - hull[None, :, 0]
    )
    return (side >= 0).all(axis=1) | (side <= 0).all(axis=1)


@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.2, -2.0])
def test_mask_of_a_box_is_its_projected_polygon(plain_box: Part, yaw: float) -> None:
    import cv2

    lean = transform(rotation_y(0.2) @ rotation_x(0.1))
    T = T_CAM_TABLE @ planar(0.0004, -0.0003, yaw) @ lean @ plain_box.stable_poses[0].T_table_part
    uv = CAMERA.project(apply(T, plain_box.mesh.vertices))
    hull = cv2.convexHull(uv.astype(np.float32))[:, 0].astype(np.float64)
    columns, rows = np.meshgrid(np.arange(256), np.arange(256))
    expected = inside_convex(hull, np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)).reshape(256, 256)
    mask = render_view(plain_box, T, CAMERA).mask
    assert mask.sum() > 5000
    assert (mask ^ expected).sum() <= 3  # float32 rounding in the hull


def test_depth_is_that_of_the_nearest_surface(stepped: Part) -> None:
    T = T_CAM_TABLE @ stepped.stable_poses[0].T_table_part
    view = render_view(stepped, T, CAMERA)
    for point, z in (((-2.4e-3, 0.9e-3), 0.7 - 2.2e-3), ((0.5e-3, -2e-3), 0.7 - 1.2e-3)):
        p_table = stepped.stable_poses[0].T_table_part[:3, 3] + [*point, 0.0]
        u, v = np.round(CAMERA.project(apply(T_CAM_TABLE, [p_table[0], p_table[1], 0.7 - z]))).astype(int)
        assert view.depth[v, u] == pytest.approx(z, abs=1e-9)
    assert np.isinf(view.depth[~view.mask]).all()


def test_facets_are_the_faces_of_a_box(plain_box: Part) -> None:
    assert solid_of(plain_box).facet.max() + 1 == 6
    view = render_view(plain_box, T_CAM_TABLE @ plain_box.stable_poses[0].T_table_part, CAMERA)
    assert len(np.unique(view.facet[view.mask])) == 1  # only the top is seen from straight above
    assert (view.facet[~view.mask] == -1).all()


def test_every_pixel_of_a_plane_of_triangles_is_covered() -> None:
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(-0.5, 30.5, 9), np.linspace(-0.5, 30.5, 9))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    uv[(uv > 0).all(axis=1) & (uv < 30).all(axis=1)] += rng.uniform(-1, 1, (49, 2))
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 10], 1), np.stack([corner, corner + 10, corner + 9], 1)]
    )
    nearness, face = rasterise(uv, 2.0 + 0.1 * uv[:, 0] - 0.2 * uv[:, 1], faces, 31, 31)
    columns, rows = np.meshgrid(np.arange(31), np.arange(31))
    assert (face >= 0).all()
    np.testing.assert_allclose(nearness, 2.0 + 0.1 * columns - 0.2 * rows, atol=1e-9)


def test_window_mask_is_cut_from_the_whole_image() -> None:
    part = load_part("main")
    T = T_CAM_TABLE @ planar(0.01, -0.02, 0.7) @ part.stable_poses[0].T_table_part
    mask, (u, v) = silhouette_mask(part, T, BASLER)
    window = BASLER.crop(u - 20, v - 10, mask.shape[1] + 40, mask.shape[0] + 20)
    wide = render_view(part, T, window).mask
    assert wide.sum() == mask.sum()
    assert (wide[10:-10, 20:-20] == mask).all()
    empty, _ = silhouette_mask(part, T_CAM_TABLE @ planar(1.0, 0, 0) @ part.stable_poses[0].T_table_part, BASLER)
    assert empty.size == 0


def test_turning_the_camera_turns_the_mask() -> None:
    part = load_part("top")
    centred = dataclasses.replace(CAMERA, cx=127.5, cy=127.5)
    T = T_CAM_TABLE @ planar(0.0002, 0.0003, 0.4) @ part.stable_poses[0].T_table_part
    turned = transform(rotation_z(np.pi / 2)) @ T
    a, b = render_view(part, T, centred).mask, render_view(part, turned, centred).mask
    assert (np.rot90(a, -1) ^ b).sum() <= 4


def test_a_part_behind_the_camera_is_an_error(plain_box: Part) -> None:
    with pytest.raises(ValueError, match="behind the camera"):
        render_view(plain_box, transform(t=[0, 0, -0.1]), CAMERA)


def test_drawing_is_quick() -> None:
    part = load_part("inserted")
    T = T_CAM_TABLE @ part.stable_poses[0].T_table_part
    render_view(part, T, CAMERA)
    spent = []
    for _ in range(5):
        start = time.thread_time()
        render_view(part, T, CAMERA)
        spent.append(time.thread_time() - start)
    assert min(spent) < 0.04
