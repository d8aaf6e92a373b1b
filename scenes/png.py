"""PNG files, with the settings that suit what is in them: fast to write, and smaller than with the usual ones.

Noise of a sensor leaves nothing to find for a search of repeated strings, so of colours only the difference to their
neighbours is coded; masks are runs; depth repeats from row to row. Measured in docs/render_speed.md.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_LEVEL = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_VALUES = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
_RUNS = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
_STRINGS = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT)
_COLOUR = (*_LEVEL, *_VALUES, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
_MASK = (*_LEVEL, *_RUNS, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
_DEPTH = (*_LEVEL, *_STRINGS, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)


def encode_png(image: NDArray[Any]) -> bytes:
    """The bytes of a PNG file: colours (H, W, 3) uint8 in the order red, green, blue; grey levels (H, W) uint8; depth
    (H, W) uint16; or a mask (H, W) bool, written as 0 and 255.
    """
    pixels: NDArray[Any] = image.view(np.uint8) * np.uint8(255) if image.dtype == np.bool_ else image
    if image.dtype == np.bool_:
        settings = _MASK
    elif image.dtype == np.uint16:
        settings = _DEPTH
    else:
        settings = _COLOUR
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", pixels, settings)
    assert done
    return data.tobytes()
