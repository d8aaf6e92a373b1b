"""``tagcell view``: pictures of the cell from the side and of what its camera sees."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cad.parts import part_names
from cad.robot import JOINT_NAMES
from cad.spatial import Array, rotation_x, transform
from scenes.gl import make_context, mujoco
from scenes.placement import settle_parts
from scenes.render import VISUAL_GROUPS, ClassicRenderer
from scenes.workcell import CellConfig, build_arm, build_workcell, set_parts
from twin.ik import ArmIk
from twin.pictures import save_picture

SIDE_SIZE = (1600, 1000)
LOOK_AT, DISTANCE_M, AZIMUTH_DEG, ELEVATION_DEG = (0.38, 0.06, 0.28), 1.55, 152.0, -18.0
FRAME_WIDTH = 1368


def save_views(out: Path, *, seed: int, parts_per_class: int = 2) -> list[Path]:
    """Drop parts from ``seed``, hold the hand above the board and save cell.jpg, camera.jpg in ``out``."""
    cell = CellConfig()
    instances = [name for name in part_names() for _ in range(parts_per_class)]
    T_world_part = settle_parts(cell, instances, np.random.default_rng(seed))
    spec = build_workcell(cell, instances)
    _light_the_room(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    set_parts(model, data, T_world_part)
    _set_arm(data, np.array(cell.home_q))
    mujoco.mj_forward(model, data)
    with ClassicRenderer(model, max_width=cell.intrinsics.width, max_height=cell.intrinsics.height) as renderer:
        rgb = renderer.render(data, cell.intrinsics, ("rgb",)).rgb
    assert rgb is not None
    height = FRAME_WIDTH * cell.intrinsics.height // cell.intrinsics.width
    frame = np.asarray(cv2.resize(rgb, (FRAME_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
    hover = transform(rotation_x(np.pi), [*T_world_part[0, :2, 3], cell.T_world_board[2, 3] + 0.06])
    _set_arm(data, ArmIk(build_arm(cell).compile(), np.array(cell.home_q)).solve(hover))
    mujoco.mj_forward(model, data)
    written = [out / "cell.jpg", out / "camera.jpg"]
    save_picture(written[0], _side_view(model, data))
    save_picture(written[1], frame)
    return written


def _light_the_room(spec: mujoco.MjSpec) -> None:
    """Soft light from the side and a bright backdrop: the cell's own lamps shine on the board only."""
    spec.add_texture(
        name="backdrop",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.66, 0.70, 0.75],
        width=256,
        height=256,
    )
    for pos, strength in (([1.2, -1.2, 1.6], 0.55), ([-0.8, 1.4, 1.2], 0.3)):
        direction = np.array([0.35, 0.0, 0.2]) - pos
        light = spec.worldbody.add_light(pos=pos, dir=direction / np.linalg.norm(direction))
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.castshadow = False
        light.diffuse = [strength] * 3
        light.specular = [0.3 * strength] * 3


def _set_arm(data: mujoco.MjData, q: Array) -> None:
    for name, value in zip(JOINT_NAMES, q, strict=True):
        data.joint(name).qpos[0] = value


def _side_view(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    model.vis.global_.offwidth, model.vis.global_.offheight = SIDE_SIZE
    option = mujoco.MjvOption()
    option.geomgroup[:] = [group in VISUAL_GROUPS for group in range(6)]
    option.sitegroup[:] = False
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance = LOOK_AT, DISTANCE_M
    camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
    gl = make_context(*SIDE_SIZE)
    gl.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nlight + 64)
    rgb = np.empty((SIDE_SIZE[1], SIDE_SIZE[0], 3), np.uint8)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
        rect = mujoco.MjrRect(0, 0, *SIDE_SIZE)
        mujoco.mjr_render(rect, scene, context)
        mujoco.mjr_readPixels(rgb, None, rect, context)
    finally:
        context.free()
        gl.free()
    return np.ascontiguousarray(rgb[::-1])
