"""Draws an exported scene with Blender's Cycles: PYTHON benchmarks/blender_scene.py FOLDER, with a Python that has bpy.

A program of its own, for comparison only: it needs nothing of this project, and nothing here needs it. FOLDER holds
what ``benchmarks.render_domains`` exports: ``scene.json`` (camera, geoms, lamps, samples, threads), arrays in ``.npz``.
Lengths are in metres, transforms 4 x 4, the camera looks along z with v down and integer pixel centres; a radiance of 1
is white. It writes ``cycles.png``, ``mask.png`` (white where the part is) and ``times.json``.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

SUN_OF_WHITE = math.pi
BULB_OF_WHITE = 4 * math.pi**2
"""Strength (W / m^2, W) of a sun and of a bulb 1 m away that a white matt surface facing them shows with radiance 1."""
MASK_SAMPLES = 16


def main(folder: Path) -> None:
    """Draw the scene ``images`` times, the part moved a little each time as in a data set, then its mask."""
    started = time.perf_counter()
    content = json.loads((folder / "scene.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _settings(scene, content)
    _camera(scene, content["camera"])
    _light(scene, folder, content)
    objects = {geom["name"]: _geom(scene, folder, geom) for geom in content["geoms"]}
    target = objects[content["part"]]
    place = target.matrix_world.copy()
    prepared_s = time.perf_counter() - started
    wall, cpu = [], []
    for k in range(content["images"], -1, -1):
        target.matrix_world = Matrix.Translation((1e-5 * k, 0.0, 0.0)) @ place
        before = time.perf_counter(), time.process_time()
        _render(scene, folder / "cycles.png")
        wall.append(time.perf_counter() - before[0])
        cpu.append(time.process_time() - before[1])
    _mask(scene, target, folder / "mask.png")
    times = {"version": bpy.app.version_string, "prepared_s": prepared_s, "first_s": wall[0]}
    (folder / "times.json").write_text(json.dumps(times | {"wall_s": wall[1:], "cpu_s": cpu[1:]}))


def _settings(scene: bpy.types.Scene, content: dict) -> None:
    """Linear grey levels, a box filter, no denoising, the same samples for every pixel, meshes kept between images."""
    render, cycles = scene.render, scene.cycles
    render.engine, cycles.device = "CYCLES", "CPU"
    render.threads_mode, render.threads = "FIXED", content["threads"]
    render.use_persistent_data = True
    cycles.samples, cycles.max_bounces = content["samples"], content["bounces"]
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    scene.view_settings.view_transform = "Raw"
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    render.image_settings.compression = 15


def _camera(scene: bpy.types.Scene, camera: dict) -> None:
    width, height = camera["width"], camera["height"]
    scene.render.resolution_x, scene.render.resolution_y = width, height
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = camera["f"] * 36.0 / width
    lens.shift_x = ((width - 1) / 2 - camera["cx"]) / width
    lens.shift_y = (camera["cy"] - (height - 1) / 2) / width
    lens.clip_start, lens.clip_end = 0.01, 10.0
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)
    scene.camera.matrix_world = Matrix(camera["T_world_cam"]) @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))


def _light(scene: bpy.types.Scene, folder: Path, content: dict) -> None:
    """Lamps, in an even surround or in a panorama whose middle column looks along -x."""
    for lamp in content["lamps"]:
        strength = max(lamp["rgb"])
        light = bpy.data.lights.new(lamp["name"], "SUN" if lamp["kind"] == "directional" else "POINT")
        light.energy = strength * (SUN_OF_WHITE if light.type == "SUN" else BULB_OF_WHITE)
        light.color = [c / strength for c in lamp["rgb"]]
        if light.type == "POINT":
            light.shadow_soft_size = lamp["radius_m"]
        placed = bpy.data.objects.new(lamp["name"], light)
        scene.collection.objects.link(placed)
        placed.location = lamp["position"]
        placed.rotation_mode = "QUATERNION"
        placed.rotation_quaternion = Vector(lamp["direction"]).to_track_quat("-Z", "Y")
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background = nodes["Background"]
    background.inputs["Color"].default_value = (*content["ambient"], 1.0)
    if content["environment"]:
        around = nodes.new("ShaderNodeTexEnvironment")
        around.image = _image(folder / content["environment"])
        links.new(around.outputs["Color"], background.inputs["Color"])


def _geom(scene: bpy.types.Scene, folder: Path, geom: dict) -> bpy.types.Object:
    arrays = np.load(folder / geom["mesh"])
    mesh = bpy.data.meshes.new(geom["name"])
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.normals_split_custom_set_from_vertices(arrays["normals"].tolist())
    if "texcoords" in arrays:
        corners = arrays["texcoords"][arrays["faces"].ravel()] * geom["repeat"]
        corners[:, 1] = 1 - corners[:, 1]
        mesh.uv_layers.new().data.foreach_set("uv", corners.astype(np.float32).ravel())
    mesh.materials.append(_material(folder, geom))
    placed = bpy.data.objects.new(geom["name"], mesh)
    scene.collection.objects.link(placed)
    placed.matrix_world = Matrix(geom["T_world_geom"])
    return placed


def _material(folder: Path, geom: dict) -> bpy.types.Material:
    material = bpy.data.materials.new(geom["name"])
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (*geom["rgb"], 1.0)
    surface.inputs["Metallic"].default_value = geom["metallic"]
    surface.inputs["Roughness"].default_value = geom["roughness"]
    if geom["texture"]:
        image, tint = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeMix")
        image.image = _image(folder / geom["texture"])
        tint.data_type, tint.blend_type = "RGBA", "MULTIPLY"
        tint.inputs["Factor"].default_value = 1.0
        tint.inputs["B"].default_value = (*geom["rgb"], 1.0)
        links.new(image.outputs["Color"], tint.inputs["A"])
        links.new(tint.outputs["Result"], surface.inputs["Base Color"])
    return material


def _image(path: Path) -> bpy.types.Image:
    """Linear colours (H, W, 3), top row first."""
    colours = np.load(path)["colours"]
    height, width, _ = colours.shape
    image = bpy.data.images.new(path.stem, width, height, alpha=False, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = colours[::-1]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image


def _mask(scene: bpy.types.Scene, target: bpy.types.Object, path: Path) -> None:
    """The part white, all else black; a pixel is half white where the outline halves it."""
    black, white = (_glow(f"mask_{level}", level) for level in (0.0, 1.0))
    for placed in scene.objects:
        if placed.type == "MESH":
            placed.data.materials.clear()
            placed.data.materials.append(white if placed == target else black)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    scene.cycles.samples = MASK_SAMPLES
    scene.cycles.max_bounces = 0
    _render(scene, path)


def _glow(name: str, level: float) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (level, level, level, 1.0)
    links.new(emission.outputs["Emission"], nodes["Material Output"].inputs["Surface"])
    return material


def _render(scene: bpy.types.Scene, path: Path) -> None:
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
