"""``tagcell view``: pictures of the cell from the side and of what its camera sees."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cad.parts import BUILT_IN
from cad.robot import JOINT_NAMES
from cad.spatial import Array, rotation_x, transform
from perception.overlay import save_picture
from scenes.classic import ClassicRenderer
from scenes.gl import mujoco
from scenes.placement import settle_parts
from scenes.workcell import OVERVIEW, OVERVIEW_INTRINSICS, CellConfig, build_arm, build_workcell, set_parts
from twin.ik import ArmIk
from twin.robot import TwinError

FRAME_WIDTH = 1368
ROOM = "room_"


def save_views(out: Path, *, seed: int, parts_per_class: int = 2) -> list[Path]:
    """Drop parts from ``seed``, hold the hand above the board and save cell.jpg, camera.jpg in ``out``.

    Raises TwinError for a negative seed.
    """
    if seed < 0:
        raise TwinError(f"seed is {seed}; it must not be negative")
    cell = CellConfig()
    instances = [name for name in BUILT_IN for _ in range(parts_per_class)]
    T_world_part = settle_parts(cell, instances, np.random.default_rng(seed))
    spec = build_workcell(cell, instances)
    _light_the_room(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    set_parts(model, data, T_world_part)
    _set_arm(data, np.array(cell.home_q))
    mujoco.mj_forward(model, data)
    renderer = ClassicRenderer(model, max_width=cell.intrinsics.width, max_height=cell.intrinsics.height)
    room = [i for i in range(model.nlight) if model.light(i).name.startswith(ROOM)]
    with renderer:
        model.light_active[room] = False  # the camera's frame is lit by the cell's lamps alone
        frame = renderer.render(data, cell.intrinsics, ("rgb",)).picture
        hover = transform(rotation_x(np.pi), [*T_world_part[0, :2, 3], cell.T_world_board[2, 3] + 0.06])
        _set_arm(data, ArmIk(build_arm(cell).compile(), np.array(cell.home_q)).solve(hover))
        mujoco.mj_forward(model, data)
        model.light_active[room] = True
        side = renderer.render(data, OVERVIEW_INTRINSICS, ("rgb",), OVERVIEW).picture
    assert frame is not None and side is not None
    height = FRAME_WIDTH * cell.intrinsics.height // cell.intrinsics.width
    small = np.asarray(cv2.resize(frame, (FRAME_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
    written = [out / "cell.jpg", out / "camera.jpg"]
    save_picture(written[0], side)
    save_picture(written[1], small)
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
    for pos, strength in (([1.2, -1.2, 1.6], 0.38), ([-0.8, 1.4, 1.2], 0.22)):
        direction = np.array([0.35, 0.0, 0.2]) - pos
        light = spec.worldbody.add_light(name=f"{ROOM}{strength}", pos=pos, dir=direction / np.linalg.norm(direction))
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.castshadow = False
        light.diffuse = [strength] * 3
        light.specular = [0.3 * strength] * 3


def _set_arm(data: mujoco.MjData, q: Array) -> None:
    for name, value in zip(JOINT_NAMES, q, strict=True):
        data.joint(name).qpos[0] = value
