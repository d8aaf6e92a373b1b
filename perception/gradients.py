"""Gradients of one gray crop, computed once and shared by every hypothesis tried on it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array

Image32 = NDArray[np.float32]

FINE_SIGMA_PX = 0.6
COARSE_SIGMA_PX = 2.2
SCORE_SIGMA_PX = 1.2


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgeImage:
    """Gradients of one gray crop, shared by every hypothesis tried on it.

    ``gray`` is the image itself, ``gradient`` its derivatives (grey levels a pixel) along u and v, ``threshold`` the
    smallest derivative that counts as an edge; ``coarse`` and ``fine`` are contrast-normalised derivatives, magnitude
    below 1.
    """

    gray: Image32
    gradient: tuple[Image32, Image32]
    threshold: float
    coarse: tuple[Image32, Image32]
    fine: tuple[Image32, Image32]

    @staticmethod
    def of(gray: NDArray[np.uint8] | Image32) -> EdgeImage:
        """Gradients of a gray image (H, W) in grey levels."""
        gu, gv = _derivatives(gray, FINE_SIGMA_PX)
        return EdgeImage(
            gray=gray.astype(np.float32),
            gradient=(gu, gv),
            threshold=max(1.0, 2.2 * float(np.median(np.hypot(gu, gv)))),
            coarse=_normalised(*_derivatives(gray, COARSE_SIGMA_PX)),
            fine=_normalised(*_derivatives(gray, SCORE_SIGMA_PX)),
        )


def brightness(image: NDArray[np.uint8]) -> Image32:
    """Mean of the colour channels (H, W) of an image (H, W, 3), not rounded.

    It is less noisy than luminance, and keeps contrasts between bluish metal and neutral grounds that luminance loses.
    """
    return image.mean(axis=2, dtype=np.float32)


def _derivatives(gray: NDArray[np.uint8] | Image32, sigma_px: float) -> tuple[Image32, Image32]:
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)
    gu = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gv = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.asarray(gu, dtype=np.float32), np.asarray(gv, dtype=np.float32)


def _normalised(gu: Image32, gv: Image32) -> tuple[Image32, Image32]:
    squared = gu * gu + gv * gv
    floor = 2.5 * float(np.sqrt(np.median(squared))) + 0.6
    scale = np.reciprocal(np.sqrt(squared + np.float32(floor * floor)), dtype=np.float32)
    return gu * scale, gv * scale


def across(field_uv: tuple[Image32, Image32], u: Image32, v: Image32, normals: Array) -> Image32:
    """Gradient along the samples' normals (N, 2) at pixels u, v (M, N)."""
    gu, gv = (cv2.remap(g, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for g in field_uv)
    n = normals.astype(np.float32)
    return gu * n[None, :, 0] + gv * n[None, :, 1]
