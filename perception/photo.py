"""Photographs of any kind: read as 8-bit RGB, and turned into what a camera without distortion would have seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics
from perception.estimates import PerceptionError

BIT_DEPTHS = (8, 10, 12, 14, 16)
"""Cameras store 10, 12 or 14 bits in 16; which it is shows in the brightest pixel."""
WIDEST_MARGIN = 0.25
"""The undistorted image grows by at most this share of its size on each side."""
INVERTIBLE_PX = 0.1
GRID = 33


class PhotoError(PerceptionError):
    """A photograph that cannot be used; the message names the file and what to do."""


def read_photo(path: Path) -> NDArray[np.uint8]:
    """A JPEG, PNG, TIFF or BMP file, 8 or 16 bit, gray or colour, as RGB (H, W, 3) uint8.

    A note in the file that it be shown turned (EXIF orientation) is ignored, since a calibration is of the sensor's
    rows and columns. 16 bits become 8 by leaving out those that no pixel uses at the top, and the lowest of the rest.
    Transparency is left out. Raises PhotoError when there is no such file or it is no such picture.
    """
    if not path.is_file():
        raise PhotoError(f"there is no picture {path}; check the name")
    data = np.fromfile(path, np.uint8)
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags) if len(data) else None
    except cv2.error as error:
        raise PhotoError(f"{path} cannot be decoded ({error.err}); save it anew as PNG, TIFF or JPEG") from error
    if image is None:
        raise PhotoError(f"{path} is no picture that can be read, or is damaged; save it as 8 or 16-bit PNG or TIFF")
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    if image.dtype == np.uint16:
        brightest = int(image.max())
        bits = next(n for n in BIT_DEPTHS if brightest < 2**n)
        return np.right_shift(image, bits - 8).astype(np.uint8)
    raise PhotoError(f"{path} holds {image.dtype} pixels; save it with 8 or 16 bits a channel")


@dataclass(frozen=True, kw_only=True, eq=False)
class LensCorrection:
    """Between the photograph that a lens made and the one that a ``pinhole`` camera would have made.

    ``camera`` (intrinsics of the photograph) and ``pinhole`` have one focal length; the latter's window is as large as
    it takes to hold everything in the photograph. ``distortion`` are OpenCV's coefficients, none for no distortion.
    """

    camera: Intrinsics
    distortion: tuple[float, ...]
    pinhole: Intrinsics

    @classmethod
    def of(cls, camera: Intrinsics, distortion: tuple[float, ...]) -> LensCorrection:
        """The correction of a camera; raises PhotoError for a distortion that cannot be undone all over the frame."""
        if not any(distortion):
            return cls(camera=camera, distortion=(), pinhole=camera)
        u, v = np.linspace(0, camera.width - 1, GRID), np.linspace(0, camera.height - 1, GRID)
        seen = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)  # (GRID * GRID, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
        K, k = camera.matrix, np.array(distortion)
        ideal = np.asarray(cv2.undistortPoints(seen[:, None], K, k, P=K, criteria=stop), np.float64)[:, 0]
        off_px = float(np.abs(_distorted(ideal, camera, camera, k) - seen).max())
        if not off_px < INVERTIBLE_PX:
            raise PhotoError(
                f"distortion {list(distortion)} cannot be undone all over {camera.width} x {camera.height} pixels (by "
                f"{off_px:.3g} px off): the coefficients fold the image over; calibrate with views that fill the frame"
            )
        size = np.array([camera.width, camera.height])
        low = np.maximum(np.floor(ideal.min(axis=0)), np.ceil(-WIDEST_MARGIN * size)).astype(int)
        high = np.minimum(np.ceil(ideal.max(axis=0)), np.floor((1 + WIDEST_MARGIN) * size)).astype(int)
        window = camera.crop(int(low[0]), int(low[1]), *(int(n) for n in high - low + 1))
        return cls(camera=camera, distortion=distortion, pinhole=window)

    def undistorted(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The photograph (H, W, 3) as ``pinhole`` would have taken it, by cubic interpolation.

        What lies outside of the photograph repeats its border.
        """
        if not self.distortion:
            return image
        size = self.pinhole.width, self.pinhole.height
        K, k = self.camera.matrix, np.array(self.distortion)
        maps: Any = cv2.initUndistortRectifyMap(K, k, np.eye(3), self.pinhole.matrix, size, cv2.CV_32FC1)
        seen = cv2.remap(image, maps[0], maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(seen, np.uint8)

    def in_photo(self, pixels: Array) -> Array:
        """Pixels (N, 2) of the photograph at which those of ``pinhole`` are seen."""
        if not self.distortion:
            return np.asarray(pixels, np.float64)
        return _distorted(pixels, self.pinhole, self.camera, np.array(self.distortion))


def _distorted(pixels: Array, pinhole: Intrinsics, camera: Intrinsics, coefficients: Array) -> Array:
    rays = pinhole.rays(pixels).reshape(-1, 1, 3)
    if not len(rays):
        return np.zeros((0, 2))
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, coefficients)
    return np.asarray(seen, np.float64)[:, 0]
