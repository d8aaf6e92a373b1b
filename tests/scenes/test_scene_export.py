"""A compiled scene as plain arrays: the right triangles, normals, finishes and lamps."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cad.parts import load_part
from cad.spatial import apply, rotation_x, rotation_z, transform
from scenes.cell_config import CellConfig
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.look import SMOOTH_ANGLE, add_material, add_texture, classic_finish, pbr_finish
from scenes.render import COLLISION_GROUP, HIDDEN_GROUP
from scenes.scene_export import WHITE_LUX, SceneReader, environment_panorama, texture_image
from scenes.workcell import build_board_scene, build_workcell, set_parts

CONFIG = CellConfig()
NAMES = ("inserted", "main", "top")
GEOM, LIGHT = mujoco.mjtGeom, mujoco.mjtLightType


@pytest.fixture(scope="module")
def board():
    """The board with three parts: model, data and the parts' poses in the world."""
    model = build_board_scene(CONFIG, NAMES).compile()
    data = mujoco.MjData(model)
    T = np.stack([transform(rotation_x(0.4 * i) @ rotation_z(i), [0.02 * i, 0.01, 0.02]) for i in range(3)])
    set_parts(model, data, CONFIG.T_world_board @ T)
    return model, data, CONFIG.T_world_board @ T


def scene_of(spec):
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, SceneReader(model).read(data)


def corner_angles(geom):
    """Radians (F, 3) between the normal of each face and those of its corners."""
    corners = geom.world_vertices[geom.mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    cosine = np.einsum("fi,fci->fc", face, geom.world_normals[geom.mesh.faces])
    return np.arccos(np.clip(cosine, -1, 1))


def test_parts_are_where_they_are_with_all_their_triangles(board):
    model, data, T_world_part = board
    shown = {geom.instance: geom for geom in SceneReader(model).read(data).geoms}
    for i, name in enumerate(NAMES):
        mesh = load_part(name).mesh
        distance, _ = cKDTree(shown[i].world_vertices).query(apply(T_world_part[i], mesh.vertices))
        assert distance.max() < 1e-6
        exported = trimesh.Trimesh(shown[i].world_vertices, shown[i].mesh.faces, process=False)
        assert len(exported.faces) == len(mesh.faces)
        assert exported.volume == pytest.approx(mesh.volume, rel=1e-3)


def test_round_faces_are_smooth_and_edges_sharp(board):
    model, data, _ = board
    for geom in SceneReader(model).read(data).geoms:
        angles = corner_angles(geom)
        assert angles.max() < SMOOTH_ANGLE
        np.testing.assert_allclose(np.linalg.norm(geom.world_normals, axis=1), 1.0, atol=1e-5)
        if geom.instance >= 0:
            assert (angles > np.radians(1)).any()


def test_only_visible_groups_are_shown_as_they_are_now(board):
    model, data, _ = board
    reader = SceneReader(model)
    assert {geom.name for geom in reader.read(data).geoms} == {
        "board_visual",
        "tags_visual",
        *(f"part_{i:02d}_visual" for i in range(3)),
    }
    assert COLLISION_GROUP in model.geom_group
    hidden = model.geom("part_01_visual").id
    model.geom_group[hidden] = HIDDEN_GROUP
    try:
        assert hidden not in {geom.geom for geom in reader.read(data).geoms}
    finally:
        model.geom_group[hidden] = 1


def test_the_whole_cell_can_be_read():
    model, data, scene = scene_of(build_workcell(CONFIG, NAMES))
    assert len(scene.geoms) > 50
    assert {lamp.name for lamp in scene.lamps} == {"lamp_0", "lamp_1"}
    assert scene.ambient == pytest.approx(tuple(model.vis.headlight.ambient))
    assert data.time == 0


@pytest.mark.parametrize(
    ("kind", "size", "volume"),
    [
        (GEOM.mjGEOM_BOX, [0.1, 0.2, 0.3], 0.048),
        (GEOM.mjGEOM_SPHERE, [0.1, 0, 0], 4 / 3 * np.pi * 1e-3),
        (GEOM.mjGEOM_CYLINDER, [0.1, 0.2, 0], np.pi * 0.01 * 0.4),
        (GEOM.mjGEOM_CAPSULE, [0.1, 0.2, 0], np.pi * 0.01 * 0.4 + 4 / 3 * np.pi * 1e-3),
    ],
)
def test_solids_have_their_size_and_face_outwards(kind, size, volume):
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=kind, size=size, pos=[1, 2, 3])
    geom = scene_of(spec)[2].geoms[0]
    solid = trimesh.Trimesh(geom.world_vertices, geom.mesh.faces)
    assert solid.volume == pytest.approx(volume, rel=0.01)
    np.testing.assert_allclose(solid.bounds.mean(axis=0), [1, 2, 3], atol=1e-6)
    assert corner_angles(geom).max() < (1e-3 if kind == GEOM.mjGEOM_BOX else 0.1)


def test_a_plane_faces_up_and_an_endless_one_reaches_as_far_as_is_seen():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=GEOM.mjGEOM_PLANE, size=[0.3, 0, 1], pos=[0, 0, 0.5])
    model, _, scene = scene_of(spec)
    geom = scene.geoms[0]
    np.testing.assert_allclose(geom.world_normals, [[0, 0, 1]] * 4, atol=1e-7)
    far = model.vis.map.zfar * model.stat.extent
    np.testing.assert_allclose(np.ptp(geom.world_vertices, axis=0), [0.6, 2 * far, 0], rtol=1e-6)


def test_what_cannot_be_drawn_is_named():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="egg", type=GEOM.mjGEOM_ELLIPSOID, size=[0.1, 0.2, 0.3])
    with pytest.raises(SceneError, match="'egg' is a mjGEOM_ELLIPSOID; only mesh, plane"):
        scene_of(spec)
    spec = mujoco.MjSpec()
    add_texture(spec, "wood", np.zeros((4, 4, 3), np.uint8))
    add_material(spec, "wood", (1, 1, 1, 1), specular=0.1, shininess=0.1, texture="wood")
    spec.worldbody.add_geom(name="crate", type=GEOM.mjGEOM_BOX, size=[0.1, 0.2, 0.3], material="wood")
    with pytest.raises(SceneError, match="'crate' has a texture but no texture coordinates"):
        scene_of(spec)


def test_finishes_follow_the_model_and_classic_ones_are_translated(board):
    model, data, _ = board
    reader, k = SceneReader(model), model.material("main").id
    finish = {geom.name: geom.finish for geom in reader.read(data).geoms}["part_01_visual"]
    part = load_part("main")
    assert (finish.metallic, finish.roughness) == pytest.approx((part.metallic, part.roughness), abs=1e-6)
    model.mat_rgba[k, :3], model.mat_metallic[k], model.mat_roughness[k] = [0.1, 0.2, 0.3], 0.4, 0.5
    changed = {geom.name: geom.finish for geom in reader.read(data).geoms}["part_01_visual"]
    assert (*changed.rgb, changed.metallic, changed.roughness) == pytest.approx((0.1, 0.2, 0.3, 0.4, 0.5))


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.8), (1.0, 0.3), (0.5, 0.5)])
def test_classic_and_physical_finishes_are_each_others_inverse(metallic, roughness):
    assert pbr_finish(*classic_finish(metallic, roughness)) == pytest.approx((metallic, roughness))


def test_lamps_of_any_kind_say_how_bright_a_white_surface_gets():
    spec = mujoco.MjSpec()
    spec.stat.center = [0, 0, 0]
    kinds = [LIGHT.mjLIGHT_DIRECTIONAL, LIGHT.mjLIGHT_SPOT, LIGHT.mjLIGHT_SPOT, LIGHT.mjLIGHT_POINT]
    for i, (kind, intensity) in enumerate(zip(kinds, [0, 0, WHITE_LUX / 4, 0], strict=True)):
        light = spec.worldbody.add_light(name=f"l{i}", type=kind, pos=[0, 0, 2], dir=[0, 0, -1])
        light.diffuse, light.intensity, light.bulbradius = [0.5, 0.4, 0.3], intensity, 0.01
    model, data, scene = scene_of(spec)
    strengths = {lamp.name: lamp.rgb[0] for lamp in scene.lamps}
    assert strengths == pytest.approx({"l0": 0.5, "l1": 0.5 * 4, "l2": 0.5 / 4, "l3": 0.5 * 4})
    assert [lamp.kind for lamp in scene.lamps] == ["directional", "spot", "spot", "point"]
    assert scene.lamps[0].radius_m == pytest.approx(0.01)
    model.light_active[2] = False
    assert len(SceneReader(model).read(data).lamps) == 3


def environment_spec(faces):
    """A scene lit by one cube map (6, N, N, 3) uint8."""
    spec = mujoco.MjSpec()
    texture = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_CUBE)
    texture.height, texture.width, texture.nchannel = 6 * faces.shape[1], faces.shape[2], 3
    texture.data = np.ascontiguousarray(faces).tobytes()
    light = spec.worldbody.add_light(name="sky", type=LIGHT.mjLIGHT_IMAGE, texture="sky")
    light.intensity = 2 * WHITE_LUX / np.pi
    return spec


def test_an_environment_replaces_the_ambient_light_and_stands_upright():
    """MuJoCo's cube has y up: its faces +x -x +y -y +z -z look along +x, -x, up, down, -y and +y of the world."""
    faces = np.zeros((6, 8, 8, 3), np.uint8)
    faces[:] = (np.arange(6) * 40 + 20)[:, None, None, None]
    model, _, scene = scene_of(environment_spec(faces))
    assert scene.ambient == (0, 0, 0)
    assert scene.environment_radiance == pytest.approx(2.0)
    panorama = np.rint(255 * environment_panorama(model, scene.environment)[..., 0]).astype(int)
    assert panorama.shape == (16, 32)
    right, left, up, down, back, front = faces[:, 0, 0, 0]
    assert (panorama[0] == up).all() and (panorama[-1] == down).all()
    assert panorama[8, [16, 24, 0, 8]].tolist() == [front, right, back, left]


def test_textures_are_linear_unless_they_say_otherwise():
    spec = mujoco.MjSpec()
    add_texture(spec, "plain", np.full((2, 2, 3), 128, np.uint8))
    add_texture(spec, "photo", np.full((2, 2, 3), 128, np.uint8))
    spec.texture("photo").colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
    model = spec.compile()
    assert texture_image(model, 0)[0, 0, 0] == pytest.approx(128 / 255)
    assert texture_image(model, 1)[0, 0, 0] == pytest.approx(0.2159, abs=1e-4)
