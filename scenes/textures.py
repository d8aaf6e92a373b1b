"""Procedural backgrounds for the tagboard, what a plate may be made of or covered with, and the wear of its face."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
SIZE = 512
WORN_SHARE = 0.4
"""Share of the textures that show wear."""


def make_textures(rng: np.random.Generator, count: int) -> list[NDArray[np.uint8]]:
    """``count`` textures (512, 512, 3) uint8, taking turns through all kinds; the same generator gives the same ones.

    They are about mid grey: the material's colour decides how bright and tinted the plate is.
    """
    return [_finish(KINDS[i % len(KINDS)](rng), rng) for i in range(count)]


def make_wear(rng: np.random.Generator, count: int) -> list[NDArray[np.uint8]]:
    """``count`` layers of wear (512, 512, 4) uint8, colour and coverage: fading, stains, scratches, worn off spots."""
    layers = []
    for _ in range(count):
        colour, cover = np.zeros((SIZE, SIZE, 3), np.float32), np.zeros((SIZE, SIZE), np.float32)
        faded = rng.uniform(0.05, 0.35) * (1 + 0.5 * np.clip(_noise(rng, (5, 5)), -1, 1))
        _lay(colour, cover, faded, _paper(rng))
        for _ in range(int(rng.integers(0, 5))):
            _lay(colour, cover, rng.uniform(0.1, 0.5) * _stain(rng), rng.uniform(20, 140) * rng.uniform(0.6, 1, 3))
        scratches = rng.uniform(0.3, 0.9) * np.clip(np.abs(_scratches(rng)), 0, 1)
        _lay(colour, cover, scratches, rng.uniform(60, 235) * rng.uniform(0.9, 1.0, 3))
        _lay(colour, cover, (_noise(rng, (120, 120)) > rng.uniform(2.4, 3.5)).astype(np.float32), _paper(rng))
        layers.append(np.dstack([np.clip(colour, 0, 255), 255 * cover]).astype(np.uint8))
    return layers


def worn(image: NDArray[np.uint8], layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (H, W, 3) under a layer of wear, stretched over it."""
    over = cv2.resize(layer, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    cover = over[..., 3:].astype(np.float32) / 255
    return (image + cover * (over[..., :3] - image.astype(np.float32)) + 0.5).astype(np.uint8)


def _lay(colour: Image, cover: Image, mask: NDArray[np.floating], rgb: NDArray[np.float64]) -> None:
    """Add one more layer on top, of one colour: straight, not premultiplied, alpha."""
    mask = np.clip(mask, 0, 1)
    total = mask + cover * (1 - mask)
    share = (mask / np.maximum(total, 1e-6))[..., None]
    colour += share * (np.asarray(rgb, np.float32) - colour)
    cover[:] = total


def _paper(rng: np.random.Generator) -> NDArray[np.float64]:
    """Bleached or yellowed paper."""
    return rng.uniform(150, 240) * np.array([1.0, rng.uniform(0.94, 1.0), rng.uniform(0.8, 1.0)])


def _stain(rng: np.random.Generator) -> Image:
    """A blot with a ragged, darker rim."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    centre, radius = rng.uniform(0, SIZE, 2), rng.uniform(15, 90)
    distance = np.hypot(x - centre[0], y - centre[1]) / radius + 0.25 * _noise(rng, (9, 9))
    rim = np.exp(-(((distance - 0.92) / 0.07) ** 2))
    return (0.6 / (1 + np.exp(np.minimum(20 * (distance - 1), 80))) + 0.4 * rim).astype(np.float32)


def _finish(pattern: Image, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Pattern (512, 512) or (512, 512, 3) of about zero mean and unit range to grey levels, with a little grain."""
    if pattern.ndim == 2:
        pattern = np.repeat(pattern[..., None], 3, axis=2)
    contrast, grain = rng.uniform(8, 55), rng.uniform(0, 5)
    levels = 200 + contrast * pattern + grain * rng.standard_normal(pattern.shape, dtype=np.float32)
    image = np.clip(levels, 0, 255).astype(np.uint8)
    return worn(image, make_wear(rng, 1)[0]) if rng.random() < WORN_SHARE else image


def _noise(rng: np.random.Generator, cells: tuple[int, int]) -> Image:
    """Smooth noise with that many cells down and across."""
    coarse = rng.standard_normal(cells, dtype=np.float32)
    return cv2.resize(coarse, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC).astype(np.float32)


def _clouds(rng: np.random.Generator) -> Image:
    octaves = [_noise(rng, (n, n)) / (k + 1) for k, n in enumerate((3, 8, 24, 80))]
    return np.mean(octaves, axis=0).astype(np.float32) * 2


def _brushed(rng: np.random.Generator) -> Image:
    fine = _noise(rng, (SIZE, int(rng.integers(2, 8))))
    return fine if rng.random() < 0.5 else fine.T


def _grain(rng: np.random.Generator) -> Image:
    """Wood: stripes bent by smooth noise."""
    y = np.linspace(0, rng.uniform(12, 40), SIZE, dtype=np.float32)[:, None]
    return (np.sin(y + 3 * _noise(rng, (2, 4))) * 0.7 + 0.4 * _noise(rng, (SIZE, 6))).astype(np.float32)


def _scratches(rng: np.random.Generator) -> Image:
    image = np.zeros((SIZE, SIZE), np.float32)
    for _ in range(int(rng.integers(20, 90))):
        start = rng.integers(0, SIZE, 2)
        end = start + rng.integers(-120, 120, 2)
        level = float(rng.normal(0, 0.8))
        cv2.line(image, start.tolist(), end.tolist(), level, int(rng.integers(1, 3)), cv2.LINE_AA)
    return image


def _blocks(rng: np.random.Generator) -> Image:
    image = np.zeros((SIZE, SIZE, 3), np.float32)
    for _ in range(int(rng.integers(8, 30))):
        start = rng.integers(0, SIZE, 2)
        end = start + rng.integers(8, 160, 2)
        colour = (rng.normal(0, 0.9) + rng.normal(0, 0.25, 3)).tolist()
        cv2.rectangle(image, start.tolist(), end.tolist(), colour, -1)
    return image


def _weave(rng: np.random.Generator) -> Image:
    period = rng.uniform(6, 24)
    t = np.arange(SIZE, dtype=np.float32) * (2 * np.pi / period)
    return (np.sin(t)[:, None] * np.sin(t)[None] + 0.3 * _noise(rng, (16, 16))).astype(np.float32)


def _specks(rng: np.random.Generator) -> Image:
    image = 0.15 * _noise(rng, (10, 10))
    for _ in range(int(rng.integers(100, 500))):
        centre = rng.integers(0, SIZE, 2).tolist()
        cv2.circle(image, centre, int(rng.integers(1, 5)), float(rng.normal(-0.4, 0.8)), -1, cv2.LINE_AA)
    return image


def _grid(rng: np.random.Generator) -> Image:
    """A cutting mat: thin lines at even distances."""
    image = 0.1 * _noise(rng, (6, 6))
    step, level = int(rng.integers(24, 100)), float(rng.uniform(-1, 1))
    image[::step] = level
    image[:, ::step] = level
    return image


def _stains(rng: np.random.Generator) -> Image:
    edges = np.tanh(3 * (_noise(rng, (6, 6)) - 0.6)).astype(np.float32)
    return (0.6 * edges + 0.2 * _noise(rng, (60, 60))).astype(np.float32)


KINDS: tuple[Callable[[np.random.Generator], Image], ...] = (
    _clouds,
    _brushed,
    _grain,
    _scratches,
    _blocks,
    _weave,
    _specks,
    _grid,
    _stains,
)
