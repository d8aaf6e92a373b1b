"""Path tracing: light, mirrors and textures as they must look, noise that is reproducible, and either variant."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from cad.spatial import BASLER, Array, transform
from scenes import photoreal
from scenes.camera import add_camera
from scenes.classic import ClassicRenderer
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.ground_light import near_things
from scenes.look import add_material, add_mesh, add_raw_mesh, add_texture, add_visual
from scenes.path_traced import MitsubaRenderer, mitsuba_problem
from scenes.photoreal import LLVM_VARIABLE, usable_llvm
from scenes.scene_export import WHITE_LUX

SIZE = 48
ABOVE: Array = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0.7], [0, 0, 0, 1.0]])
WINDOW = BASLER.crop(2736 - SIZE // 2, 1824 - SIZE // 2, SIZE, SIZE)
"""A window of 3.2 mm round the origin."""


def start_spec():
    """A scene seen by the camera from 0.7 m above the origin, without light."""
    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 10.0
    spec.visual.headlight.ambient = [0.0] * 3
    add_camera(spec.worldbody, BASLER, ABOVE)
    return spec


def add_plate(spec, level=0.8):
    add_material(spec, "plate", (level, level, level, 1.0), specular=0.05, shininess=0.1)
    spec.worldbody.add_geom(
        name="plate", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.01, 0.001], pos=[0, 0, -0.001], material="plate"
    )


def add_ball(spec, metallic, roughness):
    add_material(spec, "ball", (0.9, 0.9, 0.9, 1.0), specular=0.5, shininess=0.5)
    spec.material("ball").metallic, spec.material("ball").roughness = metallic, roughness
    add_mesh(spec, "ball", trimesh.creation.icosphere(subdivisions=4, radius=0.0012))
    body = spec.worldbody.add_body(name="part_00", pos=[0, 0, 0.0012], mocap=True)
    add_visual(body, "part_00_visual", "ball", material="ball")


def add_surround(spec, faces):
    """Light from a cube map (6, N, N, 3) uint8 whose white is as bright as a white surface that saturates."""
    texture = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_CUBE)
    texture.height, texture.width, texture.nchannel = 6 * faces.shape[1], faces.shape[2], 3
    texture.data = np.ascontiguousarray(faces).tobytes()
    light = spec.worldbody.add_light(name="sky", type=mujoco.mjtLightType.mjLIGHT_IMAGE, texture="sky")
    light.intensity = WHITE_LUX / np.pi


def render(spec, what=("rgb",), window=WINDOW, **options):
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with MitsubaRenderer(model, max_width=SIZE, max_height=SIZE, **options) as renderer:
        return renderer.render(data, window, what)


@pytest.fixture(scope="module")
def lit_ball():
    """A ball on a plate under one lamp."""
    spec = start_spec()
    add_plate(spec)
    add_ball(spec, metallic=0.0, roughness=0.6)
    lamp = spec.worldbody.add_light(name="lamp_0", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    lamp.pos, lamp.dir, lamp.diffuse = [0.35, 0, 0.35], [-1, 0, -1], [0.7] * 3
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def renderer(lit_ball):
    with MitsubaRenderer(lit_ball[0], max_width=SIZE, max_height=SIZE, samples=16) as made:
        yield made


def test_the_same_scene_gives_the_same_bytes_and_another_one_other_noise(lit_ball, renderer):
    model, data = lit_ball
    first = renderer.render(data, WINDOW, ("rgb",)).rgb
    assert first.dtype == np.float32
    np.testing.assert_array_equal(renderer.render(data, WINDOW, ("rgb",)).rgb, first)
    with MitsubaRenderer(model, max_width=SIZE, max_height=SIZE, samples=16, seed=1) as other:
        seeded = other.render(data, WINDOW, ("rgb",)).rgb
    assert (seeded != first).any()
    assert abs(seeded.mean() - first.mean()) < 1
    data.mocap_pos[0, 2] += 1e-9
    mujoco.mj_kinematics(model, data)
    assert (renderer.render(data, WINDOW, ("rgb",)).rgb != first).any()


def test_shadows_are_as_soft_as_the_bulb_is_large(lit_ball, renderer):
    """Where the ball's shadow ends the level falls at once, or over a longer way."""
    model, data = lit_ball
    end_of_shadow = BASLER.crop(2736 - 64, 1824 - SIZE // 2, SIZE, SIZE)
    falls = []
    for radius in (0.0, 0.1):
        model.light_bulbradius[0] = radius
        rgb = renderer.render(data, end_of_shadow, ("rgb",)).rgb
        falls.append(-np.diff(rgb[SIZE // 2 - 2 : SIZE // 2 + 2].mean(axis=(0, 2))).min())
    assert falls[0] > 70 and falls[1] < 35


def test_what_it_refuses_it_names(lit_ball, renderer):
    _, data = lit_ball
    with pytest.raises(SceneError, match=f"does not fit into this renderer's {SIZE} x {SIZE}"):
        renderer.render(data, BASLER)
    with pytest.raises(SceneError, match="0 samples a pixel: must be at least 1"):
        MitsubaRenderer(lit_ball[0], max_width=8, max_height=8, samples=0)
    with pytest.raises(SceneError, match="draws square pixels only"):
        renderer.render(data, replace(WINDOW, fy=WINDOW.fx * 1.01))
    renderer.close()
    renderer.close()
    with pytest.raises(SceneError, match="make a new MitsubaRenderer"):
        renderer.render(data, WINDOW)


def test_levels_may_exceed_saturation_and_nothing_is_black():
    spec = start_spec()
    add_plate(spec)
    spec.visual.headlight.ambient = [2.0] * 3
    assert np.median(render(spec, samples=16).rgb) == pytest.approx(2 * 0.8 * 255, rel=0.08)
    assert render(start_spec(), samples=4).rgb.max() == 0
    nothing = render(start_spec(), ("instances", "depth"))
    assert (nothing.instances == -1).all() and (nothing.depth_m == 10.0).all()


def test_light_comes_from_where_the_environment_is_bright():
    """Faces of the cube: +x red, north (+y) green; the camera sees +x right and +y up."""
    faces = np.zeros((6, 8, 8, 3), np.uint8)
    faces[0, ..., 0], faces[5, ..., 1] = 255, 255
    spec = start_spec()
    add_ball(spec, metallic=0.0, roughness=0.9)
    add_surround(spec, faces)
    rgb = render(spec, samples=16).rgb
    middle = SIZE // 2
    right, left = rgb[middle, middle + 12, 0], rgb[middle, middle - 12, 0]
    top, bottom = rgb[middle - 12, middle, 1], rgb[middle + 12, middle, 1]
    assert right > 30 and right > 5 * left
    assert top > 30 and top > 5 * bottom


def test_metal_mirrors_its_surroundings_and_plastic_does_not():
    """All light comes from the right: a metal ball is bright where it mirrors it and black elsewhere."""
    faces = np.zeros((6, 8, 8, 3), np.uint8)
    faces[0] = 255
    contrast = []
    for metallic, roughness in ((1.0, 0.1), (0.0, 0.9)):
        spec = start_spec()
        add_ball(spec, metallic, roughness)
        add_surround(spec, faces)
        row = render(spec, samples=16).rgb[SIZE // 2, SIZE // 2 : SIZE // 2 + 17].mean(axis=-1)
        contrast.append(np.abs(np.diff(row)).max())
    assert contrast[0] > 3 * contrast[1]


def test_textures_lie_as_in_the_classic_domain():
    """A picture without any symmetry, repeated differently both ways, in plain light from all around."""
    image = np.full((8, 8, 3), 40, np.uint8)
    image[:2, :5], image[5:, :2, 0], image[3:5, 6:, 2] = 200, 220, 240
    spec = start_spec()
    add_texture(spec, "print", np.kron(image, np.ones((16, 16, 1), np.uint8)))
    add_material(spec, "print", (0.9, 0.7, 0.8, 1), specular=0.0, shininess=0.0, texture="print", repeat=(2.0, 1.5))
    h = 0.0018
    corners = np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]])
    coordinates = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    faces, up = np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0, 1], (4, 1))
    add_raw_mesh(spec, "sheet", corners, faces, normals=up, texcoords=coordinates)
    add_visual(spec.worldbody, "sheet", "sheet", material="print")
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.8] * 3, [0.0] * 3
    spec.visual.headlight.specular = [0.0] * 3
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with ClassicRenderer(model, max_width=SIZE, max_height=SIZE) as classic:
        expected = classic.render(data, WINDOW, ("rgb",)).rgb.astype(float)
    with MitsubaRenderer(model, max_width=SIZE, max_height=SIZE, samples=64) as renderer:
        drawn = renderer.render(data, WINDOW, ("rgb",)).rgb
    assert expected.std() > 30
    assert np.median(np.abs(drawn - expected)) < 8
    assert np.corrcoef(drawn.ravel(), expected.ravel())[0, 1] > 0.98


def test_windows_of_many_bands_have_no_seams(lit_ball, renderer, monkeypatch):
    _, data = lit_ball
    whole = renderer.render(data, WINDOW)
    monkeypatch.setattr("scenes.path_traced.SAMPLES_AT_ONCE", 16 * SIZE * 7)
    banded = renderer.render(data, WINDOW)
    np.testing.assert_array_equal(banded.instances, whole.instances)
    np.testing.assert_allclose(banded.depth_m, whole.depth_m, atol=1e-6)
    difference = (banded.rgb - whole.rgb).mean(axis=(1, 2))
    assert np.abs(difference).max() < 8 and abs(difference.mean()) < 2


def drawn_with_few_samples(lit_ball, monkeypatch, size=(200, 80)):
    """A window with the ball left of its middle by many samples and by few, and what of it is near the ball."""
    model, data = lit_ball
    window = BASLER.crop(2736 - 80, 1824 - 40, *size)
    near = []

    def noted(*arguments):
        near.append(near_things(*arguments))
        return near[-1]

    monkeypatch.setattr("scenes.path_traced.near_things", noted)
    with MitsubaRenderer(model, max_width=size[0], max_height=size[1]) as renderer:
        every = renderer.render(data, window, ("rgb",)).rgb
        monkeypatch.setattr("scenes.path_traced.LARGE_PX", size[0] * size[1] - 1)
        few, again = (renderer.render(data, window, ("rgb",)).rgb for _ in range(2))
    np.testing.assert_array_equal(few, again)
    return every, few, near[0]


def test_few_samples_of_the_ground_look_like_many(lit_ball, monkeypatch):
    """Neither the level nor a seam tells where the surroundings of the ball end, and the same bytes come again."""
    every, few, near = drawn_with_few_samples(lit_ball, monkeypatch)
    difference = few - every
    assert 0.2 < near.mean() < 0.8
    assert abs(difference[near].mean()) < 0.5 and abs(difference[~near].mean()) < 0.5
    assert np.abs(difference[~near]).mean() < 3
    ring = np.ones((9, 9), np.uint8)
    outside = cv2.dilate(near.astype(np.uint8), ring).astype(bool) & ~near
    inside = near & ~cv2.erode(near.astype(np.uint8), ring).astype(bool)
    assert abs(difference[outside].mean() - difference[inside].mean()) < 1.5


def test_pieces_of_an_image_are_drawn_one_by_one_where_pixels_cannot_be(lit_ball, monkeypatch):
    _, few, near = drawn_with_few_samples(lit_ball, monkeypatch)
    monkeypatch.setattr("scenes.path_traced.draws_pixels", lambda mitsuba: False)
    _, other, _ = drawn_with_few_samples(lit_ball, monkeypatch)
    np.testing.assert_allclose(other[near].mean(), few[near].mean(), rtol=0.01)
    assert np.abs(other - few)[near].mean() < 5


OTHER_VARIANT = """
import json, sys
import numpy as np
from test_path_traced import SIZE, WINDOW, add_ball, add_plate, render, start_spec
from scenes.photoreal import load_mitsuba
spec = start_spec()
add_plate(spec)
add_ball(spec, metallic=1.0, roughness=0.3)
spec.visual.headlight.ambient = [0.5] * 3
drawn, again = (render(spec, ("rgb", "instances", "depth"), samples=16) for _ in range(2))
print(json.dumps({
    "variant": load_mitsuba().variant(),
    "same": bool((drawn.rgb == again.rgb).all()),
    "rgb": drawn.rgb.mean(axis=-1).tolist(),
    "instances": drawn.instances.tolist(),
    "depth_m": drawn.depth_m.tolist(),
}))
"""


def in_another_process(**environment):
    """The same scene drawn by a process of its own, as a dictionary."""
    here = os.path.dirname(__file__)
    answer = subprocess.run(
        [sys.executable, "-c", OTHER_VARIANT],
        env={**os.environ, "PYTHONPATH": here, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return json.loads(answer.stdout)


def test_without_a_usable_llvm_the_same_picture_is_drawn_slower(tmp_path):
    """A library that cannot be used must not end the process."""
    unusable = tmp_path / "libLLVM-15.so"
    unusable.touch()
    slow, fast = in_another_process(**{LLVM_VARIABLE: str(unusable)}), in_another_process()
    assert slow["variant"] == "scalar_rgb"
    assert slow["same"] and fast["same"]
    np.testing.assert_array_equal(slow["instances"], fast["instances"])
    np.testing.assert_allclose(slow["depth_m"], fast["depth_m"], atol=1e-5)
    difference = np.array(slow["rgb"]) - np.array(fast["rgb"])
    assert abs(difference.mean()) < 1
    assert np.abs(difference).mean() < 8


@pytest.mark.parametrize(
    ("path", "usable"),
    [
        ("/usr/lib/libLLVM-19.so", True),
        ("/usr/lib/libLLVM.so.19.1", True),
        ("/usr/lib/libLLVM-15.so.1", False),
        ("/usr/lib/libLLVM-16.so", False),
        ("/usr/lib/libLLVM-14.0.6.so.1", False),
        ("/usr/lib/libLLVM.so", False),
    ],
)
def test_only_an_llvm_that_works_is_used(path, usable):
    assert usable_llvm(path) == (path if usable else "")


def test_what_is_missing_is_named_with_the_command_that_mends_it(monkeypatch):
    assert mitsuba_problem() == ""
    monkeypatch.setattr(photoreal, "usable_llvm", lambda wanted: "")
    assert "apt-get install -y libllvm19" in photoreal.mitsuba_hint()
    monkeypatch.setattr(photoreal, "find_spec", lambda name: None)
    assert mitsuba_problem().endswith("run\n  pip install 'tagcell[photoreal]'")
    assert photoreal.mitsuba_hint() == ""
    photoreal.load_mitsuba.cache_clear()
    with pytest.raises(SceneError, match="Mitsuba 3, which is not installed"):
        photoreal.load_mitsuba()


def test_a_far_part_keeps_its_contact_shadow():
    """Gaps of a tenth of a millimetre between surface and light ray would swallow it 0.4 m from the origin."""
    spec = start_spec()
    add_material(spec, "plate", (0.8, 0.8, 0.8, 1.0), specular=0.05, shininess=0.1)
    plate = spec.worldbody.add_geom(name="plate", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.01, 0.001])
    plate.pos, plate.material = [0.4, 0, -0.001], "plate"
    add_mesh(spec, "sheet", trimesh.creation.box(extents=[0.001, 0.001, 4e-5]))
    body = spec.worldbody.add_body(name="part_00", pos=[0.4, 0, 6e-5])
    add_visual(body, "part_00_visual", "sheet", material="plate")
    add_camera(spec.worldbody, BASLER, transform(None, [0.4, 0, 0]) @ ABOVE, "far")
    lamp = spec.worldbody.add_light(name="lamp_0", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    lamp.pos, lamp.dir, lamp.diffuse, lamp.bulbradius = [0.8, 0, 0.1], [-4, 0, -1], [0.9] * 3, 0.0
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with MitsubaRenderer(model, max_width=SIZE, max_height=SIZE, samples=16) as renderer:
        drawn = renderer.render(data, WINDOW, camera="far")
    row = drawn.rgb[SIZE // 2].mean(axis=-1)
    part = np.flatnonzero(drawn.instances[SIZE // 2] == 0)
    assert row[part[0] - 2] < 0.2 * row[part[-1] + 4]
