"""Lens distortion after Brown and Conrady: which pinhole window to render, and how it becomes the distorted one.

The coefficients act on normalised image coordinates (x = X / Z, y = Y / Z), so one lens serves the whole frame, every
window of it and every size. They are OpenCV's k1, k2, p1, p2: ``distortion`` of ``cv2.projectPoints``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.spatial import BASLER, Array, Intrinsics
from scenes.errors import SceneError

SUPPORT_PX = 2
"""Pixels beside a point that cubic interpolation reads."""
NO_MAP = np.empty(0, np.float32)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Distortion coefficients; all zero for none. Raises SceneError where the frame's image would fold over."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        if not all(np.isfinite(self.coefficients)):
            raise SceneError(f"lens coefficients {self.coefficients}: must be finite")
        if self.straight:
            return
        radius = np.hypot(BASLER.width / BASLER.fx, BASLER.height / BASLER.fy) / 2
        r = np.linspace(0, 1.2 * radius, 50)
        growth = 1 + 3 * self.k1 * r**2 + 5 * self.k2 * r**4 - 6 * (abs(self.p1) + abs(self.p2)) * r
        if growth.min() < 0.5:
            raise SceneError(f"lens coefficients {self.coefficients}: too strong, the frame's corners would fold over")

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """(k1, k2, p1, p2), in OpenCV's order."""
        return self.k1, self.k2, self.p1, self.p2

    @property
    def straight(self) -> bool:
        """Whether the lens does not distort."""
        return not any(self.coefficients)

    def distort(self, points: ArrayLike) -> Array:
        """Where ideal normalised points (..., 2) are seen, normalised."""
        xy = np.asarray(points, dtype=np.float64)
        if self.straight:
            return xy
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * self.k2)
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def undistort(self, points: ArrayLike) -> Array:
        """Ideal normalised points (..., 2) of those seen: the inverse of :meth:`distort`, to 1e-10."""
        seen = np.asarray(points, dtype=np.float64)
        if self.straight:
            return seen
        ideal = seen.copy()
        for _ in range(50):
            error = self.distort(ideal) - seen
            ideal -= error
            if np.abs(error).max(initial=0.0) < 1e-11:
                break
        return ideal

    def project(self, intrinsics: Intrinsics, p_cam: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in ``cam``."""
        p = np.asarray(p_cam, dtype=np.float64)
        xy = self.distort(p[..., :2] / p[..., 2:])
        return xy * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


STRAIGHT = Lens()
"""A lens that does not distort."""


class Warp:
    """Turns renderings of a pinhole window into the distorted window ``intrinsics`` that the lens shows.

    ``source`` is the pinhole window to render colours through, ``label_source`` the one for instances and depth,
    ``label_scale`` times finer: the nearest of its pixels is at most 0.5 / ``label_scale`` pixels away on either axis.
    Both are ``intrinsics`` itself, and nothing is resampled, for a lens that does not distort.
    """

    def __init__(self, lens: Lens, intrinsics: Intrinsics, label_scale: int = 2) -> None:
        self._straight = lens.straight
        self.source = self.label_source = intrinsics
        if self._straight:
            return
        u, v = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
        ideal = lens.undistort(intrinsics.rays(np.stack([u, v], axis=-1))[..., :2])
        at = ideal * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
        low = np.floor(at.min(axis=(0, 1))).astype(int) - SUPPORT_PX
        high = np.ceil(at.max(axis=(0, 1))).astype(int) + SUPPORT_PX
        self.source = intrinsics.crop(int(low[0]), int(low[1]), *(int(n) for n in high - low + 1))
        self.label_source = magnified(self.source, label_scale)
        self._map = (at - low).astype(np.float32)
        fine = np.rint((at - low + 0.5) * label_scale - 0.5).astype(np.intp)
        self._nearest = fine[..., 1] * self.label_source.width + fine[..., 0]

    def colours(self, image: NDArray[Any]) -> NDArray[Any]:
        """The distorted colours (H, W, 3) of a rendering through ``source``, by cubic interpolation; same type."""
        if self._straight:
            return image
        seen = cv2.remap(image, self._map, NO_MAP, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return seen if image.dtype == np.uint8 else np.maximum(seen, 0, out=seen)

    def labels(self, values: NDArray[Any]) -> NDArray[Any]:
        """The distorted instances or distances (H, W) of a rendering through ``label_source``: the nearest pixel's."""
        return values if self._straight else np.take(values, self._nearest)


def magnified(intrinsics: Intrinsics, factor: int) -> Intrinsics:
    """The camera with ``factor`` x ``factor`` pixels for each of this one's."""
    return Intrinsics(
        width=intrinsics.width * factor,
        height=intrinsics.height * factor,
        fx=intrinsics.fx * factor,
        fy=intrinsics.fy * factor,
        cx=(intrinsics.cx + 0.5) * factor - 0.5,
        cy=(intrinsics.cy + 0.5) * factor - 0.5,
    )
