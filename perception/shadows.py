"""Shadows cast over training pictures from outside of them: lamps lower, and things taller, than were rendered."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CORNERS = (3, 7)
"""Corners of a shadow, both ends included."""
DEEPEST, FAINTEST = 0.05, 0.9
"""Brightness that is left in a shadow."""


def shadow(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Factors (H, W) of the brightness: one shadow with a straight-edged outline, more or less soft."""
    middle = rng.uniform(0.0, 1.0, 2) * (width, height)
    reach = rng.uniform(0.1, 0.7) * max(height, width)
    angles = np.sort(rng.uniform(0.0, 2 * np.pi, int(rng.integers(*CORNERS, endpoint=True))))
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1) * rng.uniform(0.3, 1.0, len(angles))[:, None]
    lit = np.ones((height, width), np.float32)
    left = float(np.exp(rng.uniform(np.log(DEEPEST), np.log(FAINTEST))))
    cv2.fillPoly(lit, [np.round(middle + reach * spokes).astype(np.int32)], (left,))
    return np.asarray(cv2.GaussianBlur(lit, (0, 0), float(np.exp(rng.uniform(np.log(0.6), np.log(8.0))))), np.float32)
