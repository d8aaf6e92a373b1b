"""The physically based renderer: labels as the classic one's, linear levels, changes at run time."""

import numpy as np
import pytest
import trimesh

from cad.parts import load_part
from cad.spatial import BASLER, Intrinsics, rotation_z, transform
from scenes.camera import add_camera
from scenes.classic import ClassicRenderer
from scenes.coverage import antialias
from scenes.domains import make_renderer
from scenes.errors import SceneError
from scenes.filament import TILE, FilamentRenderer
from scenes.gl import mujoco
from scenes.look import add_material, add_raw_mesh, add_texture, add_visual
from scenes.render import HIDDEN_GROUP
from scenes.scene_export import WHITE_LUX
from scenes.workcell import CellConfig, build_board_scene, set_parts

WINDOW = BASLER.crop(2672, 1760, 128, 128)
"""In the middle of the frame."""
ZENITH = 2
"""The face of a cube texture that is straight above."""


def square(half):
    """Vertices, faces, normals and texture coordinates of a square that faces up."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    normals = np.tile([0.0, 0, 1], (4, 1))
    return half * corners, np.array([[0, 1, 2], [0, 2, 3]]), normals, (corners[:, :2] + 1) / 2


def plate_model():
    """A white matt plate under the camera, a small square metal part over its middle, two materials to exchange."""
    spec = mujoco.MjSpec()
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar, spec.visual.map.shadowclip = 0.02, 10.0, 0.03
    spec.visual.quality.shadowsize = 512
    spec.visual.headlight.ambient = [0.4] * 3
    body = spec.worldbody.add_body(name="board")
    T_board_cam = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 0.7], [0, 0, 0, 1.0]])
    add_camera(body, BASLER, T_board_cam)
    checks = np.kron([[0, 1], [1, 0]], np.ones((64, 64)))[..., None] * np.full(3, 255)
    add_texture(spec, "checks", checks.astype(np.uint8))
    add_material(spec, "white", (0.8, 0.8, 0.8, 1.0), specular=0.0, shininess=0.0)
    add_material(spec, "checks", (0.8, 0.8, 0.8, 1.0), specular=0.0, shininess=0.0, texture="checks")
    add_material(spec, "metal", (0.9, 0.9, 0.9, 1.0), specular=0.5, shininess=0.5)
    for name in ("white", "checks"):
        spec.material(name).metallic, spec.material(name).roughness = 0.0, 1.0
    spec.material("metal").metallic, spec.material("metal").roughness = 1.0, 0.05
    vertices, faces, normals, texcoords = square(0.03)
    add_raw_mesh(spec, "plate", vertices, faces, normals=normals, texcoords=texcoords)
    add_visual(body, "plate", "plate", material="white").castshadow = False
    part = spec.worldbody.add_body(name="part", mocap=True)
    box = trimesh.creation.box(extents=[0.003, 0.003, 0.0001])
    box.unmerge_vertices()
    add_raw_mesh(spec, "part", box.vertices, box.faces, normals=np.repeat(box.face_normals, 3, axis=0))
    add_visual(part, "part_00_visual", "part", material="metal").pos = [0.0, 0.0, 0.002]
    for i, towards in enumerate(([0.0, 0.6, 0.8], [0.28, 0.0, 0.96])):
        light = spec.worldbody.add_light(name=f"lamp_{i}", type=mujoco.mjtLightType.mjLIGHT_SPOT, cutoff=10.0)
        light.pos, light.dir, light.diffuse = 0.5 * np.array(towards), -np.array(towards), [0.3] * 3
        light.intensity, light.castshadow = WHITE_LUX * 0.25, i == 0
    for k in range(2):
        colours = np.random.default_rng(k).integers(30, 255, (6, 3))
        faces = np.broadcast_to(colours[:, None, None], (6, 16, 16, 3)).astype(np.uint8)
        texture = spec.add_texture(name=f"environment_{k}", type=mujoco.mjtTexture.mjTEXTURE_CUBE)
        texture.height, texture.width, texture.nchannel, texture.data = 96, 16, 3, faces.tobytes()
        light = spec.worldbody.add_light(name=f"environment_{k}", type=mujoco.mjtLightType.mjLIGHT_IMAGE)
        light.texture, light.intensity, light.active = f"environment_{k}", WHITE_LUX / np.pi, False
    return spec.compile()


class Plate:
    def __init__(self):
        self.model = plate_model()
        self.data = mujoco.MjData(self.model)
        self.renderer = FilamentRenderer(self.model, max_width=256, max_height=256)
        self.restore = {
            name: getattr(self.model, name).copy()
            for name in dir(self.model)
            if name.startswith(("mat_", "light_", "geom_")) and isinstance(getattr(self.model, name), np.ndarray)
        }
        self.reset()

    def reset(self):
        for name, values in self.restore.items():
            getattr(self.model, name)[:] = values
        self.model.vis.headlight.ambient[:] = 0.4
        self.data.mocap_pos[0], self.data.mocap_quat[0] = 0.0, [1, 0, 0, 0]

    def draw(self, *what):
        mujoco.mj_forward(self.model, self.data)
        return self.renderer.render(self.data, WINDOW, what or ("rgb",))

    def level(self, x=10):
        """Mean colour (3,) of the plate near the window's left border."""
        rgb = self.draw().rgb
        assert rgb is not None
        return rgb[60:68, x : x + 8].mean(axis=(0, 1))


@pytest.fixture(scope="module")
def shared_plate():
    plate = Plate()
    yield plate
    plate.renderer.close()


@pytest.fixture
def plate(shared_plate):
    shared_plate.reset()
    return shared_plate


@pytest.fixture(scope="module")
def cell():
    """The pick cell's board with three parts, drawn by both renderers."""
    config = CellConfig()
    names = ("inserted", "main", "top")
    model = build_board_scene(config, names).compile()
    data = mujoco.MjData(model)
    T_board_part = [
        transform(rotation_z(0.4 + i), [0.01 * i - 0.012, 0.004 * i, 0.0])
        @ load_part(name).stable_poses[0].T_table_part
        for i, name in enumerate(names)
    ]
    set_parts(model, data, config.T_world_board @ np.stack(T_board_part))
    classic = ClassicRenderer(model, max_width=512, max_height=512)
    filament = make_renderer("filament", model, max_width=2200, max_height=512)
    yield data, classic, filament
    classic.close()
    filament.close()


WIDE = BASLER.crop(2480, 1600, 480, 400)


def test_labels_are_the_classic_renderers(cell):
    data, classic, filament = cell
    for window in (WIDE, WIDE.crop(37, 91, 256, 128), WIDE.downscaled(2)):
        expected = classic.render(data, window, ("instances", "depth"))
        drawn = filament.render(data, window, ("instances", "depth"))
        assert {-1, 0, 1} <= set(np.unique(expected.instances))
        assert (drawn.instances != expected.instances).sum() <= 2
        assert (np.abs(drawn.depth_m - expected.depth_m) > 3e-5).sum() <= 2
        assert drawn.rgb is None


def test_a_crop_window_is_a_part_of_a_larger_one(cell):
    data, _, filament = cell
    whole, crop = filament.render(data, WIDE), filament.render(data, WIDE.crop(100, 80, 200, 160))
    part = (slice(80, 240), slice(100, 300))
    np.testing.assert_array_equal(crop.instances, whole.instances[part])
    np.testing.assert_allclose(crop.depth_m, whole.depth_m[part], atol=1e-6)
    differs = np.abs(crop.rgb - whole.rgb[part]).max(axis=-1)
    assert differs.mean() < 0.05
    assert (differs > 3).mean() < 0.002


def test_a_window_drawn_in_pieces_has_no_seam(cell):
    data, _, filament = cell
    strip = BASLER.crop(2720 - TILE, 1800, TILE + 40, 32)
    whole, crop = filament.render(data, strip), filament.render(data, strip.crop(TILE - 40, 0, 80, 32))
    np.testing.assert_array_equal(crop.instances, whole.instances[:, -80:])
    assert len(np.unique(crop.instances)) > 1
    assert (np.abs(crop.rgb - whole.rgb[:, -80:]).max(axis=-1) > 3).mean() < 0.002


def test_pictures_repeat_to_the_byte(cell):
    data, _, filament = cell
    first, again = filament.render(data, WIDE, ("rgb",)), filament.render(data, WIDE, ("rgb",))
    np.testing.assert_array_equal(first.rgb, again.rgb)


def test_a_new_renderer_makes_the_same_picture(plate):
    first = plate.draw().rgb
    with FilamentRenderer(plate.model, max_width=128, max_height=128) as other:
        np.testing.assert_array_equal(other.render(plate.data, WINDOW, ("rgb",)).rgb, first)


def test_lamps_without_an_intensity_light_the_cell_as_in_the_classic_renderer(cell):
    data, classic, filament = cell
    boards = [np.median(renderer.render(data, WIDE, ("rgb",)).rgb[:60, :60]) for renderer in (classic, filament)]
    assert boards[1] == pytest.approx(boards[0], rel=0.12)


def test_levels_are_linear_in_light_and_reflectance(plate):
    model = plate.model
    model.light_active[:] = 0
    shine = 0.05 * 255 * 0.4
    assert plate.level() == pytest.approx(255 * 0.4 * 0.8, abs=shine)
    grey = plate.level()
    model.vis.headlight.ambient[:] = 0.8
    assert plate.level() == pytest.approx(2 * grey, abs=2)
    model.vis.headlight.ambient[:] = 0.4
    levels = []
    for rgb in (0.2, 0.4, 0.6):
        model.mat_rgba[model.material("white").id, :3] = rgb
        levels.append(plate.level())
    assert levels[2] - levels[1] == pytest.approx(levels[1] - levels[0], abs=2)
    assert levels[1] - levels[0] == pytest.approx(255 * 0.4 * 0.2, abs=3)


def test_lamps_add_what_their_strength_says_and_may_exceed_saturation(plate):
    model = plate.model
    model.vis.headlight.ambient[:] = 0.0
    model.light_active[0] = 0
    one = plate.level()
    assert one == pytest.approx(255 * 0.3 * 0.96 * 0.8, rel=0.06)
    model.light_intensity[1] *= 2
    assert plate.level() == pytest.approx(2 * one, abs=2)
    model.light_diffuse[1] = [0.7, 0.3, 0.0]
    red, green, blue = plate.level()
    assert red > 260
    assert blue == pytest.approx(0, abs=1)
    assert green == pytest.approx(2 * one[1], abs=2)


def test_the_first_lamp_casts_shadows_where_it_should(plate):
    model = plate.model
    lit = plate.draw().rgb
    model.light_castshadow[0] = 0
    unshaded = plate.draw().rgb
    darker = (unshaded - lit).max(axis=-1) > 20
    rows, columns = np.nonzero(darker)
    assert rows.min() > 66, "the lamp stands on the side of +y, up in the picture"
    assert columns.mean() == pytest.approx(63.5, abs=1)
    assert 200 < darker.sum() < 45**2


def test_a_larger_lamp_casts_softer_shadows(plate):
    fine = Intrinsics(width=256, height=256, fx=4 * BASLER.fx, fy=4 * BASLER.fy, cx=127.5, cy=127.5)
    widths = []
    mujoco.mj_forward(plate.model, plate.data)
    for radius in (0.0, 0.05):
        plate.model.light_bulbradius[0] = radius
        row = plate.renderer.render(plate.data, fine, ("rgb",)).rgb[235, 128:250, 0]
        dark, lit = row[0], row[-1]
        assert dark < 0.8 * lit
        widths.append(np.count_nonzero((row > dark + 0.1 * (lit - dark)) & (row < lit - 0.1 * (lit - dark))))
    assert widths[1] > widths[0] + 2


CHANGES = {
    "colour": lambda m: m.mat_rgba.__setitem__((m.material("white").id, 0), 0.2),
    "metallic": lambda m: m.mat_metallic.__setitem__(m.material("metal").id, 0.0),
    "roughness": lambda m: m.mat_roughness.__setitem__(m.material("metal").id, 0.6),
    "material": lambda m: m.geom_matid.__setitem__(m.geom("plate").id, m.material("checks").id),
    "hidden": lambda m: m.geom_group.__setitem__(m.geom("part_00_visual").id, HIDDEN_GROUP),
    "lamp off": lambda m: m.light_active.__setitem__(1, 0),
    "lamp colour": lambda m: m.light_diffuse.__setitem__((1, 2), 0.1),
    "environment": lambda m: m.light_active.__setitem__(slice(2, 4), [0, 1]),
    "level of the environment": lambda m: m.light_intensity.__setitem__(2, 0.5 * m.light_intensity[2]),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_the_model_shows_at_the_next_render_and_can_be_taken_back(plate, change):
    plate.model.light_active[2] = 1
    before = plate.draw().rgb
    CHANGES[change](plate.model)
    assert np.abs(plate.draw().rgb - before).max() > 5
    plate.reset()
    plate.model.light_active[2] = 1
    np.testing.assert_array_equal(plate.draw().rgb, before)


def test_textures_repeat_as_the_material_says(plate):
    model = plate.model
    checks = model.material("checks").id
    model.geom_matid[model.geom("plate").id] = checks
    model.geom_group[model.geom("part_00_visual").id] = HIDDEN_GROUP
    edges = []
    for repeat in (2, 16):
        model.mat_texrepeat[checks] = repeat
        row = plate.draw().rgb[32, :, 0] > 60
        edges.append(np.count_nonzero(row[1:] != row[:-1]))
    assert edges[1] > edges[0] + 2


def test_metal_mirrors_the_environment_that_is_on(plate):
    """A mirror that faces up shows what is straight above, a tilted one what is on the side that it faces."""
    model, data = plate.model, plate.data
    model.light_active[:2] = 0
    for k in range(2):
        model.light_active[2:] = [k == 0, k == 1]
        colours = np.random.default_rng(k).integers(30, 255, (6, 3))
        for face, angle in ((ZENITH, 0.0), (0, 0.7), (1, -0.7)):
            data.mocap_quat[0] = [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]
            seen = plate.draw("rgb", "instances")
            mirror = np.median(seen.rgb[seen.instances == 0], axis=0)
            assert mirror == pytest.approx(0.9 * colours[face], rel=0.15, abs=4)


def test_edges_of_coverage_lie_where_the_samples_say():
    """A far bright plane behind a near dark one, whose border is crossed by every pixel of a column."""
    offsets = np.array([[-0.3, 0.1], [-0.1, -0.3], [0.1, 0.3], [0.3, -0.1]])
    u = np.arange(9.0)
    for border in (3.6, 4.0, 4.35):
        centres = np.tile(np.where(u < border, 0.5, 0.7), (7, 1)).astype(np.float32)
        samples = np.stack([np.tile(np.where(u + x < border, 0.5, 0.7), (7, 1)) for x, _ in offsets])
        colours = np.repeat(np.where(centres < 0.6, 40, 200)[..., None], 3, axis=-1).astype(np.uint8)
        dark = (200 - antialias(colours, centres, samples.astype(np.float32), offsets)[..., 0]) / 160
        covered = np.mean([u + x < border for x, _ in offsets], axis=0)
        np.testing.assert_allclose(dark, np.tile(covered[1:-1], (5, 1)), atol=1e-6)


def test_a_closed_renderer_and_a_window_too_large_are_refused(plate):
    renderer = FilamentRenderer(plate.model, max_width=64, max_height=64)
    with pytest.raises(SceneError, match="128 x 128 does not fit into this renderer's 64 x 64"):
        renderer.render(plate.data, WINDOW)
    with pytest.raises(SceneError, match="mj_forward"):
        renderer.render(mujoco.MjData(plate.model), WINDOW.crop(0, 0, 8, 8))
    renderer.close()
    renderer.close()
    with pytest.raises(SceneError, match="closed"):
        renderer.render(plate.data, WINDOW.crop(0, 0, 8, 8))
