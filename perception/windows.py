"""Training windows of the segmenter and how they are varied: symmetries, warps, pasted parts, light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array
from perception.dataset import WindowSet
from perception.shadows import shadow

MIN_VISIBLE_PX = 40
"""Slivers of fewer visible pixels (3 mm^2) at a window's border get no centre and do not count in the figures."""

SHADOWED = 0.3
"""Share of the examples over which something casts a shadow from outside."""

PASTED_APART_PX = (0, 1, 3)
"""How far a pasted part may be from the others, each as often: parts that touch are to be told apart."""


@dataclass(frozen=True)
class Window:
    """One example: image (H, W, 3), filled instance map (H, W), centre (u, v) and class of each instance."""

    image: NDArray[np.uint8]
    instances: NDArray[np.uint8]
    centres: Array  # (I, 2), pixels of the window
    classes: NDArray[np.int64]  # (I,)


def filled(instances: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An instance map whose instances have no holes: what is seen through a hollow part belongs to it.

    At a quarter of the camera's resolution the walls of a part that stands on end are one pixel wide; its outline is
    what can be found.
    """
    out = instances.copy()
    for k in np.unique(instances[instances > 0]):
        contours, _ = cv2.findContours((instances == k).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        inside = np.zeros_like(instances)
        cv2.drawContours(inside, contours, -1, (1,), cv2.FILLED)
        out[(inside > 0) & (instances == 0)] = k
    return out


class Windows:
    """The training windows of some data sets as examples, one after the other.

    Instances are without holes unless ``holes`` are asked for.
    """

    def __init__(self, *sets: WindowSet, parts: Sequence[Part], holes: bool = False) -> None:
        self.sets, self.starts = sets, np.cumsum([0, *map(len, sets)])
        self.instances = [
            data.instance_map if holes else np.stack([filled(each) for each in data.instance_map]) for data in sets
        ]
        self.labels = [data.labels(parts) for data in sets]

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, index: int) -> Window:
        if not 0 <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        k = int(np.searchsorted(self.starts, index, side="right")) - 1
        data, labels, i = self.sets[k], self.labels[k], index - int(self.starts[k])
        rows = data.instances_of[i]
        order = rows[np.argsort(data.instance[rows])]
        return Window(
            image=np.asarray(data.images[i]),
            instances=np.asarray(self.instances[k][i]),
            centres=labels.body_px[order],
            classes=labels.part_index[order],
        )


def flip(window: Window, rng: np.random.Generator) -> Window:
    """One of the eight exact symmetries of the square grid."""
    image, instances, centres = window.image, window.instances, window.centres.copy()
    if rng.random() < 0.5:
        image, instances, centres = image.transpose(1, 0, 2), instances.T, centres[:, ::-1].copy()
    for axis in (0, 1):
        if rng.random() < 0.5:
            image, instances = np.flip(image, axis), np.flip(instances, axis)
            centres[:, 1 - axis] = instances.shape[axis] - 1 - centres[:, 1 - axis]
    return Window(np.ascontiguousarray(image), np.ascontiguousarray(instances), centres, window.classes)


def draw_small(window: Window, rng: np.random.Generator) -> int | None:
    """One of the instances, small ones more often since they are the hard ones; None when there is none."""
    area = np.bincount(window.instances.ravel(), minlength=len(window.centres) + 1)[1:]
    weight = np.where(area >= MIN_VISIBLE_PX, 1.0 / np.maximum(area, 1), 0.0)
    return int(rng.choice(len(area), p=weight / weight.sum())) if weight.any() else None


def cut(window: Window, size: int, rng: np.random.Generator, near: float = 0.7) -> Window:
    """A square of ``size`` pixels, with probability ``near`` one that holds the centre of a part.

    Parts fill one pixel in a hundred; smaller windows round them show the network more of them a second.
    """
    limit = np.array(window.instances.shape[::-1]) - size
    if np.any(limit < 0):
        raise ValueError(f"cannot cut {size} pixels from a window of {window.instances.shape}")
    u, v = rng.integers(0, limit + 1)
    k = draw_small(window, rng) if rng.random() < near else None
    if k is not None:
        u, v = np.clip((window.centres[k] - rng.uniform(0, size, 2)).astype(int), 0, limit)
    place = np.s_[v : v + size, u : u + size]
    return Window(window.image[place], window.instances[place], window.centres - [u, v], window.classes)


def warp(window: Window, rng: np.random.Generator) -> Window:
    """Turned by any angle, scaled by up to 15 % and shifted; what comes in from outside is one grey."""
    height, width = window.instances.shape
    middle = ((width - 1) / 2, (height - 1) / 2)
    A = cv2.getRotationMatrix2D(middle, rng.uniform(0, 360), np.exp(rng.uniform(-0.15, 0.15)))
    A[:, 2] += rng.uniform(-40, 40, 2)
    size, grey = (width, height), tuple(int(x) for x in rng.integers(40, 220, 3))
    image = cv2.warpAffine(window.image, A, size, flags=cv2.INTER_LINEAR, borderValue=grey)
    instances = cv2.warpAffine(window.instances, A, size, flags=cv2.INTER_NEAREST, borderValue=(0,))
    return Window(
        np.asarray(image, np.uint8),
        np.asarray(instances, np.uint8),
        window.centres @ A[:, :2].T + A[:, 2],
        window.classes,
    )


def paste(window: Window, other: Window, rng: np.random.Generator, margin: int = 24) -> Window:
    """A part of ``other`` with its shadow, copied to where it covers no part; the window itself if that fails.

    The shadow is what is darker than its surroundings within ``margin`` pixels, and darkens the new ground likewise.
    """
    k = draw_small(other, rng)
    if k is None:
        return window
    own = other.instances == k + 1
    u, v, w, h = cv2.boundingRect(own.astype(np.uint8))
    height, width = own.shape
    if u == 0 or v == 0 or u + w == width or v + h == height:
        return window
    top, left = max(0, v - margin), max(0, u - margin)
    box = np.s_[top : min(height, v + h + margin), left : min(width, u + w + margin)]
    patch, own, ground = other.image[box].astype(np.float32), own[box], other.instances[box] == 0
    j = int(rng.integers(0, window.instances.shape[0] - own.shape[0] + 1))
    i = int(rng.integers(0, window.instances.shape[1] - own.shape[1] + 1))
    place = np.s_[j : j + own.shape[0], i : i + own.shape[1]]
    apart = int(rng.choice(PASTED_APART_PX))
    reach = cv2.dilate(own.astype(np.uint8), np.ones((2 * apart + 1,) * 2, np.uint8)) > 0
    if window.instances[place][reach].any():
        return window
    gray = patch.mean(axis=2)
    shade = np.where(ground, np.clip(gray / max(1.0, float(np.median(gray[ground]))), 0.2, 1.0), 1.0)
    shade = np.where(shade < 0.85, shade, 1.0)[..., None]
    alpha = cv2.GaussianBlur(own.astype(np.float32), (0, 0), 0.6)[..., None]
    image, instances = window.image.copy(), window.instances.copy()
    brightness = np.exp(rng.normal(0.0, 0.25))
    pasted = alpha * brightness * patch + (1 - alpha) * shade * image[place]
    image[place] = np.clip(pasted, 0, 255).astype(np.uint8)
    instances[place][own] = len(window.centres) + 1
    shift = np.array([i - left, j - top])
    return Window(
        image,
        instances,
        np.concatenate([window.centres, other.centres[k : k + 1] + shift]),
        np.append(window.classes, other.classes[k]),
    )


def recolour(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Another exposure, white balance, contrast, sharpness and noise."""
    curve = 255.0 * np.linspace(0.0, 1.0, 256) ** np.exp(rng.normal(0.0, 0.2)) * np.exp(rng.normal(0.0, 0.2))
    x = curve.astype(np.float32)[image]
    if rng.random() < 0.25:
        x = np.repeat(x.mean(axis=2, keepdims=True), 3, axis=2)
    x *= np.exp(rng.normal(0.0, 0.06, 3)).astype(np.float32)
    if rng.random() < 0.3:
        ramp = np.linspace(-1.0, 1.0, x.shape[1], dtype=np.float32)
        x *= np.exp(rng.normal(0, 0.2) * ramp[:, None] + rng.normal(0, 0.2) * ramp[: x.shape[0], None, None])
    if rng.random() < 0.3:
        blurred = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.0))
        x = blurred if rng.random() < 0.6 else 2.0 * x - blurred
    if rng.random() < SHADOWED:
        x *= shadow(x.shape[0], x.shape[1], rng)[..., None]
    x += rng.normal(0.0, rng.uniform(0.0, 5.0)) + rng.standard_normal(x.shape, np.float32) * rng.uniform(0.0, 5.0)
    return np.clip(x, 0, 255).astype(np.uint8)
