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
SCALE = 20.0
"""Filament's units a metre. It keeps shadows a thousandth of a unit away from what casts them."""
RANGE = 100.0 * SCALE
DIRECTIONAL_DISTANCE, DIRECTIONAL_CONE_DEG = 10.0 * SCALE, 60.0
"""A directional lamp without shadows is a spot so far away and so wide: Filament has one directional light only."""
CASTER_HEIGHT_M = 1.5e-3
"""Height over the board of what casts the shadows that are to be as soft as the lamp's size makes them."""
SHADOW_COARSENING, COARSEST_SHADOWS = 2, 96
"""Shadow maps have at most the size of the classic renderer's over this, as a texel should not be finer than a pixel,
each of which has one sample of a shadow; and at least that many texels a side."""
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
Surround = int | tuple[int, int, int]
"""What light from all around has: an environment, which is a texture of the model, or a plain colour, 0 to 255."""


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
        self._sun = context.create_light(mjrf.LightParams(type=mjrf.LightType.LIGHT_DIRECTIONAL))
        self.scene.add_light(self._sun)
        self._lamps: dict[str, mjrf.Light] = {}
        self._surrounds: dict[Surround, tuple[mjrf.Texture, mjrf.Light]] = {}
        self._surround: Surround | None = None

    def update(self, data: mujoco.MjData) -> None:
        """Make the scene what the model and its forwarded data say now."""
        description = self._reader.read(data)
        self._place(description.geoms)
        self._light(description.lamps, self._shadow_side(description.geoms))
        self._surround_with(description)

    def _renderable(self, geom: int) -> mjrf.Renderable:
        renderable = self._meshes.get_renderable(_GEOM, geom)
        renderable.set_size((SCALE * _half_size(self._model, geom)).astype(np.float32))
        renderable.set_cast_shadow(bool(self._model.geom_castshadow[geom]))
        return renderable

    def _place(self, geoms: tuple[DrawnGeom, ...]) -> None:
        shown = {drawn.geom for drawn in geoms}
        for i in self._finishes.keys() - shown:
            self.scene.remove_renderable(self._renderables[i])
            del self._finishes[i]
        for drawn in geoms:
            i, renderable = drawn.geom, self._renderables[drawn.geom]
            position = (SCALE * drawn.T_world_geom[:3, 3]).astype(np.float32)
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

    def _light(self, lamps: tuple[DrawnLamp, ...], shadow_side: float) -> None:
        """The first lamp that casts shadows is Filament's one directional light; the others cast none."""
        model = self._model
        casting = (lamp for lamp in lamps if model.light(lamp.name).castshadow)
        sun = next(casting, None)
        self._shine(sun, shadow_side)
        others = {lamp.name: lamp for lamp in lamps if lamp is not sun}
        for name in self._lamps.keys() - others.keys():
            self.scene.remove_light(self._lamps.pop(name))
        for name, lamp in others.items():
            if name not in self._lamps:
                point = lamp.kind == "point"
                kind = mjrf.LightType.LIGHT_POINT if point else mjrf.LightType.LIGHT_SPOT
                params = mjrf.LightParams(type=kind, range=RANGE, softness=SOFT_RIM, cast_shadow=False)
                self._lamps[name] = self._context.create_light(params)
                self.scene.add_light(self._lamps[name])
            self._aim(self._lamps[name], lamp)

    def _shine(self, lamp: DrawnLamp | None, shadow_side: float) -> None:
        """Light and shadows of a lamp, parallel and as strong everywhere as at the middle of the scene."""
        self._sun.set_cast_shadow(lamp is not None)
        if lamp is None:
            self._sun.set_intensity(0.0)
            return
        away = (
            1.0
            if lamp.kind == "directional"
            else max(float(np.linalg.norm(self._aimed_at(lamp) - lamp.position)), 1e-3)
        )
        brightest = max(*lamp.rgb, 1e-9)
        self._sun.set_pose((SCALE * lamp.position).astype(np.float32), lamp.direction.astype(np.float32))
        self._sun.set_color((np.array(lamp.rgb) / brightest).astype(np.float32))
        self._sun.set_intensity(brightest / away**2 * WHITE)
        self._sun.set_shadow_map_size(self._shadow_map_size(shadow_side, lamp.radius_m / away))

    def _shadow_side(self, geoms: tuple[DrawnGeom, ...]) -> float:
        """About the side in metres of the square that shadows are computed for: Filament fits it to what casts them."""
        model = self._model
        largest = 2 * model.vis.map.shadowclip * model.stat.extent
        casters = [drawn for drawn in geoms if model.geom_castshadow[drawn.geom]]
        if not casters:
            return largest
        middles = np.array([drawn.T_world_geom[:3, 3] for drawn in casters])
        radii = model.geom_rbound[[drawn.geom for drawn in casters]][:, None]
        return min(largest, float(((middles + radii).max(axis=0) - (middles - radii).min(axis=0)).max()))

    def _shadow_map_size(self, side: float, half_angle: float) -> int:
        """Filament smooths the border of a shadow over a texel, which is made as wide as the lamp makes it soft."""
        soft = 2 * half_angle * CASTER_HEIGHT_M
        finest = self._model.vis.quality.shadowsize // SHADOW_COARSENING
        return int(np.clip(side / max(soft, 1e-9), min(COARSEST_SHADOWS, finest), finest))

    def _aim(self, light: mjrf.Light, lamp: DrawnLamp) -> None:
        """A lamp without shadows. Directional light comes from a spot some way from the middle of the scene."""
        position, strength, cutoff_deg = SCALE * lamp.position, SCALE**2, np.degrees(lamp.cutoff)
        if lamp.kind == "directional":
            position = SCALE * self._aimed_at(lamp) - DIRECTIONAL_DISTANCE * lamp.direction
            strength, cutoff_deg = DIRECTIONAL_DISTANCE**2, DIRECTIONAL_CONE_DEG
        brightest = max(*lamp.rgb, 1e-9)
        light.set_pose(position.astype(np.float32), lamp.direction.astype(np.float32))
        light.set_color((np.array(lamp.rgb) / brightest).astype(np.float32))
        light.set_intensity(brightest * strength * WHITE)
        light.set_cutoff(cutoff_deg)

    def _aimed_at(self, lamp: DrawnLamp) -> Array:
        """The point on a lamp's axis that is nearest to the middle of the scene, which is ``stat.center``."""
        return lamp.position + lamp.direction * ((self._model.stat.center - lamp.position) @ lamp.direction)

    def _surround_with(self, description: SceneDescription) -> None:
        """Light from all around: the model's environment, else a uniform one of the headlight's ambient colour."""
        brightest = max(description.ambient)
        wanted: Surround = description.environment
        if description.environment < 0:
            red, green, blue = (round(255 * level / max(brightest, 1e-9)) for level in description.ambient)
            wanted = red, green, blue
        if wanted != self._surround:
            if self._surround is not None:
                self.scene.remove_light(self._surrounds[self._surround][1])
            if wanted not in self._surrounds:
                self._surrounds[wanted] = self._image_light(wanted)
            self.scene.add_light(self._surrounds[wanted][1])
            self._surround = wanted
        radiance = description.environment_radiance if description.environment >= 0 else brightest
        self._surrounds[wanted][1].set_intensity(radiance * WHITE / np.pi)

    def _image_light(self, wanted: Surround) -> tuple[mjrf.Texture, mjrf.Light]:
        if isinstance(wanted, int):
            faces = np.rint(255 * texture_image(self._model, wanted)).astype(np.uint8)
        else:
            faces = np.broadcast_to(np.array(wanted, np.uint8), (6 * PLAIN_FACE, PLAIN_FACE, 3))
        cube = self._upload(faces, mjrf.SamplerType.TEXTURE_CUBE)
        return cube, self._context.create_light(mjrf.LightParams(type=mjrf.LightType.LIGHT_IMAGE, texture=cube))

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


def _half_size(model: mujoco.MjModel, i: int) -> Array:
    """What a geom's unit mesh is stretched by (3,); meshes have their own size."""
    kind, size = mujoco.mjtGeom(model.geom_type[i]), model.geom_size[i]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.repeat(size[0], 3)
    if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        return np.array([size[0], size[0], size[1]])
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return np.array([*size[:2], 1 / SCALE])
    return size if kind == mujoco.mjtGeom.mjGEOM_BOX else np.ones(3)


def _encoded(linear: Array) -> Array:
    """Linear colour to the sRGB curve, which Filament takes away again."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
