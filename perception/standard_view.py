"""One scale for every camera: networks and contours see the table at ``STANDARD_M`` a pixel.

That is the Basler's own scale at its nominal height. What is seen from elsewhere, or by another camera, is resampled to
it, so that parts are as large in a crop as they were in training.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.spatial import BASLER, Array, Intrinsics
from perception.estimates import Frame, PerceptionError

NOMINAL_HEIGHT_M = 0.70
STANDARD_M = NOMINAL_HEIGHT_M / BASLER.fx
"""Size on the table of a pixel of the standard view: 67.2 um (2.4 um at 0.70 m behind 25 mm)."""

AS_IT_IS = 0.03
"""A frame whose scale is within this of the standard one is not resampled; training varies as much."""
SCALES = (0.25, 8.0)
"""Frame pixels may be this many times as wide as standard ones; beyond, parts are unlike those trained on."""


def frame_scale(intrinsics: Intrinsics, T_cam_table: Array) -> float:
    """How many standard pixels a pixel of the frame is wide, at the table in the frame's middle; 1 where it is close.

    Raises PerceptionError where parts would be far too small or too large for what the networks have learned.
    """
    middle = intrinsics.rays([(intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2])
    normal = T_cam_table[:3, 2]
    distance = float(normal @ T_cam_table[:3, 3] / (normal @ middle))
    scale = distance / intrinsics.fx / STANDARD_M
    if not SCALES[0] <= scale <= SCALES[1]:
        raise PerceptionError(
            f"a pixel is {1e6 * scale * STANDARD_M:.0f} um wide on the table; it must be from "
            f"{1e6 * SCALES[0] * STANDARD_M:.0f} to {1e6 * SCALES[1] * STANDARD_M:.0f} um: check the calibration's "
            "focal length, or move the camera"
        )
    return 1.0 if abs(scale - 1.0) <= AS_IT_IS else scale


def reduced(frame: Frame, factor: float) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """A frame's image ``factor`` times smaller (larger below 1), and how many pixels one of its pixels is, (u, v).

    Whole pixels come out, so the two differ a little from the factor asked for.
    """
    if factor >= 4.0:
        base, done = frame.quarter, 4
    else:
        base, done = (frame.half, 2) if factor >= 2.0 else (frame.image, 1)
    height, width = base.shape[:2]
    size = max(1, round(width * done / factor)), max(1, round(height * done / factor))
    if size != (width, height):
        how = cv2.INTER_AREA if factor >= done else cv2.INTER_CUBIC
        base = np.asarray(cv2.resize(base, size, interpolation=how), np.uint8)
    return base, (done * width / size[0], done * height / size[1])


def standard_crop(
    image: NDArray[np.uint8], intrinsics: Intrinsics, centre_px: ArrayLike, size: int, scale: float
) -> tuple[NDArray[np.uint8], Intrinsics]:
    """A window (size, size, 3) of an image (H, W, 3) round a pixel at the standard scale, and its intrinsics.

    The window is kept inside of the image; raises PerceptionError when that is smaller than the window.
    """
    side = size if scale == 1.0 else max(2, round(size / scale))
    height, width = image.shape[:2]
    if min(height, width) < side:
        raise PerceptionError(f"a frame of {width} x {height} pixels is too small; crops have {side} x {side}")
    corner = np.round(np.asarray(centre_px, np.float64)).astype(int) - side // 2
    u, v = (int(c) for c in np.clip(corner, 0, [width - side, height - side]))
    window = image[v : v + side, u : u + side]
    camera = intrinsics.crop(u, v, side, side)
    if side == size:
        return np.ascontiguousarray(window), camera
    how = cv2.INTER_AREA if side > size else cv2.INTER_CUBIC
    resampled = cv2.resize(window, (size, size), interpolation=how)
    return np.asarray(resampled, np.uint8), camera.resampled(size, size)
