"""Where the camera is, read from the AprilTags in the frame itself.

Tags are found in a reduced image (they are hundreds of pixels wide), their corners refined at full resolution, and the
pose solved from all corners at once: a planar start (IPPE, Collins and Bartoli 2014) and Levenberg-Marquardt on the
reprojection error. Pixel centres are integers throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics, apply, transform
from cad.tagboard import DICTIONARY, TagboardConfig
from perception.estimates import Frame, PerceptionError

MIN_TAGS = 4
"""Fewer tags give a board tilt that is too weak to put parts on a plane."""
MAX_ERROR_PX = 2.0
"""A tag with a corner further than this from where the pose puts it is left out (occluded, or not a tag)."""
DETECTION_WIDTH_PX = 1400
"""Tags are found in an image of about this width or less: the frame, its half or its quarter."""
REFINEMENT_WINDOWS_PX = (14, 9)
"""Half widths of corner refinement at 20 MP, coarse then fine; a code cell is 45 px wide there."""


@dataclass(frozen=True, kw_only=True)
class TagPose:
    """The board as the camera sees it: pose, number of tags used, root mean square reprojection error in pixels."""

    T_cam_board: Array
    tags_seen: int
    rms_px: float


def camera_from_tags(frame: Frame, tagboard: TagboardConfig) -> TagPose:
    """Pose of the tagboard in ``cam`` from the tags in the frame.

    Raises PerceptionError with the number of tags seen when there are fewer than four that agree on a pose.
    """
    ids, corners_px = find_tags(frame, tagboard)
    _check_count(ids, tagboard, "seen")
    points = np.stack([tagboard.corners(int(i)) for i in ids])  # (T, 4, 3)
    while True:
        T_cam_board = solve_planar_pose(points.reshape(-1, 3), corners_px.reshape(-1, 2), frame.intrinsics)
        error_px = np.linalg.norm(frame.intrinsics.project(apply(T_cam_board, points)) - corners_px, axis=-1)  # (T, 4)
        worst = int(error_px.max(axis=1).argmax())
        if error_px[worst].max() <= MAX_ERROR_PX:
            return TagPose(T_cam_board=T_cam_board, tags_seen=len(ids), rms_px=float(np.sqrt(np.mean(error_px**2))))
        keep = np.arange(len(ids)) != worst
        ids, points, corners_px = ids[keep], points[keep], corners_px[keep]
        _check_count(ids, tagboard, f"left whose corners fit one pose within {MAX_ERROR_PX} px")


def _check_count(ids: NDArray[np.int64], tagboard: TagboardConfig, what: str) -> None:
    if len(ids) < MIN_TAGS:
        raise PerceptionError(
            f"{len(ids)} of the board's {tagboard.count} tags {what}, at least {MIN_TAGS} are needed: bring the board "
            "into view, light it evenly, clear what covers the tags, and check that the config is that of this board"
        )


def find_tags(frame: Frame, tagboard: TagboardConfig) -> tuple[NDArray[np.int64], Array]:
    """Ids (T,) and refined corners (T, 4, 2) in pixels of the board's tags in a frame, sorted by id.

    Tags with an id that the board does not have are left out.
    """
    width = frame.image.shape[1]
    factor = next((n for n in (1, 2) if width / n <= 1.5 * DETECTION_WIDTH_PX), 4)
    reduced = frame.image if factor == 1 else frame.half if factor == 2 else frame.quarter
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
    found, found_ids, _ = detector.detectMarkers(cv2.cvtColor(reduced, cv2.COLOR_RGB2GRAY))
    ids = np.array([] if found_ids is None else found_ids, np.int64).ravel()
    corners = np.array(found, np.float32).reshape(-1, 4, 2)
    order = [k for k in np.argsort(ids, kind="stable") if ids[k] in tagboard.ids]
    ids, corners = ids[order], (corners[order] + 0.5) * factor - 0.5
    if not len(ids):
        return ids, np.zeros((0, 4, 2))
    side_px = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)))
    return ids, np.stack([_refine(frame.image, tag, side_px) for tag in corners]).astype(np.float64)


def _refine(image: NDArray[np.uint8], corners: NDArray[np.float32], side_px: float) -> NDArray[np.float32]:
    """A tag's corners (4, 2) moved to sub-pixel accuracy; windows shrink with tags that are smaller than on 20 MP."""
    halves = [max(2, min(window, int(side_px / 8 * 0.4))) for window in REFINEMENT_WINDOWS_PX]
    margin = 2 * max(halves) + 4
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - margin, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + margin + 1
    gray = cv2.cvtColor(np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]]), cv2.COLOR_RGB2GRAY)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    refined = (corners - low).astype(np.float32).reshape(-1, 1, 2)
    for half in halves:
        refined = cv2.cornerSubPix(gray, refined, (half, half), (-1, -1), criteria)
    return np.asarray(refined, np.float32).reshape(-1, 2) + low.astype(np.float32)


def solve_planar_pose(points: Array, pixels: Array, intrinsics: Intrinsics) -> Array:
    """``T_cam_b`` (4, 4) from points (N, 3) in the plane z = 0 of frame b and their pixels (N, 2), N >= 4.

    Both solutions of the planar problem are refined and the better one is kept.
    """
    K, pixels = intrinsics.matrix, np.ascontiguousarray(pixels, np.float64)
    _, rotations, translations, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    best, best_error = np.eye(4), np.inf
    for rotvec, t in zip(rotations, translations, strict=True):
        rotvec, t = cv2.solvePnPRefineLM(points, pixels, K, None, rotvec.copy(), t.copy())
        T = transform(cv2.Rodrigues(rotvec)[0], np.ravel(t))
        error = float(np.sum((intrinsics.project(apply(T, points)) - pixels) ** 2))
        if error < best_error:
            best, best_error = T, error
    return best


def table_from_board(T_cam_board: Array) -> Array:
    """``T_cam_table``: the board's origin and normal, with x along the camera's +x projected on the board's plane."""
    z = T_cam_board[:3, 2]
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    if np.linalg.norm(x) < 1e-6:
        raise PerceptionError("the camera's x axis is normal to the board; it must look at the board from above")
    x = x / np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), T_cam_board[:3, 3])
