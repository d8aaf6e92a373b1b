"""What is known of the parts in a photograph, as the JSON that ``tagcell estimate`` writes.

Transforms ``T_a_b`` are lists of rows, metres, mapping points in b to a; ``cam`` looks along +z with +y down in the
picture, ``board`` has its origin in the middle of the tagboard and z up. Other quantities carry their unit in the name.
Pixels are those of the photograph as it was taken, distortion included, with integer centres.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from cad.parts import Part
from cad.spatial import Array, Intrinsics, inverse, rotation_angle, yaw_of
from perception.calibration_file import CellCalibration
from perception.estimates import FrameEstimate, PartEstimate
from perception.photo import LensCorrection

FORMAT, VERSION = "tagcell-estimate", 1
OUTLINE_TOLERANCE_PX = 0.7
"""Outlines are polygons that stray from the silhouette's border pixels by at most this."""


def photo_result(
    estimate: FrameEstimate, parts: Mapping[str, Part], calibration: CellCalibration, lens: LensCorrection
) -> dict[str, Any]:
    """All that was estimated in one photograph; ``parts`` by name."""
    T_board_cam = inverse(estimate.T_cam_board)
    result: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "width_px": lens.camera.width,
        "height_px": lens.camera.height,
        "intrinsics": _intrinsics(lens.camera),
        "distortion": list(lens.distortion),
        "undistorted_intrinsics": _intrinsics(lens.pinhole),
        "T_cam_board": estimate.T_cam_board.tolist(),
        "tags_seen": estimate.tags_seen,
        "tag_rms_px": estimate.tag_rms_px,
    }
    if calibration.T_board_cam is not None:
        result["moved_since_calibration"] = {
            "distance_mm": 1e3 * float(np.linalg.norm(T_board_cam[:3, 3] - calibration.T_board_cam[:3, 3])),
            "angle_deg": float(np.degrees(rotation_angle(T_board_cam[:3, :3], calibration.T_board_cam[:3, :3]))),
        }
    result["parts"] = [_part(p, parts[p.part], T_board_cam, calibration.T_base_board, lens) for p in estimate.parts]
    result["seconds"] = {name: round(value, 4) for name, value in estimate.seconds.items()}
    return result


def _part(
    estimate: PartEstimate, part: Part, T_board_cam: Array, T_base_board: Array | None, lens: LensCorrection
) -> dict[str, Any]:
    T_board_part = T_board_cam @ estimate.T_cam_part
    R = T_board_cam[:3, :3]
    rest = part.stable_poses[estimate.stable_pose].T_table_part[:3, :3]
    turn = np.kron(np.eye(2), R)
    sigma = np.sqrt(np.maximum(np.diag(turn @ estimate.covariance @ turn.T), 0.0))  # board: x, y, z, about x, y, z
    return {
        "part": estimate.part,
        "obj_id": part.obj_id,
        "stable_pose": estimate.stable_pose,
        "accepted": estimate.accepted,
        "verdict": estimate.verdict,
        "score": estimate.score,
        "x_board_mm": 1e3 * float(T_board_part[0, 3]),
        "y_board_mm": 1e3 * float(T_board_part[1, 3]),
        "z_board_mm": 1e3 * float(T_board_part[2, 3]),
        "yaw_board_deg": float(np.degrees(yaw_of(T_board_part[:3, :3] @ rest.T))),
        "sigma": {
            "x_board_mm": 1e3 * float(sigma[0]),
            "y_board_mm": 1e3 * float(sigma[1]),
            "z_board_mm": 1e3 * float(sigma[2]),
            "lean_x_deg": float(np.degrees(sigma[3])),
            "lean_y_deg": float(np.degrees(sigma[4])),
            "yaw_deg": float(np.degrees(sigma[5])),
        },
        "T_cam_part": estimate.T_cam_part.tolist(),
        "T_board_part": T_board_part.tolist(),
        **({} if T_base_board is None else {"T_base_part": (T_base_board @ T_board_part).tolist()}),
        "covariance_cam_m_rad": estimate.covariance.tolist(),
        "alternatives": [
            {
                "part": other.part,
                "stable_pose": other.stable_pose,
                "probability": other.probability,
                "T_cam_part": other.T_cam_part.tolist(),
            }
            for other in estimate.alternatives
        ],
        **_where(estimate, lens),
    }


def _where(estimate: PartEstimate, lens: LensCorrection) -> dict[str, Any]:
    """Origin, bounding box and outline in the photograph; the latter two only where something of the part shows."""
    origin = lens.in_photo(lens.pinhole.project(estimate.T_cam_part[None, :3, 3]))[0]
    found: dict[str, Any] = {"origin_px": _rounded(origin)}
    if estimate.mask is None or not estimate.mask.any():
        return found
    contours, _ = cv2.findContours(
        estimate.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=estimate.mask_origin
    )
    largest = max(contours, key=len)
    polygon = np.asarray(cv2.approxPolyDP(largest, OUTLINE_TOLERANCE_PX, True), np.float64).reshape(-1, 2)
    outline = lens.in_photo(polygon)
    low, high = outline.min(axis=0), outline.max(axis=0)
    return found | {
        "box_px": {"u": float(low[0].round(1)), "v": float(low[1].round(1))}
        | {"width": float((high - low)[0].round(1) + 1), "height": float((high - low)[1].round(1) + 1)},
        "outline_px": [_rounded(point) for point in outline],
    }


def _rounded(pixel: Array) -> list[float]:
    return [round(float(value), 2) for value in pixel]


def _intrinsics(k: Intrinsics) -> dict[str, float]:
    return {
        "width_px": k.width,
        "height_px": k.height,
        "fx_px": k.fx,
        "fy_px": k.fy,
        "cx_px": k.cx,
        "cy_px": k.cy,
    }
