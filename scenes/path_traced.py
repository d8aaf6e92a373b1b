"""The path-traced domain: Mitsuba 3 behind the renderers' protocol (extra ``photoreal``).

Light, materials and exposure are those of ``scenes.scene_export``; see ``scenes.photoreal`` for what it needs.
"""

from __future__ import annotations

import math
import zlib
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Intrinsics
from scenes.camera import CAMERA, camera_pose
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.ground_light import boxes, near_things, smooth_light
from scenes.path_view import MM, View, check_square
from scenes.photoreal import draws_pixels, load_mitsuba, mitsuba_problem
from scenes.render import ALL, Rendering, What, check_window
from scenes.scene_export import (
    DrawnGeom,
    DrawnLamp,
    Finish,
    SceneDescription,
    SceneReader,
    environment_panorama,
    texture_image,
)

__all__ = ["MitsubaRenderer", "mitsuba_problem"]

SAMPLES = 64
MAX_DEPTH = 6
GROUPS = 8
STRIDE = 1_000_003
SPECK_FACTOR, SPECK_LEVEL = 1.5, 0.05
LARGE_PX = 4_000_000
"""A window of more pixels has ``samples`` only round the things in it."""
GROUND_SAMPLES, REFLECTANCE_SAMPLES = 4, 8
"""A pixel of a large window elsewhere."""
SAMPLES_AT_ONCE = 1 << 24
"""Larger windows are drawn in bands of rows, which bounds the memory that a render takes."""
PIXEL_SAMPLES_AT_ONCE = 1 << 21
"""The same for single pixels, of which samples are kept."""
SCENE = {"type": "scene", "embree_use_robust_intersections": True}
"""Rays do not slip through between two triangles."""
SMOOTHEST = 0.03
"""Roughness below which highlights of lamps would be too bright to average."""
PARALLEL_M = 100.0
NO_LAMP_RADIUS_M = 1e-6
"""A lamp that is smaller than this is a point."""


class MitsubaRenderer:
    """Path tracing with ``samples`` a pixel (a power of 2 spreads them best) and a box filter, linear and not clipped.

    Instances and depth are of pixel centres. The noise is drawn from ``seed`` and from what is rendered: the same
    scene through the same window gives the same bytes, by any number of threads, and another scene other noise; so do
    Mitsuba's two variants, and may processors of other kinds. All surfaces cast shadows. Lamps shine in all directions
    and are seen in reflections only, never by the camera; what no geom covers is black.

    In windows of more than ``LARGE_PX`` pixels only what can move, and its surroundings with its shadows, gets
    ``samples``; light on what cannot move is fitted to fewer (see ``scenes.ground_light``).
    """

    def __init__(
        self, model: mujoco.MjModel, *, max_width: int, max_height: int, samples: int = SAMPLES, seed: int = 0
    ) -> None:
        if samples < 1:
            raise SceneError(f"{samples} samples a pixel: must be at least 1")
        self._mi = load_mitsuba()
        self._model, self._size = model, (max_width, max_height)
        self._samples, self._seed = samples, seed
        self._reader: SceneReader | None = SceneReader(model)
        self._kept: dict[Any, Any] = {}
        self._colours = self._mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True})
        self._labels = self._mi.load_dict({"type": "aov", "aovs": "position:position,shape:shape_index"})
        self._reflectance = self._mi.load_dict({"type": "aov", "aovs": "reflectance:albedo"})

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """See :class:`Renderer`. ``rgb`` is float32.

        Raises SceneError for a window larger than the renderer was made for, or with unequal focal lengths.
        """
        if self._reader is None:
            raise SceneError("this renderer was closed; make a new MitsubaRenderer")
        check_window(intrinsics, self._size)
        check_square(intrinsics)
        scene = self._reader.read(data)
        view = View(intrinsics, camera_pose(self._model, data, camera), scene)
        used: dict[Any, Any] = {}
        shapes = {f"geom_{geom.geom:05d}": self._shape(geom, view, used) for geom in scene.geoms}
        rgb = instances = depth = None
        if "rgb" in what:
            lit = self._mi.load_dict({**SCENE, **shapes, **self._lights(scene, view, used)})
            small = intrinsics.width * intrinsics.height <= LARGE_PX
            rgb = self._draw_colours(lit, view) if small else self._draw_large(lit, view, scene)
        if "instances" in what or "depth" in what:
            bare = self._mi.load_dict({**SCENE, **shapes})
            drawn = self._draw(bare, self._labels, view, 1, 0)
            geom = self._geom_order(bare)[drawn[..., 3].astype(np.int64)]
            if "instances" in what:
                instances = np.array([-1, *(shown.instance for shown in scene.geoms)], np.int16)[geom]
            if "depth" in what:
                far = self._model.vis.map.zfar * self._model.stat.extent
                depth = np.where(geom > 0, view.depth_m(drawn[..., :3]), far).astype(np.float32)
        self._kept = used
        return Rendering(rgb=rgb, instances=instances, depth_m=depth)

    def close(self) -> None:
        """Forget the meshes; closing twice is harmless."""
        self._reader = None
        self._kept = {}

    def __enter__(self) -> MitsubaRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw_large(self, scene: Any, view: View, drawn: SceneDescription) -> NDArray[np.float32]:
        """Grey levels (H, W, 3): few samples of the ground, as many as asked for near things."""
        seed = zlib.crc32(view.signature(self._seed))
        noisy = self._draw(scene, self._colours, view, min(GROUND_SAMPLES, self._samples), seed)
        reflectance = self._draw(scene, self._reflectance, view, REFLECTANCE_SAMPLES, seed + STRIDE)
        levels = 255 * smooth_light(noisy, reflectance)
        model = self._model
        bodies = [int(model.geom_bodyid[geom.geom]) for geom in drawn.geoms]
        moves = [model.body_weldid[body] != 0 or model.body_mocapid[body] >= 0 for body in bodies]
        things = [geom for geom, moving in zip(drawn.geoms, moves, strict=True) if moving]
        near = near_things(things, drawn.lamps, view.intrinsics, view.T_world_cam)
        if draws_pixels(self._mi):
            levels[near] = self._draw_pixels(scene, view, np.argwhere(near), seed + 2 * STRIDE)
        else:
            for x, y, width, height in boxes(near):
                part = view.through(view.intrinsics.crop(x, y, width, height))
                levels[y : y + height, x : x + width] = self._draw_colours(scene, part)
        return levels

    def _draw_pixels(self, scene: Any, view: View, pixels: NDArray[np.int64], seed: int) -> NDArray[np.float32]:
        """Grey levels (N, 3) of some pixels (N, 2), row and column, as ``_draw_colours`` draws whole windows.

        They are drawn in portions of one size, which Mitsuba compiles once.
        """
        mi, dr = self._mi, import_module("drjit")
        description = view.sensor(mi, view.intrinsics, self._samples)
        sensor, sampler = mi.load_dict(description), mi.load_dict(description["sampler"])
        samples = int(sampler.sample_count())  # rounded up where it cannot be spread well
        sampler.set_samples_per_wavefront(samples)
        groups = math.gcd(samples, self._groups)
        portion = max(1, PIXEL_SAMPLES_AT_ONCE // samples)
        owner = dr.arange(mi.UInt32, portion * samples) // samples
        size = mi.Point2f(view.intrinsics.width, view.intrinsics.height)
        levels = np.empty((len(pixels), 3), np.float32)
        for start in range(0, len(pixels), portion):
            some = pixels[start : start + portion]
            rows, columns = (mi.Float(axis) for axis in np.resize(some, (portion, 2)).T.astype(np.float32))
            sampler.seed((seed + start) % 2**32, portion * samples)
            corner = mi.Point2f(dr.gather(mi.Float, columns, owner), dr.gather(mi.Float, rows, owner))
            ray, weight = sensor.sample_ray(0.0, 0.0, (corner + sampler.next_2d()) / size, mi.Point2f(0.5))
            seen, _, _ = self._colours.sample(scene, sampler, mi.RayDifferential3f(ray))
            drawn = np.array(seen * weight, np.float32).reshape(3, portion, groups, -1).mean(axis=-1)
            levels[start : start + portion] = _levels(drawn.T)[: len(some)]
        return levels

    def _draw_colours(self, scene: Any, view: View) -> NDArray[np.float32]:
        """Grey levels (H, W, 3) from several groups of samples."""
        seed, each = zlib.crc32(view.signature(self._seed)), self._samples // self._groups
        drawn = [self._draw(scene, self._colours, view, each, seed + STRIDE * k) for k in range(self._groups)]
        return _levels(np.stack(drawn))

    @property
    def _groups(self) -> int:
        return max(1, min(GROUPS, self._samples // GROUPS))

    def _draw(self, scene: Any, integrator: Any, view: View, samples: int, seed: int) -> NDArray[np.float32]:
        """What an integrator makes of a scene, (H, W, channels), drawn in bands that fit into memory."""
        whole = view.intrinsics
        rows = max(1, SAMPLES_AT_ONCE // (whole.width * samples))
        bands = []
        for top in range(0, whole.height, rows):
            band = whole.crop(0, top, whole.width, min(rows, whole.height - top))
            sensor = self._mi.load_dict(view.sensor(self._mi, band, samples))
            noise = (seed + top) % 2**32
            drawn = self._mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=noise)
            bands.append(np.array(drawn, np.float32))
        return np.concatenate(bands)

    def _geom_order(self, scene: Any) -> NDArray[np.int64]:
        """Index by a shape's number in an image; gives 1 + the place of its geom among the drawn ones, 0 for none."""
        shapes = scene.shapes()
        if not draws_pixels(self._mi):
            numbers = np.arange(1, len(shapes) + 1)
        else:
            reinterpret = import_module("drjit").reinterpret_array
            numbers = np.array(reinterpret(self._mi.UInt32, scene.shapes_dr()), np.int64)
        order = np.zeros(numbers.max(initial=0) + 1, np.int64)
        ids = [shape.id() for shape in shapes]
        order[numbers] = np.argsort(np.argsort(ids)) + 1
        return order

    def _shape(self, geom: DrawnGeom, view: View, used: dict[Any, Any]) -> Any:
        finish = geom.finish
        if finish not in used:
            used[finish] = self._kept.get(finish) or self._surface(finish)
        drawn = geom.mesh
        properties = self._mi.Properties()
        properties["bsdf"] = used[finish]
        mesh = self._mi.Mesh(
            geom.name,
            vertex_count=len(drawn.vertices),
            face_count=len(drawn.faces),
            has_vertex_normals=True,
            has_vertex_texcoords=drawn.texcoords is not None,
            props=properties,
        )
        arrays = self._mi.traverse(mesh)
        arrays["vertex_positions"] = view.local(geom.world_vertices).astype(np.float32).ravel()
        arrays["vertex_normals"] = geom.world_normals.astype(np.float32).ravel()
        arrays["faces"] = drawn.faces.astype(np.uint32).ravel()
        if drawn.texcoords is not None:
            arrays["vertex_texcoords"] = (drawn.texcoords * np.array(finish.repeat, np.float32)).ravel()
        arrays.update()
        return mesh

    def _surface(self, finish: Finish) -> Any:
        """A BSDF, seen from both sides."""
        colour: dict[str, Any] = {"type": "rgb", "value": list(np.clip(finish.rgb, 0, 1))}
        if finish.texture >= 0:
            image = np.clip(texture_image(self._model, finish.texture) * np.array(finish.rgb, np.float32), 0, 1)
            colour = {"type": "bitmap", "bitmap": self._mi.Bitmap(image), "raw": True}
        surface = {
            "type": "principled",
            "base_color": colour,
            "metallic": finish.metallic,
            "roughness": max(finish.roughness, SMOOTHEST),
            "main_specular_sampling_rate": 0.1 + 0.9 * finish.metallic,
        }
        return self._mi.load_dict({"type": "twosided", "surface": surface})

    def _lights(self, scene: SceneDescription, view: View, used: dict[Any, Any]) -> dict[str, Any]:
        lamps = [_lamp(self._mi, lamp, view) for lamp in scene.lamps if any(lamp.rgb)]
        lights: dict[str, Any] = {f"lamp_{i:02d}": lamp for i, lamp in enumerate(lamps)}
        if scene.environment >= 0:
            key = (scene.environment, scene.environment_radiance)
            used[key] = self._kept.get(key) or self._environment(*key)
            lights["environment"] = used[key]
        elif any(scene.ambient):
            lights["environment"] = {"type": "constant", "radiance": {"type": "rgb", "value": list(scene.ambient)}}
        return lights

    def _environment(self, texture: int, radiance: float) -> Any:
        upright = self._mi.ScalarTransform4f().rotate([1, 0, 0], 90).rotate([0, 1, 0], 180)
        panorama = self._mi.Bitmap(environment_panorama(self._model, texture))
        return self._mi.load_dict({"type": "envmap", "bitmap": panorama, "scale": radiance, "to_world": upright})


def _levels(groups: NDArray[np.float32]) -> NDArray[np.float32]:
    """Grey levels (..., 3): the mean of groups of samples (G, ..., 3), none of which may be far above their median.

    A path that finds a lamp by way of a mirror is rare and bright; alone in its pixel it would be a white speck.
    """
    limit = SPECK_FACTOR * np.median(groups, axis=0) + SPECK_LEVEL
    return 255 * np.minimum(groups, limit).mean(axis=0)


def _lamp(mi: ModuleType, lamp: DrawnLamp, view: View) -> dict[str, Any]:
    """A ball or point that shines alike in all directions; parallel light comes from a ball that is far away.

    That ball is seen under the same angle as the lamp's bulb from the middle of the parts, so shadows are as soft.
    """
    rgb, radius, position = np.array(lamp.rgb), lamp.radius_m, lamp.position
    if lamp.kind == "directional":
        if radius < NO_LAMP_RADIUS_M:
            irradiance = {"type": "rgb", "value": list(np.pi * rgb)}
            return {"type": "directional", "direction": list(lamp.direction), "irradiance": irradiance}
        radius *= PARALLEL_M / np.linalg.norm(position - view.parts)
        rgb, position = rgb * PARALLEL_M**2, view.parts - PARALLEL_M * lamp.direction
    centre = [float(x) for x in view.local(position)]
    if radius < NO_LAMP_RADIUS_M:
        return {"type": "point", "position": centre, "intensity": {"type": "rgb", "value": list(np.pi * rgb * MM**2)}}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(rgb / radius**2)}}
    return {"type": "sphere", "center": centre, "radius": float(radius * MM), "emitter": emitter}
