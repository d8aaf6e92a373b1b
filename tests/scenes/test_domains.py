"""One contract for every image domain: same scene, same camera, same labels, and edges on the label contours."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from edges import edge_offset, silhouette_edges

from cad.parts import load_part
from cad.spatial import BASLER, apply, inverse, rotation_z, transform
from scenes.cell_config import CellConfig
from scenes.domains import DOMAINS, domain_problem, make_renderer
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.path_traced import MitsubaRenderer
from scenes.render import HIDDEN_GROUP
from scenes.scene_export import WHITE_LUX
from scenes.workcell import build_board_scene, set_parts

CONFIG = CellConfig()
NAMES = ("inserted", "main", "top")
YAWS = (0.35, 1.25, 2.15)
DRAWN = [domain for domain in DOMAINS if not domain_problem(domain)]
BIAS_PX = 0.05
PATHS = 16
"""Samples a pixel of the path tracer: enough, as the only lamp lights every surface that is seen."""


class Stand:
    """Three black parts on the white board, lit from the camera, so that no shadow is seen and no shade is in them."""

    def __init__(self) -> None:
        spec = build_board_scene(CONFIG, NAMES)
        spec.light("lamp_0").type = mujoco.mjtLightType.mjLIGHT_SPOT
        self.model = model = spec.compile()
        self.data = mujoco.MjData(model)
        self.parts = [load_part(name) for name in NAMES]
        T_board_part = np.stack(
            [
                transform(rotation_z(yaw), [0.0125 * i + 0.015, 0.02 + 0.001 * i, 0.0])
                @ part.stable_poses[0].T_table_part
                for i, (yaw, part) in enumerate(zip(YAWS, self.parts, strict=True))
            ]
        )
        set_parts(model, self.data, CONFIG.T_world_board @ T_board_part)
        self.T_cam_part = inverse(CONFIG.T_board_cam) @ T_board_part
        centres = [
            BASLER.project(apply(T, part.mesh.bounding_box.centroid))
            for T, part in zip(self.T_cam_part, self.parts, strict=True)
        ]
        u, v = np.mean(centres, axis=0).astype(int)
        self.window = BASLER.crop(int(u) - 240, int(v) - 96, 480, 192)
        for name in NAMES:
            k = model.material(name).id
            model.mat_rgba[k, :3] = model.mat_specular[k] = 0.0
            model.mat_metallic[k] = model.mat_roughness[k] = 1.0
        model.vis.headlight.ambient[:] = 0.0
        model.light_active[:] = [1, 0]
        model.light_castshadow[:] = model.light_bulbradius[:] = 0.0
        model.light_diffuse[0], model.light_specular[0] = 0.9, 0.0
        model.light_intensity[0] = WHITE_LUX * self.T_cam_part[0, 2, 3] ** 2
        towards = CONFIG.T_world_cam[:3, :3] @ self.window.rays([(480 - 1) / 2, (192 - 1) / 2])
        self.data.light_xpos[0], self.data.light_xdir[0] = CONFIG.T_world_cam[:3, 3], towards / np.linalg.norm(towards)

    def edge_bias(self, rgb, intrinsics):
        """By how many pixels straight edges lie right of, below and outside of the CAD outline, and their spread."""
        grey = rgb.astype(np.float64).mean(axis=-1)
        edges = [
            edge
            for T, part in zip(self.T_cam_part, self.parts, strict=True)
            for edge in silhouette_edges(part.mesh, intrinsics, T)
        ]
        offsets = np.array([edge_offset(grey, edge) for edge in edges])
        weights = np.sqrt([edge.length for edge in edges])
        normals = np.array([[*edge.normal, 1.0] for edge in edges])
        bias = np.linalg.lstsq(normals * weights[:, None], offsets * weights, rcond=None)[0]
        return bias, float(np.sqrt(np.average(offsets**2, weights=weights**2))), len(edges)


def renderer_of(domain, model):
    if domain == "mitsuba":
        return MitsubaRenderer(model, max_width=480, max_height=192, samples=PATHS)
    return make_renderer(domain, model, max_width=480, max_height=192)


@pytest.fixture(scope="module")
def stand():
    return Stand()


@pytest.fixture(scope="module")
def renderers(stand):
    made = {domain: renderer_of(domain, stand.model) for domain in DRAWN}
    yield made
    for renderer in made.values():
        renderer.close()


@pytest.fixture(scope="module")
def drawn(stand, renderers):
    """What every domain makes of the stand."""
    return {domain: renderer.render(stand.data, stand.window) for domain, renderer in renderers.items()}


def outline(instances):
    """Pixels (H, W) that touch another instance or the board."""
    levels = instances.astype(np.int16)
    return cv2.dilate(levels, np.ones((3, 3))) != cv2.erode(levels, np.ones((3, 3)))


@pytest.mark.parametrize("domain", DRAWN)
def test_masks_agree_but_for_single_pixels_of_the_outline(drawn, domain):
    reference = drawn["classic"].instances
    assert set(np.unique(reference)) == {-1, 0, 1, 2}
    differs = drawn[domain].instances != reference
    assert differs.sum() <= 5
    assert not (differs & ~outline(reference)).any()


@pytest.mark.parametrize("domain", DRAWN)
def test_depth_agrees(drawn, domain):
    error = np.abs(drawn[domain].depth_m - drawn["classic"].depth_m)
    assert np.quantile(error, 0.999) < 5e-5
    assert np.median(error) < 5e-6


@pytest.mark.parametrize("domain", DRAWN)
def test_a_window_is_that_part_of_a_larger_one(stand, renderers, drawn, domain):
    piece = renderers[domain].render(stand.data, stand.window.crop(150, 40, 160, 100))
    there = np.s_[40:140, 150:310]
    whole = drawn[domain]
    assert (piece.instances != whole.instances[there]).sum() <= 2
    assert np.quantile(np.abs(piece.depth_m - whole.depth_m[there]), 0.999) < 5e-5
    difference = piece.rgb.astype(np.float64) - whole.rgb[there]
    assert np.quantile(np.abs(difference[~outline(whole.instances[there])]), 0.998) < 3.0
    assert abs(difference.mean()) < 0.3


@pytest.mark.parametrize("domain", DRAWN)
@pytest.mark.parametrize(("lamp", "ambient"), [(0.8, 0.0), (0.0, 0.8)])
def test_levels_are_fixed_by_the_light(stand, renderers, domain, lamp, ambient):
    """A plate of 205 grey levels under light of 0.8 reaches 164, and a little more with what it mirrors."""
    model = stand.model
    model.light_type[0] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    intensity, diffuse = float(model.light_intensity[0]), model.light_diffuse[0].copy()
    try:
        model.light_intensity[0], model.light_diffuse[0], model.vis.headlight.ambient[:] = 0.0, lamp, ambient
        rgb = renderers[domain].render(stand.data, stand.window.crop(0, 0, 60, 20), ("rgb",)).rgb
    finally:
        model.light_type[0] = mujoco.mjtLightType.mjLIGHT_SPOT
        model.light_intensity[0], model.light_diffuse[0], model.vis.headlight.ambient[:] = intensity, diffuse, 0.0
    assert 150 < np.median(rgb) < 180


@pytest.mark.parametrize("domain", DRAWN)
def test_colours_and_visibility_follow_the_model_at_run_time(stand, renderers, drawn, domain):
    model = stand.model
    k, geom = model.material("main").id, model.geom("part_01_visual").id
    before, group = model.mat_rgba[k].copy(), int(model.geom_group[geom])
    try:
        model.mat_rgba[k, :3], model.mat_metallic[k] = [0.8, 0.1, 0.1], 0.0
        red = renderers[domain].render(stand.data, stand.window, ("rgb",)).rgb
        model.geom_group[geom] = HIDDEN_GROUP
        without = renderers[domain].render(stand.data, stand.window).instances
    finally:
        model.mat_rgba[k], model.mat_metallic[k], model.geom_group[geom] = before, 1.0, group
    part = drawn[domain].instances == 1
    level = np.median(red[part], axis=0)
    assert level[0] > 100 and level[1] < level[0] / 3
    assert np.median(drawn[domain].rgb[part]) < 10
    assert set(np.unique(without)) == {-1, 0, 2}


@pytest.mark.parametrize("domain", DRAWN)
def test_edges_lie_on_the_label_contours(stand, drawn, domain):
    bias, rms, count = stand.edge_bias(drawn[domain].rgb, stand.window)
    print(
        f"{domain}: right {bias[0]:+.4f}, down {bias[1]:+.4f}, out {bias[2]:+.4f} px; rms {rms:.4f} px, {count} edges"
    )
    assert count >= 12
    assert np.abs(bias).max() <= BIAS_PX
    assert rms < 0.1


def test_a_tenth_of_a_pixel_would_be_seen(stand, drawn):
    moved = replace(stand.window, cx=stand.window.cx + 0.1)
    bias, _, _ = stand.edge_bias(drawn["classic"].rgb, moved)
    assert bias[0] == pytest.approx(-0.1, abs=BIAS_PX / 2)


def test_an_unknown_domain_is_refused(stand):
    with pytest.raises(SceneError, match="'cycles' is not one of classic, filament, mitsuba"):
        make_renderer("cycles", stand.model, max_width=8, max_height=8)
