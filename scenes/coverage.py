"""Antialiasing from coverage: each pixel is shaded once, at its centre, and edges are found by more samples of depth.

A pixel that an edge crosses is the mean of what its samples show, in linear light. A sample has the colour of that
pixel centre round it whose depth it has, so colours do not mix across the edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array

Depth = NDArray[np.float32]
STEP_M = 2e-5
"""Samples of a pixel that differ by less in depth are of one surface. Labels stand 0.05 mm above their board."""
STEP_PER_PIXEL_M = 1e-5
"""Of pixel centres at nearly the depth of a sample the nearer one is taken: this much of depth is worth a pixel."""
_NEIGHBOURS = np.array([[0, 0], *([x, y] for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y)])


def antialias(colours: NDArray[np.uint8], centres: Depth, samples: Depth, offsets: Array) -> NDArray[np.float32]:
    """The picture (H, W, 3) of a window that was drawn with a margin of one pixel on every side.

    ``colours`` (H+2, W+2, 3) and ``centres`` (H+2, W+2) are colour and depth in metres at pixel centres; ``samples``
    (S, H+2, W+2) the depth ``offsets`` (S, 2) pixels right and down of them, within half a pixel.
    """
    picture = colours[1:-1, 1:-1].astype(np.float32)
    centre = centres[1:-1, 1:-1]
    inner = samples[:, 1:-1, 1:-1]
    v, u = np.nonzero(np.maximum(inner.max(axis=0) - centre, centre - inner.min(axis=0)) > STEP_M)
    x, y = u[:, None] + 1 + _NEIGHBOURS[:, 0], v[:, None] + 1 + _NEIGHBOURS[:, 1]
    away = np.linalg.norm(offsets[:, None] - _NEIGHBOURS, axis=-1).astype(np.float32)
    shares = np.zeros((len(v), len(_NEIGHBOURS)), np.float32)
    around = centres[y, x]
    every = np.arange(len(v))
    for depth, distance in zip(inner[:, v, u], away, strict=True):
        cost = np.abs(around - depth[:, None]) + STEP_PER_PIXEL_M * distance
        shares[every, cost.argmin(axis=1)] += np.float32(1 / len(offsets))
    picture[v, u] = np.einsum("pn,pnc->pc", shares, colours[y, x].astype(np.float32))
    return picture
