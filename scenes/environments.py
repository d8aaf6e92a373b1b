"""Image-based environments made here: what surrounds the board, as metal parts mirror it.

An environment is a cube map (6, N, N, 3) uint8 of linear radiance in the board's frame, z up, its faces in MuJoCo's
order for cube textures: +x, -x, +z, -z, -y, +y. Only ratios matter: divide by :func:`irradiance` for a known level.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array

Cube = NDArray[np.uint8]
SIZE = 128
"""Pixels along each side of a face: 0.7 degrees, finer than a brushed surface resolves."""
FACES: tuple[tuple[tuple[int, int, int], ...], ...] = (
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
)
"""Of each face: the direction of its middle, that in which columns count up, that in which rows count up."""
CAMERA_HALF_DEG = 4.0
"""Half the angle under which the board sees the dark front of the camera straight above."""


def directions(size: int = SIZE) -> Array:
    """Unit vectors (6, N, N, 3) from the board through the middles of a cube map's pixels."""
    t = (np.arange(size) + 0.5) / size * 2 - 1
    faces = np.array(FACES, dtype=np.float64)
    through = faces[:, None, None, 0] + t[None, None, :, None] * faces[:, None, None, 1]
    through = through + t[None, :, None, None] * faces[:, None, None, 2]
    return through / np.linalg.norm(through, axis=-1, keepdims=True)


def irradiance(cube: Cube) -> float:
    """What a white matt board that faces up receives from an environment, relative to one that is white all round."""
    d = directions(cube.shape[1])
    solid_angle = np.abs(d).max(axis=-1) ** 3
    weight = solid_angle * np.maximum(d[..., 2], 0.0)
    return float((weight * cube.mean(axis=-1)).sum() / (255 * weight.sum()))


def make_environments(rng: np.random.Generator, count: int, size: int = SIZE) -> list[Cube]:
    """``count`` environments (6, size, size, 3), taking turns through all kinds; the same generator gives the same."""
    d = directions(size)
    return [_finish(KINDS[i % len(KINDS)](d, rng), d, rng) for i in range(count)]


def _finish(radiance: Array, d: Array, rng: np.random.Generator) -> Cube:
    """Tint, add a dark camera straight above and the bench below; the brightest tenth of a percent reaches 255."""
    if radiance.ndim == 3:
        radiance = np.repeat(radiance[..., None], 3, axis=-1)
    below = _smooth(-d[..., 2], 0.0, 0.08)[..., None]
    bench = rng.uniform(0.02, 0.25) * radiance.mean() / 0.3
    radiance = (1 - below) * radiance + below * bench
    camera = _smooth(d[..., 2], np.cos(np.radians(CAMERA_HALF_DEG + 1)), np.cos(np.radians(CAMERA_HALF_DEG)))
    radiance = radiance * (1 - 0.9 * camera[..., None]) * (1 + rng.normal(0, 0.05, 3))
    top = np.quantile(radiance, 0.999)
    return np.rint(255 * np.clip(radiance / top, 0, 1)).astype(np.uint8)


def _smooth(x: Array, low: float, high: float) -> Array:
    """0 below ``low``, 1 above ``high``, a smooth step between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _room(d: Array, rng: np.random.Generator, wall: float, ceiling: float) -> Array:
    """Walls that brighten towards the ceiling, with a few broad patches: cupboards, doors, people."""
    height = d[..., 2]
    room = wall + (ceiling - wall) * _smooth(height, 0.2, 0.8)
    for _ in range(int(rng.integers(2, 7))):
        room = room + rng.uniform(-0.6, 0.6) * wall * _panel(d, _towards(rng, 0, 35), rng.uniform(0.1, 0.5, 2), rng)
    return np.maximum(room, 0.0)


def _towards(rng: np.random.Generator, low_deg: float, high_deg: float) -> Array:
    """A direction (3,) of any azimuth whose elevation lies between two angles."""
    elevation, azimuth = np.radians(rng.uniform(low_deg, high_deg)), rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _panel(
    d: Array, towards: Array, half: Array, rng: np.random.Generator, soft: float = 0.02, turn: float = 0
) -> Array:
    """Coverage (6, N, N) of a rectangle square to ``towards``, of half width and height ``half`` at unit distance."""
    across = np.cross([0.0, 0.0, 1.0], towards)
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([1.0, 0.0, 0.0])
    down = np.cross(towards, across)
    across, down = np.cos(turn) * across + np.sin(turn) * down, np.cos(turn) * down - np.sin(turn) * across
    depth = d @ towards
    safe = np.where(depth > 1e-3, depth, 1e-3)
    u, v = d @ across / safe, d @ down / safe
    edge = rng.uniform(0.01, 0.04)
    inside = _smooth(half[0] - np.abs(u), -edge, edge) * _smooth(half[1] - np.abs(v), -edge, edge)
    return np.where(depth > 1e-3, inside, 0.0)


def _tent(d: Array, rng: np.random.Generator) -> Array:
    """A light tent: white cloth all round, brighter on the sides where its lamps stand."""
    tent = np.full(d.shape[:-1], rng.uniform(0.3, 0.6))
    for _ in range(int(rng.integers(2, 5))):
        spread = rng.uniform(2, 8)
        tent = tent + rng.uniform(0.3, 1.0) * np.exp(spread * (d @ _towards(rng, 10, 70) - 1))
    return tent * (1 - rng.uniform(0.3, 0.9) * _panel(d, _towards(rng, 5, 30), rng.uniform(0.1, 0.4, 2), rng))


def _soft_boxes(d: Array, rng: np.random.Generator) -> Array:
    """One to three large rectangular diffusers in a dark studio."""
    light = _room(d, rng, rng.uniform(0.02, 0.08), rng.uniform(0.02, 0.1))
    for _ in range(int(rng.integers(1, 4))):
        half, turn = rng.uniform(0.15, 0.6, 2), rng.uniform(0, np.pi)
        light = light + rng.uniform(0.4, 1.0) * _panel(d, _towards(rng, 30, 80), half, rng, turn=turn)
    return light


def _strips(d: Array, rng: np.random.Generator) -> Array:
    """Parallel strip lights under a ceiling, as in a hall."""
    light = _room(d, rng, rng.uniform(0.05, 0.15), rng.uniform(0.1, 0.25))
    azimuth, above = rng.uniform(0, np.pi), np.array([0.0, 0.0, 1.0])
    sideways = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    for offset in np.linspace(-1, 1, int(rng.integers(2, 6))) * rng.uniform(0.4, 1.4) + rng.uniform(-0.2, 0.2):
        towards = above + offset * sideways
        towards = towards / np.linalg.norm(towards)
        turn = azimuth if abs(offset) < 1e-9 else np.pi / 2 * (offset != 0)
        light = light + _panel(d, towards, np.array([rng.uniform(0.02, 0.07), rng.uniform(0.5, 2.0)]), rng, turn=turn)
    return light


def _windows(d: Array, rng: np.random.Generator) -> Array:
    """A room with one to three windows: sky above, darker ground below, bars between."""
    light = _room(d, rng, rng.uniform(0.06, 0.2), rng.uniform(0.12, 0.3))[..., None] * np.ones(3)
    azimuth = rng.uniform(0, 2 * np.pi)
    for k in range(int(rng.integers(1, 4))):
        angle = azimuth + 0.7 * k
        towards = np.array([np.cos(angle), np.sin(angle), rng.uniform(0.3, 0.7)])
        towards = towards / np.linalg.norm(towards)
        half = rng.uniform(0.15, 0.35, 2)
        pane = _panel(d, towards, half, rng) - _panel(d, towards, half * [0.06, 1.0], rng)
        sky = np.array([0.85, 0.95, 1.1]) * rng.uniform(0.7, 1.0)
        light = light + np.clip(pane, 0, 1)[..., None] * sky * (0.4 + 0.6 * _smooth(d[..., 2], 0.2, 0.5))[..., None]
    return light


def _dim_lab(d: Array, rng: np.random.Generator) -> Array:
    """A dim room, one far ceiling lamp and a monitor."""
    light = _room(d, rng, rng.uniform(0.1, 0.25), rng.uniform(0.15, 0.35))
    light = light + _panel(d, _towards(rng, 40, 75), rng.uniform(0.03, 0.12, 2), rng)
    return light + rng.uniform(0.2, 0.6) * _panel(d, _towards(rng, 5, 30), rng.uniform(0.08, 0.25, 2), rng)


def _ring(d: Array, rng: np.random.Generator) -> Array:
    """A ring light round the camera in a dim room."""
    angle = np.degrees(np.arccos(np.clip(d[..., 2], -1, 1)))
    middle, half = rng.uniform(8, 30), rng.uniform(1.5, 5)
    ring = _smooth(half - np.abs(angle - middle), -0.5, 0.5)
    azimuth = np.arctan2(d[..., 1], d[..., 0])
    leds = int(rng.integers(0, 2)) * int(rng.integers(12, 48))
    ring = ring * (1 if leds == 0 else 0.6 + 0.4 * np.cos(leds * azimuth))
    return _room(d, rng, rng.uniform(0.04, 0.12), rng.uniform(0.04, 0.15)) + ring


KINDS: tuple[Callable[[Array, np.random.Generator], Array], ...] = (
    _tent,
    _soft_boxes,
    _strips,
    _windows,
    _dim_lab,
    _ring,
)
