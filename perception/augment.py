"""Changes to a crop that leave its label true: turning about the crop's centre, and changes of exposure and colour.

Turning the picture about its centre is what the camera would see when turned about its optical axis, with the window
moved along: pixels, the ray through the window's centre and the yaw turn together. A positive angle turns the picture
counter-clockwise as it is looked at, which increases the yaw, because the table's z points to the viewer.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from cad.spatial import Array
from perception.encoding import encode, encoded
from perception.shadows import shadow

CROP = 128
"""Width of a crop in pixels (half the camera's resolution)."""

CROP_CENTRE = (CROP - 1) / 2
SHADOWED = 0.2
"""Share of the crops over which something casts a shadow from outside."""


def image_turn(angle: float) -> Array:
    """(2, 2) matrix that turns pixel offsets (u, v), v down, counter-clockwise as seen by ``angle`` rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]])


def crop_warp(angle: float, shift: ArrayLike = (0.0, 0.0)) -> Array:
    """(2, 3) affine that takes a crop's pixels to those of the crop turned about its centre, then shifted."""
    A = image_turn(angle)
    centre = np.full(2, CROP_CENTRE)
    return np.concatenate([A, (centre - A @ centre + np.asarray(shift, dtype=np.float64))[:, None]], axis=1)


def warp_points(warp: Array, pixels: ArrayLike) -> Array:
    """Pixels (..., 2) moved by an affine (2, 3)."""
    return np.asarray(pixels, dtype=np.float64) @ warp[:, :2].T + warp[:, 2]


def warp_image(image: NDArray[np.uint8], warp: Array, size: int = CROP) -> NDArray[np.uint8]:
    """An image (H, W[, 3]) moved by an affine (2, 3) into ``size`` x ``size`` pixels, its border mirrored outwards."""
    return cv2.warpAffine(image, warp, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)  # pyright: ignore[reportReturnType]


def rectify_warp(centre: ArrayLike, yaw: float, size: int, scale: float = 1.0) -> Array:
    """(2, 3) affine from a crop to a ``size``-pixel window centred on ``centre`` (2,), turned back by ``yaw``."""
    A = scale * image_turn(-yaw)
    return np.concatenate([A, ((size - 1) / 2 - A @ np.asarray(centre, dtype=np.float64))[:, None]], axis=1)


def network_input(images: NDArray[np.uint8], rays: NDArray[np.floating]) -> Tensor:
    """Input (B, 5, H, W), channels last in memory, from images (B, H, W, 3) and rays (B, 2).

    Each crop is encoded and normalised by its own mean and standard deviation; two constant channels hold the ray to
    its centre.
    """
    x = np.empty((*images.shape[:3], 5), dtype=np.float32)
    for i, image in enumerate(images):
        c = encoded(image)
        mean, deviation = _moments(c)
        gain = 1.0 / (deviation + 8.0)
        x[i] = _to_planes(c, gain * np.eye(3), np.full(3, -gain * mean), rays[i])
    return torch.from_numpy(x).permute(0, 3, 1, 2)


class Photometric:
    """Network input with gain, tint, offset, grey, negative, shading, shadows, noise and blur varied.

    Noise is read from a table at a random place: drawing it anew would cost more than the network's first stage.
    """

    def __init__(self, rng: np.random.Generator, noise_values: int = 1 << 20) -> None:
        self.noise = rng.standard_normal(noise_values, dtype=np.float32)

    def __call__(self, images: NDArray[np.uint8], rays: NDArray[np.floating], rng: np.random.Generator) -> Tensor:
        """Varied input (B, 5, H, W) of images (B, H, W, 3) and rays (B, 2)."""
        batch, height, width = images.shape[:3]
        ramps = np.empty((2, height, width, 3), dtype=np.float32)
        ramps[0] = np.linspace(-1, 1, width)[:, None]
        ramps[1] = np.linspace(-1, 1, height)[:, None, None]
        x = np.empty((batch, height, width, 5), dtype=np.float32)
        for i, image in enumerate(images):
            if rng.random() < SHADOWED:
                c = encode(np.round(image * shadow(height, width, rng)[..., None]))
            else:
                c = encoded(image)
            mean, deviation = _moments(c)
            for ramp in ramps:
                c = cv2.scaleAdd(ramp, float(rng.normal(0.0, 0.15)) * deviation, c)
            if rng.random() < 0.5:
                start = int(rng.integers(len(self.noise) - c.size))
                noise = self.noise[start : start + c.size].reshape(c.shape)
                c = cv2.scaleAdd(noise, float(rng.uniform(0.0, 0.25)) * deviation, c)
            if rng.random() < 0.25:
                c = cv2.blur(c, (3, 3))
            mix = _colour_mix(rng)
            gain = 1.0 / (deviation + 8.0)
            offset = mix @ np.full(3, -gain * mean) + rng.normal(0.0, 0.1, 3)
            x[i] = _to_planes(np.asarray(c, dtype=np.float32), gain * mix, offset, rays[i])
        return torch.from_numpy(x).permute(0, 3, 1, 2)


def _colour_mix(rng: np.random.Generator) -> Array:
    """(3, 3) random change of colour: gain and tint, sometimes grey, sometimes negative."""
    tint = np.diag(np.exp(rng.normal(0.0, 0.15)) * (1.0 + rng.normal(0.0, 0.1, 3)))
    grey = np.full((3, 3), 1 / 3) if rng.random() < 0.3 else np.eye(3)
    return (-1.0 if rng.random() < 0.1 else 1.0) * tint @ grey


def _moments(image: NDArray[np.float32]) -> tuple[float, float]:
    """Mean and standard deviation over all pixels and channels."""
    mean, deviation = cv2.meanStdDev(image)
    return float(mean.mean()), float(np.sqrt((deviation**2).mean() + mean.var()))


def _to_planes(
    colour: NDArray[np.float32], mix: Array, offset: Array, ray: NDArray[np.floating]
) -> NDArray[np.float32]:
    """(H, W, 5) with ``mix @ colour + offset`` and five times the ray."""
    planes = np.zeros((5, 4))
    planes[:3, :3], planes[:3, 3], planes[3:, 3] = mix, offset, 5.0 * np.asarray(ray)
    return cv2.transform(colour, planes)  # pyright: ignore[reportReturnType]
