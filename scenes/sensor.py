"""The image sensor after EMVA 1288: exposure, focus, photon and dark noise, colour mosaic, white balance, gamma.

The standard describes a linear camera by its overall system gain K: a pixel that holds n electrons reads K n grey
levels with a variance of K^2 (n + sigma_d^2) + 1 / 12, from photons, dark noise and quantisation. Here a grey level is
one of the 255 of an 8 bit image. Photons are drawn from a normal distribution: a level stands for 60 electrons.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from cad.spatial import BASLER, Intrinsics
from scenes.errors import SceneError

Levels = NDArray[np.float32]
RAW_MAX = 4095
"""Largest value of the 12 bit converter."""
GLINT = 1.5 * 255
"""Metal that mirrors a lamp exceeds this level: nobody sets the exposure by it."""
BAND = 1 << 18
"""Values that are read at once: as many as stay in a core's cache."""
NOTHING = np.zeros(4)
SHARP_PX = 0.15
"""A blur of smaller sigma changes nothing."""


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """One setting of the sensor, stated for the full-resolution frame.

    ``exposure`` multiplies grey levels; ``gradient`` (2,) is the relative change of brightness from the middle of the
    image to its right and lower border. ``blur_px`` is the sigma of the optical blur. The noise variance of a grey
    level g is ``read_noise ** 2 + shot_noise * g``: ``shot_noise`` is the overall system gain K in levels per electron,
    ``read_noise`` the dark noise in levels (see :func:`noise_levels`). By default 0.017, that of 15,000 electrons at
    saturation, and half a level. ``white_balance`` (3,) are the gains that the camera applies to red, green and blue,
    signal and noise. ``bayer`` reads the image through a mosaic that starts with red, and interpolates the colours.
    ``gamma`` is the camera's: output = 255 (level / 255) ** gamma. ``quick`` draws noise from a table of 65,536
    quantiles of the normal distribution, four times faster.
    """

    exposure: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)
    blur_px: float = 0.6
    shot_noise: float = 0.017
    read_noise: float = 0.5
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bayer: bool = False
    gamma: float = 1.0
    quick: bool = False

    def __post_init__(self) -> None:
        for name in ("exposure", "gamma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise SceneError(f"{name} {getattr(self, name)}: must be positive")
        for name in ("blur_px", "shot_noise", "read_noise"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise SceneError(f"{name} {getattr(self, name)}: must not be negative")
        if not all(np.isfinite(gain) and gain > 0 for gain in self.white_balance):
            raise SceneError(f"white_balance {self.white_balance}: every gain must be positive")


def noise_levels(*, saturation_e: float, dark_noise_e: float, analog_gain_db: float = 0.0) -> tuple[float, float]:
    """``shot_noise`` and ``read_noise`` of a sensor that EMVA 1288 characterises in electrons.

    ``saturation_e`` electrons read 255 at 0 dB; with more gain before the converter fewer do.
    """
    K = 255 / saturation_e * 10 ** (analog_gain_db / 20)
    return K, K * dark_noise_e


def mosaic_phase(intrinsics: Intrinsics) -> tuple[int, int]:
    """(row, column) of the first pixel of a full-resolution window in the mosaic's 2 x 2 cell."""
    return round(BASLER.cy - intrinsics.cy) % 2, round(BASLER.cx - intrinsics.cx) % 2


def brightest(image: NDArray[np.uint8] | Levels) -> float:
    """The grey level that a fiftieth of an image (H, W, 3) exceeds, at most GLINT: what exposure is set by."""
    sample = np.ravel(image[::4, ::4])
    k = int(0.98 * (sample.size - 1))
    return min(float(np.partition(sample, k)[k]), GLINT)


def expose(
    image: NDArray[np.uint8] | Levels,
    sensor: SensorConfig,
    rng: np.random.Generator,
    downscale: float = 1.0,
    phase: tuple[int, int] = (0, 0),
) -> NDArray[np.uint8]:
    """What the sensor reads of an ideal image (H, W, 3), grey levels.

    ``downscale`` is the factor by which the image is smaller than the full-resolution frame: averaging over
    ``downscale`` x ``downscale`` pixels narrows blur and noise by that factor. The mosaic is sampled at full resolution
    only, where ``phase`` is the place of the first pixel in it. A pixel of a smaller image averages over all colours of
    the mosaic, which then only means that a quarter of the samples is red, a quarter blue and half of them green.
    """
    levels = image.astype(np.float32)
    if sensor.exposure != 1.0 or any(sensor.gradient):
        _illuminate(levels, sensor)
    sigma = sensor.blur_px / downscale
    if sigma > SHARP_PX:
        cv2.GaussianBlur(levels, (0, 0), sigma, dst=levels, borderType=cv2.BORDER_REFLECT_101)
    noisy = bool(sensor.shot_noise or sensor.read_noise)
    if noisy:
        np.clip(levels, 0, 255, out=levels)
    if sensor.bayer and downscale == 1:
        return _tone(_mosaic(levels, sensor, rng, phase, noisy), sensor.gamma)
    out = np.empty(levels.shape, np.uint8)
    rows = max(1, BAND // levels[0].size)
    for top in range(0, len(out), rows):
        out[top : top + rows] = _read(levels[top : top + rows], sensor, rng, downscale, noisy)
    return out


def _read(
    levels: Levels, sensor: SensorConfig, rng: np.random.Generator, downscale: float, noisy: bool
) -> NDArray[np.uint8]:
    """Noise, colour gains, gamma and 8 bits of some rows of an image, which are changed."""
    if noisy:
        noise = _deviates(levels.shape, sensor, rng)
        noise *= _deviation(levels, sensor, downscale)
        if sensor.bayer:
            _scale(noise, (2.0, 2.0**0.5, 2.0))
        levels += noise
    if sensor.white_balance != (1.0, 1.0, 1.0):
        _scale(levels, sensor.white_balance)
    if sensor.gamma == 1.0:
        return cv2.add(levels, NOTHING, dtype=cv2.CV_8U).view(np.uint8)
    return _tone(_converted(levels), sensor.gamma)


def _illuminate(levels: Levels, sensor: SensorConfig) -> None:
    """Multiply (H, W, 3) in place by exposure and uneven light, along rows and columns one after the other."""
    height, width, colours = levels.shape
    across = 1 + sensor.gradient[0] * np.linspace(-1, 1, width)
    down = sensor.exposure * (1 + sensor.gradient[1] * np.linspace(-1, 1, height))
    levels *= np.asarray(down, np.float32)[:, None, None]
    levels *= np.repeat(np.asarray(across, np.float32), colours).reshape(width, colours)


def _deviation(levels: Levels, sensor: SensorConfig, downscale: float) -> Levels:
    """Standard deviation of the noise of each value."""
    deviation = levels * np.float32(sensor.shot_noise)
    deviation += np.float32(sensor.read_noise**2)
    np.sqrt(deviation, out=deviation)
    if downscale != 1:
        deviation /= np.float32(downscale)
    return deviation


def _deviates(shape: tuple[int, ...], sensor: SensorConfig, rng: np.random.Generator) -> Levels:
    """Standard normal deviates."""
    if not sensor.quick:
        return rng.standard_normal(shape, dtype=np.float32)
    count = int(np.prod(shape))
    words = rng.integers(0, 2**64, -(-count // 4), dtype=np.uint64).view(np.uint16)[:count]
    return cv2.LUT(words.reshape(shape[0], -1), _quantiles()).view(np.float32).reshape(shape)


@cache
def _quantiles() -> Levels:
    """Normal quantiles at the middles of 65,536 equal steps of probability, scaled to unit variance."""
    z = ndtri((np.arange(65536) + 0.5) / 65536)
    return (z / z.std()).astype(np.float32)


def _mosaic(
    levels: Levels, sensor: SensorConfig, rng: np.random.Generator, phase: tuple[int, int], noisy: bool
) -> NDArray[np.uint16]:
    """One colour a pixel, with noise and colour gains, as the converter's values; then all colours by interpolation.

    The image (H, W, 3) is mirrored about its outermost pixels, which keeps the mosaic's order, for two pixels.
    """
    row, column = phase
    raw = np.empty(levels.shape[:2], np.float32)
    cells = [(dy, dx, (dy + row) % 2 + (dx + column) % 2) for dy in (0, 1) for dx in (0, 1)]
    for dy, dx, colour in cells:
        raw[dy::2, dx::2] = levels[dy::2, dx::2, colour]
    if noisy:
        noise = _deviates(raw.shape, sensor, rng)
        noise *= _deviation(raw, sensor, 1.0)
        raw += noise
    for dy, dx, colour in cells:
        raw[dy::2, dx::2] *= np.float32(sensor.white_balance[colour])
    values = _converted(raw)
    top, left = 2 + row, 2 + column
    padded = cv2.copyMakeBorder(values, top, 2, left, 2, cv2.BORDER_REFLECT_101)
    return cv2.cvtColor(padded, cv2.COLOR_BayerRGGB2RGB)[top:-2, left:-2].view(np.uint16)


def _scale(levels: Levels, gains: tuple[float, float, float]) -> None:
    """Multiply the colours of (H, W, 3) in place."""
    cv2.multiply(levels, np.array([*gains, 1.0]), dst=levels)


def _converted(levels: Levels) -> NDArray[np.uint16]:
    """Grey levels as the values of the 12 bit converter."""
    values = cv2.multiply(levels, np.full(4, RAW_MAX / 255), dtype=cv2.CV_16U).view(np.uint16)
    return np.minimum(values, RAW_MAX, out=values)


def _tone(values: NDArray[np.uint16], gamma: float) -> NDArray[np.uint8]:
    """12 bit values to 8 bits through the camera's gamma."""
    curve = np.rint(255 * (np.arange(RAW_MAX + 1) / RAW_MAX) ** gamma).astype(np.uint8)
    return np.take(curve, values)
