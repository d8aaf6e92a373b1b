"""From voted keypoints to the published baseline's two poses: raw, by EPnP, and refined onto the table.

The refinement is that of the paper this project starts from: the orientation is snapped to the nearest stable pose and
the distance is replaced by the calibrated one of camera and table. Neither looks at the picture again.
"""

from __future__ import annotations

from dataclasses import dataclass

from cad.parts import Part
from cad.resting import as_rest, nearest_rest
from cad.spatial import Array, Intrinsics, inverse, rotation_z, transform, yaw_of
from perception.planar import on_plane
from perception.pnp import solve_pnp
from perception.posenets import CropKeypoints


@dataclass(frozen=True, kw_only=True)
class BaselinePose:
    """``raw_T_cam_part`` and ``T_cam_part`` (4, 4), the stable pose that the latter rests in, its lean before in rad,
    and the RMS reprojection error of the keypoints in pixels.
    """

    raw_T_cam_part: Array
    T_cam_part: Array
    stable_pose: int
    lean: float
    rms_px: float


def pose_from_keypoints(
    part: Part, keypoints: CropKeypoints, intrinsics: Intrinsics, T_cam_table: Array
) -> BaselinePose:
    """Raw and refined pose from keypoints in pixels of the camera with these ``intrinsics``.

    Raises PnpError when the keypoints give no pose, or none in front of the camera.
    """
    solved = solve_pnp(part.keypoints, keypoints.pixels, keypoints.covariances, intrinsics)
    T_cam_part, stable_pose, lean = refine_to_rest(solved.T_cam_part, part, intrinsics, T_cam_table)
    return BaselinePose(
        raw_T_cam_part=solved.T_cam_part,
        T_cam_part=T_cam_part,
        stable_pose=stable_pose,
        lean=lean,
        rms_px=solved.rms_px,
    )


def refine_to_rest(
    raw_T_cam_part: Array, part: Part, intrinsics: Intrinsics, T_cam_table: Array
) -> tuple[Array, int, float]:
    """``T_cam_part`` at rest on the table, its stable pose, and the angle in rad by which the raw pose leans from it.

    The part's origin stays on its ray through the camera and moves along it to the height that it has in the stable
    pose; the orientation becomes that of the stable pose at the yaw that is nearest.
    """
    T_table_part = inverse(T_cam_table) @ raw_T_cam_part
    pose, lean = nearest_rest(part, T_table_part[:3, :3])
    T_table_part = as_rest(part, pose, T_table_part)
    yaw = yaw_of(T_table_part[:3, :3] @ pose.R_table_part.T)
    pixel = intrinsics.project((T_cam_table @ T_table_part)[:3, 3])
    origin = on_plane(pixel, pose.height_m, intrinsics, T_cam_table)
    return T_cam_table @ transform(rotation_z(yaw) @ pose.R_table_part, origin), pose.index, lean
