"""Masks as COCO's compressed run lengths, made from a small window of a large image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as run_lengths


def encode_runs(window: NDArray[np.bool_], corner: tuple[int, int], shape: tuple[int, int]) -> dict[str, Any]:
    """COCO's compressed run lengths of an image of ``shape`` (H, W) that is false but for a ``window`` at ``corner``.

    Runs go down the columns. Only the window is looked at: a whole frame would take a hundred times longer.
    """
    (height, width), (x, y) = shape, corner
    inside = window[max(0, -y) : max(0, height - y), max(0, -x) : max(0, width - x)]
    columns = np.zeros((inside.shape[1], height), np.int8)
    columns[:, max(0, y) : max(0, y) + inside.shape[0]] = inside.T
    edges = np.flatnonzero(np.diff(columns.ravel(), prepend=np.int8(0), append=np.int8(0))) + max(0, x) * height
    counts = np.diff(np.concatenate([[0], edges, [height * width]]))
    if counts[-1] == 0 and len(counts) > 1:
        counts = counts[:-1]
    coded = run_lengths.frPyObjects({"counts": counts.tolist(), "size": [height, width]}, height, width)
    return {"size": [height, width], "counts": coded["counts"].decode("ascii")}
