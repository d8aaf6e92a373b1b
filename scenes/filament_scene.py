"""A compiled model in Filament: its meshes are uploaded once, everything else follows the model and its data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array
from scenes.gl import mujoco
from scenes.scene_export import DrawnGeom, DrawnLamp, Finish, SceneDescription, SceneReader, texture_image

# isort: split
from mujoco import mjrf

HEADROOM = 1.5
"""Radiance, in multiples of what saturates the sensor, at which Filament's 8 bits a channel are at their end."""
WHITE = np.pi * 1.2 * 2**15 / HEADROOM
"""Illuminance (lux) that makes a white matt surface saturate the sensor: Filament's own exposure (f/16, 1/125 s, ISO
100) saturates at 1.2 * 2**15 candela a square metre."""
DIRECTIONAL_DISTANCE_M = 1.0
"""Directional light comes from a spot this far before the point of its axis that is nearest to the light's body:
Filament has only one directional light, and fits its shadows to the window that is drawn."""
RANGE_M = 10.0
PLAIN_FACE = 4
"""Pixels along each side of a face of a plain surround."""
SOFT_RIM = 0.02
"""Share of a spot's cone in which it fades out."""
SETTINGS = """<mujoco><custom>
  <numeric name="filament.ao.enabled" data="0"/>
  <numeric name="filament.bloom.enabled" data="0"/>
  <numeric name="filament.vignette.enabled" data="0"/>
  <text name="filament.shadows.type" data="pcf"/>
</custom></mujoco>"""
_GEOM = mujoco.mjtObj.mjOBJ_GEOM


class FilamentScene:
    """What a renderer draws. ``context`` must outlive it."""

    def __init__(self, context: mjrf.Context, model: mujoco.MjModel) -> None:
        self._context, self._model = context, model
        self._reader = SceneReader(model)
        self.scene = context.create_scene(mjrf.SceneParams())
        self.scene.configure_from_model(mujoco.MjModel.from_xml_string(SETTINGS))
        self._resources = mjrf.ModelResources(context, model)
        self._meshes = mjrf.ModelRenderables(self.scene, self._resources)
        nothing = mujoco.MjvOption()
        nothing.geomgroup[:] = nothing.sitegroup[:] = nothing.tendongroup[:] = nothing.skingroup[:] = False
        self._meshes.set_options(nothing)
        self._renderables = [self._renderable(i) for i in range(model.ngeom)]
        self._textures: dict[int, mjrf.Texture] = {}
        self._finishes: dict[int, Finish] = {}
        self._lamps: dict[str, mjrf.Light] = {}
        self._cubes: dict[object, mjrf.Texture] = {}
        self._surround: tuple[object, mjrf.Light] | None = None

    def update(self, data: mujoco.MjData) -> None:
        """Make the scene what the model and its forwarded data say now."""
        description = self._reader.read(data)
        self._place(description.geoms)
        self._light(data, description.lamps)
        self._surround_with(description)

    def _renderable(self, geom: int) -> mjrf.Renderable:
        renderable = self._meshes.get_renderable(_GEOM, geom)
        renderable.set_size(_half_size(self._model, geom).astype(np.float32))
        renderable.set_cast_shadow(bool(self._model.geom_castshadow[geom]))
        return renderable

    def _place(self, geoms: tuple[DrawnGeom, ...]) -> None:
        shown = {drawn.geom for drawn in geoms}
        for i in self._finishes.keys() - shown:
            self.scene.remove_renderable(self._renderables[i])
            del self._finishes[i]
        for drawn in geoms:
            i, renderable = drawn.geom, self._renderables[drawn.geom]
            position = drawn.T_world_geom[:3, 3].astype(np.float32)
            renderable.set_pose(position, drawn.T_world_geom[:3, :3].ravel().astype(np.float32))
            if i not in self._finishes:
                self.scene.add_renderable(renderable)
            if self._finishes.get(i) != drawn.finish:
                renderable.set_material(self._material(i, drawn.finish))
                self._finishes[i] = drawn.finish

    def _material(self, geom: int, finish: Finish) -> mjrf.Material:
        material = mjrf.Material(
            color=np.array([*_encoded(np.array(finish.rgb)), 1.0], np.float32),
            segmentation_id=geom + 1,
            metallic=finish.metallic,
            roughness=finish.roughness,
            uv_scale=np.array([*finish.repeat, 1.0], np.float32),
        )
        if finish.texture >= 0:
            material.color_texture = self._texture(finish.texture)
        return material

    def _light(self, data: mujoco.MjData, lamps: tuple[DrawnLamp, ...]) -> None:
        for name in self._lamps.keys() - {lamp.name for lamp in lamps}:
            self.scene.remove_light(self._lamps.pop(name))
        for lamp in lamps:
            if lamp.name not in self._lamps:
                point = lamp.kind == "point"
                kind = mjrf.LightType.LIGHT_POINT if point else mjrf.LightType.LIGHT_SPOT
                self._lamps[lamp.name] = self._context.create_light(
                    mjrf.LightParams(type=kind, range=RANGE_M, softness=SOFT_RIM)
                )
                self.scene.add_light(self._lamps[lamp.name])
            self._aim(data, self._lamps[lamp.name], lamp)

    def _aim(self, data: mujoco.MjData, light: mjrf.Light, lamp: DrawnLamp) -> None:
        model = self._model
        i = model.light(lamp.name).id
        position, cutoff = lamp.position, lamp.cutoff
        if lamp.kind == "directional":
            position = _axis_origin(model, data, lamp, i) - DIRECTIONAL_DISTANCE_M * lamp.direction
            cutoff = np.arctan(np.sqrt(2) * model.vis.map.shadowclip * model.stat.extent / DIRECTIONAL_DISTANCE_M)
        brightest = max(*lamp.rgb, 1e-9)
        light.set_pose(position.astype(np.float32), lamp.direction.astype(np.float32))
        light.set_color((np.array(lamp.rgb) / brightest).astype(np.float32))
        light.set_intensity(brightest * WHITE)
        light.set_cutoff(np.degrees(cutoff))
        light.set_cast_shadow(bool(model.light_castshadow[i]))
        light.set_shadow_map_size(int(model.vis.quality.shadowsize))

    def _surround_with(self, description: SceneDescription) -> None:
        """Light from all around: the model's environment, else a uniform one of the headlight's ambient colour."""
        brightest = max(description.ambient)
        wanted: object = description.environment
        if description.environment < 0:
            wanted = tuple(np.rint(255 * np.array(description.ambient) / max(brightest, 1e-9)).astype(np.uint8))
        if self._surround is None or self._surround[0] != wanted:
            if self._surround is not None:
                self.scene.remove_light(self._surround[1])
            self._surround = wanted, self._image_light(wanted)
            self.scene.add_light(self._surround[1])
        radiance = description.environment_radiance if description.environment >= 0 else brightest
        self._surround[1].set_intensity(radiance * WHITE / np.pi)

    def _image_light(self, wanted: object) -> mjrf.Light:
        """An image light from a texture of the model or of a plain colour (3,) uint8."""
        if wanted not in self._cubes:
            if isinstance(wanted, int):
                faces = np.rint(255 * texture_image(self._model, wanted)).astype(np.uint8)
            else:
                faces = np.broadcast_to(np.array(wanted, np.uint8), (6 * PLAIN_FACE, PLAIN_FACE, 3))
            self._cubes[wanted] = self._upload(faces, mjrf.SamplerType.TEXTURE_CUBE)
        return self._context.create_light(
            mjrf.LightParams(type=mjrf.LightType.LIGHT_IMAGE, texture=self._cubes[wanted], intensity=1.0)
        )

    def _texture(self, index: int) -> mjrf.Texture:
        if index not in self._textures:
            image = np.rint(255 * texture_image(self._model, index)).astype(np.uint8)
            self._textures[index] = self._upload(image, mjrf.SamplerType.TEXTURE_2D)
        return self._textures[index]

    def _upload(self, image: NDArray[np.uint8], sampler: mjrf.SamplerType) -> mjrf.Texture:
        height, width = image.shape[:2]
        texture = self._context.create_texture(
            mjrf.TextureConfig(
                width=width,
                height=height,
                format=mjrf.PixelFormat.PIXEL_FORMAT_RGB8,
                color_space=mjrf.ColorSpace.COLORSPACE_LINEAR,
                sampler_type=sampler,
            )
        )
        texels = mjrf.TextureData()
        texels.set_image(np.ascontiguousarray(image).tobytes())
        texture.upload(texels)
        return texture


def _axis_origin(model: mujoco.MjModel, data: mujoco.MjData, lamp: DrawnLamp, i: int) -> Array:
    """The point on a lamp's axis that is nearest to its body."""
    return lamp.position + lamp.direction * ((data.xpos[model.light_bodyid[i]] - lamp.position) @ lamp.direction)


def _half_size(model: mujoco.MjModel, i: int) -> Array:
    """What a geom's unit mesh is stretched by (3,); meshes have their own size."""
    kind, size = mujoco.mjtGeom(model.geom_type[i]), model.geom_size[i]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.repeat(size[0], 3)
    if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return np.array([size[0], size[0], size[1]])
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return np.array([*size[:2], 1.0])
    return size if kind == mujoco.mjtGeom.mjGEOM_BOX else np.ones(3)


def _encoded(linear: Array) -> Array:
    """Linear colour to the sRGB curve, which Filament takes away again."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
