"""Masks as COCO's compressed run lengths, made from a small window of a large image, and what is asked of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as run_lengths

from cad.spatial import Array

RunLengths = dict[str, Any]
"""``size`` [height, width] of the whole image and ``counts``, text."""


def encode_runs(window: NDArray[np.bool_], corner: tuple[int, int], shape: tuple[int, int]) -> RunLengths:
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


def area_of(runs: RunLengths) -> int:
    """Number of true pixels."""
    return int(run_lengths.area(runs))  # pyright: ignore[reportArgumentType]


def box_of(runs: RunLengths) -> tuple[float, float, float, float]:
    """COCO's box (x, y, width, height) round the true pixels; all 0 when there are none."""
    x, y, width, height = (float(c) for c in run_lengths.toBbox(runs))  # pyright: ignore[reportArgumentType]
    return x, y, width, height


def overlaps(a: Sequence[RunLengths], b: Sequence[RunLengths], *, of_a: bool = False) -> Array:
    """Shared pixels (A, B) of masks of one size over those of both or, with ``of_a``, over those of the first alone."""
    if not a or not b:
        return np.zeros((len(a), len(b)))
    over_first = np.full(len(b), of_a, np.uint8)
    shares = run_lengths.iou(list(a), list(b), over_first)  # pyright: ignore[reportArgumentType, reportCallIssue]
    return np.nan_to_num(np.asarray(shares, np.float64))


def merged(masks: Sequence[RunLengths], *, intersect: bool = False) -> RunLengths:
    """Union or intersection of masks of one size; at least one."""
    whole = run_lengths.merge(list(masks), intersect=intersect)  # pyright: ignore[reportArgumentType, reportCallIssue]
    return {"size": list(whole["size"]), "counts": bytes(whole["counts"]).decode("ascii")}  # pyright: ignore[reportArgumentType]
