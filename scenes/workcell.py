"""The whole cell as one MuJoCo spec: table, tagboard, tray, camera on its stand, arm, hand and the parts of a scene."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from cad.collision import contact_pieces
from cad.parts import LIBRARY, Part, load_mesh, load_part
from cad.spatial import Array, Intrinsics, quat_wxyz_from_rotation, transform
from cad.station import COLLISION, TABLE_THICKNESS_M, TABLE_X_M, TABLE_Y_M
from scenes.arm import add_arm
from scenes.camera import add_camera
from scenes.cell_config import CellConfig, TrayConfig
from scenes.contacts import BOX, PART, PLANE, ROBOT, Touches, add_primitive, make_collision, set_options
from scenes.free_part import add_piece, set_mass_properties
from scenes.gl import mujoco
from scenes.look import add_board_visuals, add_material, add_mesh, add_part_material, add_visual, classic_finish
from scenes.randomize import DEFAULT_AMBIENT, DEFAULT_LAMPS

__all__ = ["CellConfig", "TrayConfig", "build_arm", "build_board_scene", "build_workcell", "part_body", "set_parts"]

OVERVIEW = "overview"
"""Camera that sees the whole cell from the side."""
OVERVIEW_INTRINSICS = Intrinsics(width=1600, height=1200, fx=1500.0, fy=1500.0, cx=799.5, cy=599.5)
SHADOWLESS = ("table", "stand", "camera_body")
"""Bodies whose shadows would miss the board and be cut off at the edge of the shadow map."""
SHADOW_SIZE = 4096
SHADOW_HALF_M = 0.22
"""The shadow map covers this far from the board's centre: 0.11 mm a texel, finer than two camera pixels."""


def build_workcell(config: CellConfig, part_names: Sequence[str]) -> mujoco.MjSpec:
    """The cell with one free body for each name in ``part_names``; instance i is body ``part_0i``.

    The arm's joints come first in ``qpos``, then the fingers', then the parts'. Raises PartError for a name that is not
    a part. Parts start stowed beside the table; see :func:`set_parts`.
    """
    spec = _start(config)
    _add_station(spec, config)
    _add_robot(spec, config)
    _add_cell_visuals(spec, config)
    _add_overview(spec)
    _add_parts(spec, config, part_names)
    return spec


def build_board_scene(config: CellConfig, part_names: Sequence[str]) -> mujoco.MjSpec:
    """Board, camera, lights and parts without table and robot: what settling parts and looking at them needs."""
    spec = _start(config)
    _add_parts(spec, config, part_names)
    return spec


def build_arm(config: CellConfig) -> mujoco.MjSpec:
    """Arm and hand alone, without visuals, for inverse kinematics and controllers."""
    spec = mujoco.MjSpec()
    spec.modelname = "arm"
    set_options(spec, config.timestep_s)
    _add_robot(spec, config)
    return spec


def _start(config: CellConfig) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = "cell"
    set_options(spec, config.timestep_s)
    set_visuals(spec)
    board = _add_board(spec, config)
    add_camera(board, config.intrinsics, config.T_board_cam)
    _add_lights(board)
    return spec


def _add_parts(spec: mujoco.MjSpec, config: CellConfig, part_names: Sequence[str]) -> None:
    parts = {name: load_part(name, config.parts_dir) for name in dict.fromkeys(part_names)}
    for part in parts.values():
        add_mesh(spec, f"{part.name}_visual", part.mesh)
        add_part_material(spec, part.name, part)
        for k, hull in enumerate(contact_pieces(part, "grasp")):
            add_piece(spec, f"{part.name}_hull_{k:02d}", hull)
    for i, name in enumerate(part_names):
        _add_part(spec, i, parts[name])


def set_visuals(spec: mujoco.MjSpec) -> None:
    """Clipping planes in metres and the quality of shadows."""
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 10.0
    spec.visual.quality.shadowsize, spec.visual.map.shadowclip = SHADOW_SIZE, SHADOW_HALF_M
    spec.visual.headlight.ambient = [DEFAULT_AMBIENT] * 3
    spec.visual.headlight.diffuse = [0.0] * 3
    spec.visual.headlight.specular = [0.0] * 3


def part_body(index: int) -> str:
    """Name of the body, and of its free joint, of part instance ``index``."""
    return f"part_{index:02d}"


def set_parts(model: mujoco.MjModel, data: mujoco.MjData, T_world_part: Array) -> None:
    """Put the part instances of a compiled cell at ``T_world_part`` (N, 4, 4), at rest, and forward the kinematics."""
    for i, T in enumerate(T_world_part):
        joint = model.joint(part_body(i))
        q, v = joint.qposadr[0], joint.dofadr[0]
        data.qpos[q : q + 3] = T[:3, 3]
        data.qpos[q + 3 : q + 7] = quat_wxyz_from_rotation(T[:3, :3])
        data.qvel[v : v + 6] = 0.0
    mujoco.mj_forward(model, data)


def _add_board(spec: mujoco.MjSpec, config: CellConfig) -> mujoco.MjsBody:
    board, T = config.tagboard, config.T_world_board
    body = spec.worldbody.add_body(name="board", pos=T[:3, 3], quat=quat_wxyz_from_rotation(T[:3, :3]))
    half = [board.width_m / 2, board.height_m / 2, board.thickness_m / 2]
    geom = body.add_geom(name="board", type=BOX, size=half, pos=[0.0, 0.0, -half[2]])
    make_collision(geom, Touches.PLATE, ROBOT)
    level = spec.worldbody.add_geom(name="board_level", type=PLANE, size=half, pos=body.pos, quat=body.quat)
    make_collision(level, Touches.LEVEL, PART)
    add_board_visuals(spec, body, board)
    return body


def _add_lights(board: mujoco.MjsBody) -> None:
    """The cell's two lamps; shadows are computed round the board's centre."""
    for i, lamp in enumerate(DEFAULT_LAMPS):
        towards = np.array(lamp.towards) / np.linalg.norm(lamp.towards)
        board.add_light(
            name=f"lamp_{i}",
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=towards,
            dir=-towards,
            diffuse=lamp.rgb,
            specular=[lamp.specular] * 3,
            ambient=[0.0] * 3,
            castshadow=lamp.shadow,
        )


def _add_overview(spec: mujoco.MjSpec) -> None:
    """A camera and a backdrop for pictures of the whole cell."""
    eye, target = np.array([1.45, 1.15, 0.95]), np.array([0.30, 0.05, 0.28])
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(z, [0.0, 0.0, 1.0]))
    T_world_cam = transform(np.stack([x, np.cross(z, x), z], axis=1), eye)
    add_camera(spec.worldbody, OVERVIEW_INTRINSICS, T_world_cam, OVERVIEW)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.85, 0.88, 0.92],
        rgb2=[0.45, 0.48, 0.52],
        width=256,
        height=256,
    )


def _add_part(spec: mujoco.MjSpec, index: int, part: Part) -> None:
    """A free body: mass and inertia of the part's mesh, convex pieces for contact, the mesh to look at."""
    name = part_body(index)
    body = spec.worldbody.add_body(name=name, pos=[-0.3 - 0.02 * index, -0.5, 0.02])
    body.add_freejoint(name=name)
    set_mass_properties(body, part.mesh, part.mass_kg)
    add_visual(body, f"{name}_visual", f"{part.name}_visual", material=part.name)
    for k in range(len(contact_pieces(part, "grasp"))):
        geom = body.add_geom(
            name=f"{name}_hull_{k:02d}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{part.name}_hull_{k:02d}"
        )
        make_collision(geom, Touches.PART, PART)


def _add_station(spec: mujoco.MjSpec, config: CellConfig) -> None:
    """Table, tray, stand and camera housing, with the collision solids of ``cad.station``."""
    x, y = TABLE_X_M, TABLE_Y_M
    half = [(x[1] - x[0]) / 2, (y[1] - y[0]) / 2, TABLE_THICKNESS_M / 2]
    geom = spec.worldbody.add_geom(name="table", type=BOX, size=half, pos=[sum(x) / 2, sum(y) / 2, -half[2]])
    make_collision(geom, Touches.CELL, PART)
    frames = {"tray": config.T_world_tray, "stand": config.T_world_stand, "camera_body": config.T_world_cam}
    for name, T in frames.items():
        body = spec.worldbody.add_body(name=name, pos=T[:3, 3], quat=quat_wxyz_from_rotation(T[:3, :3]))
        for solid in COLLISION:
            if solid.body == name:
                add_primitive(body, solid, Touches.CELL, PART)


def _add_robot(spec: mujoco.MjSpec, config: CellConfig) -> None:
    add_arm(spec, config.arm, timestep_s=config.timestep_s, grip_force_n=config.grip_force_n)


def _add_cell_visuals(spec: mujoco.MjSpec, config: CellConfig) -> None:
    """Every drawn mesh of the cell's library on the body that it belongs to, and an outline round every nest."""
    folder = LIBRARY / "cell"
    index = json.loads((folder / "meshes.json").read_text())
    nest = index["markers"]["nest"]
    for entry in [*index["meshes"], nest]:
        name = f"cell_{entry['file'].removesuffix('.stl')}"
        add_mesh(spec, name, load_mesh(folder / entry["file"]))
        specular, shininess = classic_finish(entry["metallic"], entry["roughness"])
        add_material(spec, name, tuple(entry["rgba"]), specular=specular, shininess=shininess)
        if entry is not nest:
            body = spec.worldbody if entry["body"] == "table" else spec.body(entry["body"])
            drawn = add_visual(body, name, name, material=name)
            drawn.castshadow = entry["body"] not in SHADOWLESS
    outline = f"cell_{nest['file'].removesuffix('.stl')}"
    for part in config.tray.classes:
        for k, T_tray_nest in enumerate(config.tray.nests(part)):
            add_visual(spec.body("tray"), f"nest_{part}_{k}", outline, T_tray_nest, material=outline)
