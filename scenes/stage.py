"""A compiled model in which training shots are arranged, dressed and rendered without compiling again.

World frame = ``board``. Every part has a few slots and every distractor one; what a shot does not use is hidden.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import BASLER, Intrinsics
from cad.tagboard import TagboardConfig
from scenes.camera import add_camera, set_camera_pose
from scenes.distorted import DistortedRenderer
from scenes.distractors import distractor_meshes
from scenes.domains import Domain, make_renderer
from scenes.environments import irradiance
from scenes.gl import mujoco
from scenes.lens import Lens
from scenes.look import (
    MATT_SHININESS,
    MATT_SPECULAR,
    add_board_visuals,
    add_material,
    add_mesh,
    add_texture,
    add_visual,
)
from scenes.randomize import LIGHTS, Look, camera_above, draw_distractor_surface, draw_part_surface
from scenes.ranges import LookRanges
from scenes.render import HIDDEN_GROUP, Rendering, What
from scenes.scene_export import WHITE_LUX
from scenes.shots import Placed, Shot
from scenes.textures import worn

LIGHT_DISTANCE_M = 0.5
CONE = 1.6
"""The cone of a lamp covers a disc of this many times the half side of the shadows' square, square to its axis."""
BOARD_ASPECT = 0.6875
"""Height of the board over its width."""


@dataclass(frozen=True, kw_only=True)
class StageConfig:
    """``slots`` instances of each part can be shown at once; windows have up to ``max_size`` (width, height) pixels.

    ``shadow_half_m`` is half the side of the square round the shot's focus that shadows are computed for, on a map of
    ``shadow_size`` pixels.
    """

    slots: int
    max_size: tuple[int, int]
    shadow_half_m: float
    shadow_size: int


class Stage:
    """See the module's text. ``arrange`` a shot, ``dress`` it, then ``render`` it; close it when done."""

    def __init__(
        self,
        parts: Sequence[Part],
        textures: Sequence[NDArray[np.uint8]],
        config: StageConfig,
        *,
        domain: Domain = "classic",
        environments: Sequence[NDArray[np.uint8]] = (),
        wear: Sequence[NDArray[np.uint8]] = (),
        board: TagboardConfig | None = None,
    ) -> None:
        self._parts = {part.name: part for part in parts}
        self._slots = config.slots
        spec = _build(parts, textures, wear, config, board or TagboardConfig())
        self._photometric = domain != "classic"
        _add_lamps(spec, self._photometric)
        if self._photometric:
            _add_environments(spec, environments)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._find(len(textures), len(wear))
        self._environments = [irradiance(cube) for cube in environments] if self._photometric else []
        self._first_slot = {part.name: k * config.slots for k, part in enumerate(parts)}
        self._shown: list[int] = []
        width, height = config.max_size
        renderer = make_renderer(domain, self.model, max_width=width, max_height=height)
        self._renderer = DistortedRenderer(renderer, max_width=width, max_height=height)

    def arrange(self, shot: Shot) -> NDArray[np.int16]:
        """Put camera, parts and distractors where the shot says; returns the instance index of each part (N,).

        Parts of one name that outnumber the slots raise IndexError: shots are drawn for the stage they are shown on.
        """
        model, data = self.model, self.data
        for geom in self._shown:
            model.geom_group[geom] = HIDDEN_GROUP
        self._shown = []
        used = dict(self._first_slot)
        instances = []
        for placed in shot.parts:
            instance = used[placed.name]
            if instance >= self._first_slot[placed.name] + self._slots:
                raise IndexError(f"a shot shows more than {self._slots} of {placed.name!r}")
            used[placed.name] += 1
            instances.append(instance)
            self._show(f"part_{instance:02d}", placed)
        for placed in shot.distractors:
            self._show(placed.name, placed)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        set_camera_pose(model, data, shot.T_board_cam)
        return np.array(instances, np.int16)

    def dress(self, shot: Shot, look: Look, ranges: LookRanges, rng: np.random.Generator) -> None:
        """Set lamps, plate, tags and the surfaces of everything shown."""
        model = self.model
        self._light(look, shot.focus_board)
        plate = self._plates[look.texture]
        model.geom_matid[self._board] = plate
        model.mat_rgba[plate, :3] = look.board_rgb
        model.mat_roughness[plate] = look.board_roughness
        if look.texture >= 0:
            model.mat_texrepeat[plate] = [look.texture_repeat, look.texture_repeat * BOARD_ASPECT]
        tags = self._tags[look.worn]
        model.geom_matid[self._labels] = tags
        model.mat_rgba[tags, :3] = look.tag_level
        model.mat_rgba[self._surroundings, :3] = look.surroundings_level
        for geom in self._shown:
            part = self._part_of_geom.get(geom)
            if part is None:
                surface = draw_distractor_surface(ranges, rng)
            else:
                surface = draw_part_surface(ranges, part, look.default, rng)
            k = model.geom_matid[geom]
            model.mat_rgba[k, :3] = surface.rgb
            model.mat_metallic[k], model.mat_roughness[k] = surface.metallic, surface.roughness
            model.mat_specular[k], model.mat_shininess[k] = surface.specular, surface.shininess

    def render(self, intrinsics: Intrinsics, what: tuple[What, ...]) -> Rendering:
        """Draw what was arranged through a window."""
        return self._renderer.render(self.data, intrinsics, what)

    @property
    def lens(self) -> Lens:
        """The lens that everything is seen through; one that does not distort unless another is set."""
        return self._renderer.lens

    @lens.setter
    def lens(self, lens: Lens) -> None:
        self._renderer.lens = lens

    def part(self, name: str) -> Part:
        """One of the parts that the stage can show."""
        return self._parts[name]

    @property
    def shown(self) -> tuple[int, ...]:
        """The geoms of the parts and distractors arranged last."""
        return tuple(self._shown)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def _find(self, textures: int, wear: int) -> None:
        """Look up what is dressed: the last of the plates, and of the tags, is the plain one, at index -1."""
        model = self.model
        self._board, self._labels = model.geom("board_visual").id, model.geom("tags_visual").id
        self._plates = [model.material(name).id for name in [*(f"plate_{k:02d}" for k in range(textures)), "board"]]
        self._tags = [model.material(name).id for name in [*(f"tags_{k:02d}" for k in range(wear)), "tags"]]
        self._surroundings = model.material("surroundings").id
        slots = [part for part in self._parts.values() for _ in range(self._slots)]
        self._part_of_geom = {model.geom(f"part_{i:02d}_visual").id: part for i, part in enumerate(slots)}

    def _show(self, body: str, placed: Placed) -> None:
        model = self.model
        mocap = model.body(body).mocapid[0]
        self.data.mocap_pos[mocap] = placed.T_board_object[:3, 3]
        mujoco.mju_mat2Quat(self.data.mocap_quat[mocap], placed.T_board_object[:3, :3].ravel())
        geom = model.geom(f"{body}_visual").id
        model.geom_group[geom] = 1
        self._shown.append(geom)

    def _light(self, look: Look, focus: tuple[float, float]) -> None:
        """Aim the lamps at the focus: shadows are computed round the point a lamp looks at."""
        model, data = self.model, self.data
        model.vis.headlight.ambient[:] = look.ambient
        target = np.array([*focus, 0.0])
        model.stat.center[:] = target
        for i in range(LIGHTS):
            model.light_active[i] = i < len(look.lamps)
            if i >= len(look.lamps):
                continue
            lamp = look.lamps[i]
            towards = np.array(lamp.towards) / np.linalg.norm(lamp.towards)
            distance = lamp.distance_m if self._photometric else LIGHT_DISTANCE_M
            model.light_diffuse[i], model.light_specular[i] = lamp.rgb, lamp.specular
            model.light_castshadow[i] = lamp.shadow
            data.light_xpos[i], data.light_xdir[i] = target + distance * towards, -towards
            if self._photometric:
                model.light_intensity[i] = WHITE_LUX * distance**2
                model.light_bulbradius[i] = lamp.radius_m
                model.light_cutoff[i] = np.degrees(np.arctan(CONE * model.vis.map.shadowclip / distance))
        for k, board_irradiance in enumerate(self._environments):
            i = LIGHTS + k
            model.light_active[i] = k == look.environment
            model.light_intensity[i] = look.ambient / board_irradiance * WHITE_LUX / np.pi


def _build(
    parts: Sequence[Part],
    textures: Sequence[NDArray[np.uint8]],
    wear: Sequence[NDArray[np.uint8]],
    config: StageConfig,
    board: TagboardConfig,
) -> mujoco.MjSpec:
    """From the top down: geoms are drawn in this order, and what is hidden by then costs little."""
    spec = mujoco.MjSpec()
    spec.modelname = "stage"
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 10.0
    spec.visual.map.shadowclip, spec.visual.quality.shadowsize = config.shadow_half_m, config.shadow_size
    spec.visual.headlight.diffuse = spec.visual.headlight.specular = [0.0] * 3
    for k, part in enumerate(parts):
        add_mesh(spec, f"{part.name}_visual", part.mesh)
        for slot in range(k * config.slots, (k + 1) * config.slots):
            _add_slot(spec, f"part_{slot:02d}", f"{part.name}_visual")
    for name, mesh in distractor_meshes().items():
        add_mesh(spec, name, mesh)
        _add_slot(spec, name, name)
    body = spec.worldbody.add_body(name="board")
    add_board_visuals(spec, body, board)
    add_camera(body, BASLER, camera_above(0.7))
    add_material(spec, "surroundings", (0.3, 0.3, 0.31, 1.0), specular=0.0, shininess=0.1)
    beneath = spec.worldbody.add_body(name="surroundings")
    table = beneath.add_geom(name="surroundings", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.5, 0.01])
    table.pos, table.material, table.group = [0.0, 0.0, -board.thickness_m - 0.01], "surroundings", 1
    table.castshadow = False
    for k, texture in enumerate(textures):
        _add_matt(spec, f"plate_{k:02d}", texture)
    clean = _image_of(spec.texture("tags")) if wear else None
    for k, layer in enumerate(wear):
        assert clean is not None
        _add_matt(spec, f"tags_{k:02d}", worn(clean, layer))
    return spec


def _add_lamps(spec: mujoco.MjSpec, photometric: bool) -> None:
    """Lamps that shine from a place, into a cone, where light is physical; from a direction in the classic renderer."""
    kind = mujoco.mjtLightType.mjLIGHT_SPOT if photometric else mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    for i in range(LIGHTS):
        light = spec.worldbody.add_light(name=f"lamp_{i}", type=kind)
        light.ambient, light.dir = [0.0] * 3, [0.0, 0.0, -1.0]


def _add_environments(spec: mujoco.MjSpec, environments: Sequence[NDArray[np.uint8]]) -> None:
    """An image light for each cube map (6, N, N, 3): what metal reflects; at most one of them is on."""
    for k, faces in enumerate(environments):
        name = f"environment_{k:02d}"
        texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_CUBE)
        texture.height, texture.width, texture.nchannel = 6 * faces.shape[1], faces.shape[2], 3
        texture.data = np.ascontiguousarray(faces).tobytes()
        light = spec.worldbody.add_light(name=name, type=mujoco.mjtLightType.mjLIGHT_IMAGE, texture=name)
        light.active = False


def _add_matt(spec: mujoco.MjSpec, name: str, image: NDArray[np.uint8]) -> None:
    """A texture and the matt material that shows it."""
    add_texture(spec, name, image)
    add_material(spec, name, (1, 1, 1, 1), specular=MATT_SPECULAR, shininess=MATT_SHININESS, texture=name)


def _image_of(texture: mujoco.MjsTexture) -> NDArray[np.uint8]:
    return np.frombuffer(texture.data, np.uint8).reshape(texture.height, texture.width, texture.nchannel)


def _add_slot(spec: mujoco.MjSpec, name: str, mesh: str) -> None:
    """A body that can be put anywhere, with a material of its own, hidden at first."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    add_material(spec, name, (0.7, 0.7, 0.7, 1.0), specular=0.5, shininess=0.5)
    add_visual(body, f"{name}_visual", mesh, material=name).group = HIDDEN_GROUP
