"""The camera in MuJoCo: any pinhole intrinsics, and so any crop window, set on a compiled model at run time.

MuJoCo describes a camera by a sensor size, a focal length and a principal point in metres. With integer pixel centres
and v down, a window of width w whose principal point is at ``cx`` has ``principal = (w - 1) / 2 - cx`` pixels, for
both axes; there is no further half pixel.
"""

from __future__ import annotations

from cad.spatial import BASLER_PIXEL_M, CAM_FROM_CAMGL, Array, Intrinsics, quat_wxyz_from_rotation, transform
from scenes.gl import mujoco

CAMERA = "camera"


def add_camera(body: mujoco.MjsBody, intrinsics: Intrinsics, T_body_cam: Array, name: str = CAMERA) -> None:
    """Add a camera with the given intrinsics at ``T_body_cam`` (4, 4, OpenCV's camera axes) to a body of a spec."""
    T_body_camgl = T_body_cam @ CAM_FROM_CAMGL
    width, height = intrinsics.width, intrinsics.height
    body.add_camera(
        name=name,
        pos=T_body_camgl[:3, 3],
        quat=quat_wxyz_from_rotation(T_body_camgl[:3, :3]),
        resolution=[width, height],
        sensor_size=[width * BASLER_PIXEL_M, height * BASLER_PIXEL_M],
        focal_length=[intrinsics.fx * BASLER_PIXEL_M, intrinsics.fy * BASLER_PIXEL_M],
        principal_length=_principal_m(intrinsics),
    )


def set_intrinsics(model: mujoco.MjModel, intrinsics: Intrinsics, name: str = CAMERA) -> None:
    """Give a compiled camera these intrinsics: a crop window, a reduced frame or the whole one."""
    i = model.camera(name).id
    width, height = intrinsics.width, intrinsics.height
    model.cam_resolution[i] = [width, height]
    model.cam_sensorsize[i] = [width * BASLER_PIXEL_M, height * BASLER_PIXEL_M]
    focal_m = [intrinsics.fx * BASLER_PIXEL_M, intrinsics.fy * BASLER_PIXEL_M]
    model.cam_intrinsic[i] = [*focal_m, *_principal_m(intrinsics)]


def set_camera_pose(model: mujoco.MjModel, data: mujoco.MjData, T_body_cam: Array, name: str = CAMERA) -> None:
    """Move a compiled camera to ``T_body_cam`` (4, 4, OpenCV's camera axes) on its body, whose pose must be known.

    The pose in ``data`` is set as well: where bodies may sleep MuJoCo computes it once for a body that never moves.
    """
    i = model.camera(name).id
    T_body_camgl = T_body_cam @ CAM_FROM_CAMGL
    model.cam_pos[i] = T_body_camgl[:3, 3]
    mujoco.mju_mat2Quat(model.cam_quat[i], T_body_camgl[:3, :3].ravel())
    body = model.cam_bodyid[i]
    T_world_camgl = transform(data.xmat[body].reshape(3, 3), data.xpos[body]) @ T_body_camgl
    data.cam_xpos[i], data.cam_xmat[i] = T_world_camgl[:3, 3], T_world_camgl[:3, :3].ravel()


def camera_pose(model: mujoco.MjModel, data: mujoco.MjData, name: str = CAMERA) -> Array:
    """``T_world_cam`` (4, 4) of a camera, OpenCV's axes, as last computed by forward kinematics."""
    i = model.camera(name).id
    return transform(data.cam_xmat[i].reshape(3, 3), data.cam_xpos[i]) @ CAM_FROM_CAMGL


def _principal_m(intrinsics: Intrinsics) -> list[float]:
    return [
        ((intrinsics.width - 1) / 2 - intrinsics.cx) * BASLER_PIXEL_M,
        ((intrinsics.height - 1) / 2 - intrinsics.cy) * BASLER_PIXEL_M,
    ]
