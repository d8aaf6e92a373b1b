"""Grey levels on a scale where noise is about as large everywhere: what networks see.

Of a sensor's noise, that of the photons grows with the root of the light and that of the electronics stays. Anscombe's
transform, generalised for both (Murtagh et al. 1995), makes the sum constant: f(x) = sqrt(x + c). What lies in a shadow
then differs from its ground by a sizeable part of what separates shadow and light: 14 and 1 of 255 levels become 32
apart instead of 13, while 200 and 255 move from 55 to 35.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

DARK_LEVELS = 8.0
"""c: the level of light whose photons are as noisy as the electronics, for a camera with some gain."""
_SCALE = 255.0 / (np.sqrt(255.0 + DARK_LEVELS) - np.sqrt(DARK_LEVELS))


def encode(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels 0 to 255 in proportion to light, of any shape, to 0 to 255 in proportion to what can be told apart."""
    return np.asarray(_SCALE * (np.sqrt(levels + np.float32(DARK_LEVELS)) - np.sqrt(DARK_LEVELS)), np.float32)


_TABLE = encode(np.arange(256, dtype=np.float32))


def encoded(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``encode`` of an image (H, W[, 3])."""
    return np.asarray(cv2.LUT(image, _TABLE), np.float32)
