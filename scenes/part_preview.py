"""A contact sheet of a part: every stable pose straight from above (upper row) and from a slant (lower row)."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import Part, StablePose, load_part, part_names
from cad.spatial import Array, Intrinsics, quat_wxyz_from_rotation, transform
from scenes.camera import add_camera, set_camera_pose
from scenes.classic import ClassicRenderer
from scenes.gl import mujoco
from scenes.look import add_material, add_mesh, add_part_material, add_visual

TILE_PX = 200
_DISTANCE_M = 0.10
_SLANT = np.array([0.55, -0.62, 0.56])  # from the table to the camera
_MARGIN = 1.15


def contact_sheet(part: Part) -> NDArray[np.uint8]:
    """RGB picture (2 * TILE_PX, poses * TILE_PX, 3) of a part in its stable poses, most probable first."""
    focal = TILE_PX * _DISTANCE_M / (_MARGIN * part.diameter_m)
    centre = (TILE_PX - 1) / 2
    intrinsics = Intrinsics(width=TILE_PX, height=TILE_PX, fx=focal, fy=focal, cx=centre, cy=centre)
    columns = [_pose_views(part, pose, intrinsics) for pose in part.stable_poses]
    return np.hstack([np.vstack(views) for views in columns])


def labelled_sheet(part: Part) -> NDArray[np.uint8]:
    """The contact sheet with the number and the probability of each pose written into its column."""
    sheet = contact_sheet(part)
    for k, pose in enumerate(part.stable_poses):
        text = f"{pose.index}: {pose.probability:.3f}{' any roll' if pose.roll is not None else ''}"
        at = (k * TILE_PX + 6, 2 * TILE_PX - 8)
        cv2.putText(sheet, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20), 1, cv2.LINE_AA)
    return sheet


def write_preview(part: Part) -> Path:
    """Write ``preview.png`` into the part's folder and return its path."""
    path = part.folder / "preview.png"
    cv2.imwrite(str(path), labelled_sheet(part)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return path


def look_at(target: Array, direction: Array, distance: float) -> Array:
    """``T_world_cam`` (4, 4) of a camera ``distance`` metres from ``target`` (3,) along the unit ``direction`` (3,).

    The image's right is horizontal; straight above the target it is the world's x.
    """
    forward = -direction
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    return transform(np.column_stack([right, np.cross(forward, right), forward]), target + distance * direction)


def _pose_views(part: Part, pose: StablePose, intrinsics: Intrinsics) -> list[NDArray[np.uint8]]:
    spec = mujoco.MjSpec()
    spec.stat.extent, spec.visual.map.znear, spec.visual.map.zfar = 1.0, 0.02, 10.0
    spec.visual.quality.shadowsize = 2048
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.3] * 3, [0.0] * 3
    spec.visual.headlight.specular = [0.0] * 3
    add_material(spec, "table", (0.62, 0.68, 0.72, 1.0), specular=0.0, shininess=0.0)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE.value, size=[0.1, 0.1, 0.01], material="table")
    for x, y, brightness, shadow in ((0.12, -0.16, 0.5, True), (-0.2, 0.05, 0.25, False)):
        lamp = spec.worldbody.add_light(pos=[x, y, 0.3], dir=[-x, -y, -0.3], diffuse=[brightness] * 3)
        lamp.type, lamp.castshadow, lamp.cutoff = mujoco.mjtLightType.mjLIGHT_SPOT.value, shadow, 4.0
        lamp.exponent, lamp.specular = 0.0, [0.2] * 3
    T = pose.T_table_part
    body = spec.worldbody.add_body(name="part", pos=T[:3, 3], quat=quat_wxyz_from_rotation(T[:3, :3]))
    add_mesh(spec, "part", part.mesh)
    add_part_material(spec, "part", part)
    add_visual(body, "part", "part", material="part")
    height = float((part.mesh.vertices @ T[2, :3]).max() + T[2, 3])
    middle = np.array([0.0, 0.0, height / 2])
    slant = _SLANT / np.linalg.norm(_SLANT)
    views = [look_at(middle, np.array([0.0, 0.0, 1.0]), _DISTANCE_M), look_at(middle, slant, _DISTANCE_M)]
    add_camera(spec.worldbody, intrinsics, views[0])
    model = spec.compile()
    data = mujoco.MjData(model)
    pictures = []
    with ClassicRenderer(model, max_width=TILE_PX, max_height=TILE_PX) as renderer:
        for T_world_cam in views:
            mujoco.mj_forward(model, data)
            set_camera_pose(model, data, T_world_cam)
            rgb = renderer.render(data, intrinsics, ("rgb",)).rgb
            assert rgb is not None
            pictures.append(rgb.copy())
    return pictures


def main() -> None:
    """Draw the parts named on the command line (default: all)."""
    for name in sys.argv[1:] or part_names():
        print(write_preview(load_part(name)))


if __name__ == "__main__":
    main()
