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
from torch.nn import functional

from cad.spatial import Array

CROP = 128
"""Width of a crop in pixels (half the camera's resolution)."""

CROP_CENTRE = (CROP - 1) / 2


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


def network_input(images: Tensor, rays: Tensor) -> Tensor:
    """Input (B, 5, H, W) from images (B, H, W, 3) uint8 and rays (B, 2): each crop normalised by its own mean and
    standard deviation, and the direction to the crop's centre as two constant channels.
    """
    x = images.permute(0, 3, 1, 2).float()
    mean, deviation = x.mean((1, 2, 3), keepdim=True), x.std((1, 2, 3), keepdim=True)
    planes = (5.0 * rays)[:, :, None, None].expand(-1, -1, *x.shape[2:])
    return torch.cat([(x - mean) / (deviation + 8.0), planes], dim=1).contiguous(memory_format=torch.channels_last)


def photometric(x: Tensor, rng: np.random.Generator) -> Tensor:
    """Network input (B, 5, H, W) with gain, tint, offset, grey, negative, shading, noise and blur varied."""
    batch, height, width = len(x), x.shape[2], x.shape[3]

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    def chance(probability: float) -> Tensor:
        return torch.from_numpy(rng.random((batch, 1, 1, 1)) < probability)

    c = x[:, :3]
    c = c * torch.exp(0.15 * normal(batch, 1, 1, 1)) * (1.0 + 0.1 * normal(batch, 3, 1, 1)) + 0.1 * normal(
        batch, 3, 1, 1
    )
    c = torch.where(chance(0.3), c.mean(1, keepdim=True).expand_as(c), c)
    c = torch.where(chance(0.1), -c, c)
    ramp_u, ramp_v = torch.linspace(-1, 1, width), torch.linspace(-1, 1, height)[:, None]
    c = c + 0.15 * (normal(batch, 1, 1, 1) * ramp_u + normal(batch, 1, 1, 1) * ramp_v)
    if rng.random() < 0.5:
        c = c + torch.randn_like(c) * float(rng.uniform(0.0, 0.25))
    if rng.random() < 0.25:
        c = functional.avg_pool2d(c, 3, 1, 1)
    return torch.cat([c, x[:, 3:]], dim=1).contiguous(memory_format=torch.channels_last)
