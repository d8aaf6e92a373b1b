"""The image sensor: exposure, uneven light, blur, photon and read noise, quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scenes.errors import SceneError


@dataclass(frozen=True, kw_only=True)
class SensorConfig:
    """One setting of the sensor, stated for the full-resolution frame.

    ``gain`` multiplies grey levels; ``gradient`` (2,) is the relative change of brightness from the middle of the image
    to its right and lower border. ``blur_px`` is the sigma of the optical blur. The noise variance of a grey level g is
    ``read_noise ** 2 + shot_noise * g``: by default 1 level, as an IMX183 at low gain with about 15,000 electrons full
    well gives (256 levels / 15,000 electrons = 0.017 levels of variance for each level).
    """

    gain: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)
    blur_px: float = 0.6
    shot_noise: float = 0.017
    read_noise: float = 0.5

    def __post_init__(self) -> None:
        if self.gain <= 0 or min(self.blur_px, self.shot_noise, self.read_noise) < 0:
            raise SceneError(f"gain must be positive and blur and noise not negative: {self}")


def expose(
    image: NDArray[np.uint8] | NDArray[np.float32],
    sensor: SensorConfig,
    rng: np.random.Generator,
    downscale: float = 1.0,
) -> NDArray[np.uint8]:
    """What the sensor reads of an ideal image (H, W, 3), grey levels.

    ``downscale`` is the factor by which the image is smaller than the full-resolution frame: averaging over
    ``downscale`` x ``downscale`` pixels narrows blur and noise by that factor.
    """
    levels = image.astype(np.float32)
    if sensor.gain != 1.0 or any(sensor.gradient):
        height, width = image.shape[:2]
        across = 1 + sensor.gradient[0] * np.linspace(-1, 1, width, dtype=np.float32)
        down = 1 + sensor.gradient[1] * np.linspace(-1, 1, height, dtype=np.float32)
        levels *= np.float32(sensor.gain) * (down[:, None] * across)[..., None]
    sigma = sensor.blur_px / downscale
    if sigma > 0.15:
        levels = cv2.GaussianBlur(levels, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101)
    if sensor.shot_noise or sensor.read_noise:
        np.clip(levels, 0, 255, out=levels)
        noise = rng.standard_normal(levels.shape, dtype=np.float32)
        noise *= np.sqrt(sensor.read_noise**2 + sensor.shot_noise * levels) / downscale
        levels += noise
    return np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
