"""A compiled model and its data as plain arrays: what is drawn, what it is made of and what lights it.

For renderers that are not MuJoCo's own. Light is counted so that a white matt surface whose radiance is 1 saturates the
sensor: a directional lamp of colour (1, 1, 1) makes a white matt plate that faces it reach exactly that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, apply, transform
from scenes.drawn_mesh import DrawnMesh, mesh_key, mesh_of_geom
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.look import pbr_finish
from scenes.render import VISUAL_GROUPS, instance_of_geom

WHITE_LUX = 100_000.0
"""Illuminance at which a white matt surface saturates: what gives ``light_intensity`` (lux, candela) its meaning."""
_LIGHT = mujoco.mjtLightType
_UNSET_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""A material of this colour leaves it to the geom."""


@dataclass(frozen=True, kw_only=True)
class Finish:
    """A physically based surface. ``rgb`` (3,) base colour, linear; ``metallic`` and ``roughness`` 0..1 (perceptual);
    ``texture`` indexes the model's textures (-1: none), is multiplied with ``rgb`` and repeated ``repeat`` (2,) times
    over the unit square.
    """

    rgb: tuple[float, float, float]
    metallic: float
    roughness: float
    texture: int = -1
    repeat: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class DrawnGeom:
    """A visible geom: ``geom`` is its index, ``mesh_key`` is equal for geoms that share a mesh, ``instance`` that of
    the part it shows or -1.
    """

    geom: int
    name: str
    instance: int
    mesh_key: tuple[float, ...]
    mesh: DrawnMesh
    T_world_geom: Array
    finish: Finish

    @property
    def world_vertices(self) -> Array:
        """(V, 3) metres."""
        return apply(self.T_world_geom, self.mesh.vertices)

    @property
    def world_normals(self) -> Array:
        """(V, 3) unit vectors."""
        return self.mesh.normals @ self.T_world_geom[:3, :3].T


LampKind = Literal["directional", "spot", "point"]
_KINDS: dict[int, LampKind] = {
    int(_LIGHT.mjLIGHT_DIRECTIONAL): "directional",
    int(_LIGHT.mjLIGHT_SPOT): "spot",
    int(_LIGHT.mjLIGHT_POINT): "point",
}


@dataclass(frozen=True, kw_only=True)
class DrawnLamp:
    """``rgb`` (3,) radiance of a white matt surface that faces the lamp, for ``spot`` and ``point`` from 1 m.

    ``position`` and ``direction`` (3,) in the world, metres and unit length; ``radius_m`` of the emitting ball;
    ``cutoff`` half angle of a spot's cone, radians.
    """

    name: str
    kind: LampKind
    rgb: tuple[float, float, float]
    position: Array
    direction: Array
    radius_m: float
    cutoff: float


@dataclass(frozen=True, kw_only=True)
class SceneDescription:
    """Everything that decides how the scene looks, except the camera.

    ``environment`` indexes the model's textures, -1: none; its radiance is the texel (0..1) times
    ``environment_radiance``. ``ambient`` (3,) is the radiance of a uniform surround, zero where there is an
    environment.
    """

    geoms: tuple[DrawnGeom, ...]
    lamps: tuple[DrawnLamp, ...]
    environment: int
    environment_radiance: float
    ambient: tuple[float, float, float]


class SceneReader:
    """Reads one compiled model; its meshes are read once, everything else as it is when asked."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._instances = instance_of_geom(model)
        self._meshes: dict[tuple[float, ...], DrawnMesh] = {}

    def read(self, data: mujoco.MjData) -> SceneDescription:
        """The scene as it is now; ``data`` must be forwarded.

        Raises SceneError for a visible geom of a type that is not drawn, or a texture on a mesh without coordinates.
        """
        model = self._model
        shown = np.flatnonzero(np.isin(model.geom_group, VISUAL_GROUPS))
        geoms = (self._geom(data, int(i)) for i in shown)
        lamps = (_lamp(model, data, int(i)) for i in np.flatnonzero(model.light_active))
        image = np.flatnonzero(np.asarray(model.light_active) & (model.light_type == _LIGHT.mjLIGHT_IMAGE))
        environment = int(model.light_texid[image[0]]) if len(image) else -1
        return SceneDescription(
            geoms=tuple(geom for geom in geoms if geom is not None),
            lamps=tuple(lamp for lamp in lamps if lamp is not None),
            environment=environment,
            environment_radiance=float(model.light_intensity[image[0]]) * np.pi / WHITE_LUX if len(image) else 0.0,
            ambient=(0.0, 0.0, 0.0) if len(image) else _triple(model.vis.headlight.ambient),
        )

    def _geom(self, data: mujoco.MjData, i: int) -> DrawnGeom | None:
        model = self._model
        rgba, finish = _finish(model, i)
        if rgba[3] == 0:
            return None
        key = mesh_key(model, i)
        if key not in self._meshes:
            self._meshes[key] = mesh_of_geom(model, i)
        mesh = self._meshes[key]
        if finish.texture >= 0 and mesh.texcoords is None:
            raise SceneError(
                f"geom {model.geom(i).name!r} has a texture but no texture coordinates; draw it as a mesh that has them"
            )
        return DrawnGeom(
            geom=i,
            name=model.geom(i).name,
            instance=int(self._instances[i]),
            mesh_key=key,
            mesh=mesh,
            T_world_geom=transform(data.geom_xmat[i].reshape(3, 3), data.geom_xpos[i]),
            finish=finish,
        )


def texture_image(model: mujoco.MjModel, texture: int) -> NDArray[np.float32]:
    """A texture's colours (H, W, 3) in 0..1, linear; a cube's six faces are stacked, each a square."""
    start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
    height, width = model.tex_height[texture], model.tex_width[texture]
    texels = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    levels = np.broadcast_to(texels[..., :3], (height, width, 3)).astype(np.float32) / 255
    if model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        levels = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return levels.astype(np.float32)


def environment_panorama(model: mujoco.MjModel, texture: int) -> NDArray[np.float32]:
    """A cube texture as a panorama (2 N, 4 N, 3) in 0..1, linear, for faces of N pixels.

    The zenith (world +z) is the first row; the middle column looks along world +y, the one a quarter to its right along
    +x. MuJoCo's cube, whose up is +y, stands upright in the world, as its sky boxes do.
    """
    faces = texture_image(model, texture)
    n = faces.shape[1]
    theta = (np.arange(2 * n) + 0.5) / (2 * n) * np.pi
    phi = (np.arange(4 * n) + 0.5) / (4 * n) * 2 * np.pi - np.pi
    x = np.sin(theta)[:, None] * np.sin(phi)
    y = np.repeat(np.cos(theta)[:, None], 4 * n, axis=1)
    z = -np.sin(theta)[:, None] * np.cos(phi)
    return _sample_cube(faces.reshape(-1, n, n, 3), np.stack([x, y, z], axis=-1))


def _sample_cube(faces: NDArray[np.float32], directions: Array) -> NDArray[np.float32]:
    """Colours (..., 3) of a cube (6, N, N, 3: +x, -x, +y, -y, +z, -z) in directions (..., 3), as OpenGL reads it."""
    x, y, z = np.moveaxis(directions, -1, 0)
    major = np.abs(directions).argmax(axis=-1)
    length = np.abs(directions).max(axis=-1)
    positive = np.take_along_axis(directions, major[..., None], axis=-1)[..., 0] > 0
    sign = np.where(positive, 1.0, -1.0)
    s = np.choose(major, [-sign * z, x, sign * x]) / length
    t = np.choose(major, [-y, sign * z, -y]) / length
    n = faces.shape[1]
    column, row = (np.clip(((c + 1) / 2 * n).astype(int), 0, n - 1) for c in (s, t))
    return faces[2 * major + ~positive, row, column]


def _finish(model: mujoco.MjModel, i: int) -> tuple[NDArray[np.float32], Finish]:
    """Colour with opacity (4,), and what a geom is made of."""
    k = int(model.geom_matid[i])
    if k < 0:
        rgba = model.geom_rgba[i]
        return rgba, Finish(rgb=_triple(rgba), metallic=0.0, roughness=0.5)
    rgba = model.geom_rgba[i] if np.array_equal(model.mat_rgba[k], _UNSET_RGBA) else model.mat_rgba[k]
    metallic, roughness = pbr_finish(float(model.mat_specular[k]), float(model.mat_shininess[k]))
    if model.mat_metallic[k] >= 0:
        metallic = float(model.mat_metallic[k])
    if model.mat_roughness[k] >= 0:
        roughness = float(model.mat_roughness[k])
    repeat = model.mat_texrepeat[k]
    return rgba, Finish(
        rgb=_triple(rgba),
        metallic=metallic,
        roughness=roughness,
        texture=int(model.mat_texid[k, mujoco.mjtTextureRole.mjTEXROLE_RGB]),
        repeat=(float(repeat[0]), float(repeat[1])),
    )


def _lamp(model: mujoco.MjModel, data: mujoco.MjData, i: int) -> DrawnLamp | None:
    """A lamp; None for image lights. Without an intensity it is as bright at the model's centre as MuJoCo draws it."""
    kind = model.light_type[i]
    if kind == _LIGHT.mjLIGHT_IMAGE:
        return None
    position = data.light_xpos[i].copy()
    strength = float(model.light_intensity[i]) / WHITE_LUX
    if strength == 0:
        strength = 1.0
        if kind != _LIGHT.mjLIGHT_DIRECTIONAL:
            strength = float(np.sum((position - model.stat.center) ** 2))
    return DrawnLamp(
        name=model.light(i).name,
        kind=_KINDS[int(kind)],
        rgb=_triple(model.light_diffuse[i] * strength),
        position=position,
        direction=data.light_xdir[i].copy(),
        radius_m=float(model.light_bulbradius[i]),
        cutoff=float(np.radians(model.light_cutoff[i])),
    )


def _triple(values: Array | NDArray[np.float32]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
