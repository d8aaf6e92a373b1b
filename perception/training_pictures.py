"""What a network says of some validation images while it is still learning: one small sheet a network.

The truth is drawn in green, the network's answer in red.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import planar
from cad.spatial import Array, Intrinsics
from perception.augment import CROP
from perception.classifier import JointClassifier, classify, modes
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.planar import on_plane
from perception.pvnet import PVNet, infer_votes
from perception.segmentation import Segmenter
from perception.silhouette import render_view
from perception.voting import offset_vote
from perception.windows import Window

Picture = NDArray[np.uint8]

SHOWN = 12
COLUMNS = 6
ENLARGED = 2
TRUTH, ANSWER = (40, 220, 40), (255, 60, 60)


def some(crops: CropSet, labels: CropLabels, count: int = SHOWN) -> NDArray[np.int64]:
    """Numbers of ``count`` crops with a part, evenly spread."""
    has = np.flatnonzero(labels.has_part)
    return has[np.linspace(0, len(has) - 1, min(count, len(has))).astype(np.int64)]


def classifier_sheet(model: JointClassifier, crops: CropSet, labels: CropLabels, table: FaceTable) -> Picture:
    """Crops with the outline of the part in the likeliest reading, and that of the true one."""
    rows = some(crops, labels)
    answer, truth = classify(model, crops.images[rows], labels.ray[rows]), crops.labels(table.parts)
    tiles = []
    for i, log, centre in zip(rows, answer.log_probability, answer.centre, strict=True):
        tile, camera, T_cam_table = _enlarged(crops.images[i]), _camera(crops.K[i]), truth.T_cam_table[i]
        at = float(truth.x[i]), float(truth.y[i]), float(truth.yaw[i])
        _outline(tile, table, int(labels.face[i]), at, T_cam_table, camera, TRUTH)
        face, yaw, _ = modes(log, 1)[0]
        x, y = on_plane(centre, table[face].middle_m, camera, T_cam_table)[:2]
        _outline(tile, table, face, (float(x), float(y), yaw), T_cam_table, camera, ANSWER)
        tiles.append(tile)
    return sheet(tiles)


def keypoints_sheet(model: PVNet, crops: CropSet, labels: CropLabels, table: FaceTable) -> Picture:
    """Crops with the keypoints voted for, joined to where they are."""
    del table
    rows, tiles = some(crops, labels), []
    votes_of = infer_votes(model, crops.images[rows], labels.ray[rows], labels.face[rows])
    for i, votes in zip(rows, votes_of, strict=True):
        tile = _enlarged(crops.images[i])
        voted, _ = offset_vote(votes["pixels"], votes["offset"], votes["log_scale"])
        distances = np.linalg.norm(labels.keypoints[i] - voted, axis=-1).mean(axis=1)
        for there, here in zip(labels.keypoints[i][distances.argmin()], voted, strict=True):
            a, b = _pixel(there), _pixel(here)
            cv2.line(tile, a, b, ANSWER, 1, cv2.LINE_AA)
            cv2.circle(tile, a, 3, TRUTH, -1, cv2.LINE_AA)
            cv2.circle(tile, b, 2, ANSWER, -1, cv2.LINE_AA)
        tiles.append(tile)
    return sheet(tiles)


def segmentation_sheet(segmenter: Segmenter, windows: Sequence[Window]) -> Picture:
    """Windows with the outlines of the true and of the detected instances, these with class and score."""
    tiles = []
    for window in windows:
        tile = window.image.copy()
        for k in range(len(window.centres)):
            _draw_outline(tile, window.instances == k + 1, (0, 0), TRUTH)
        for found in segmenter.detect_reduced(window.image):
            _draw_outline(tile, found.mask, found.mask_origin, ANSWER)
            name = segmenter.part_names[int(found.class_probabilities.argmax())]
            at = (found.mask_origin[0], max(9, found.mask_origin[1] - 3))
            cv2.putText(tile, f"{name} {found.score:.2f}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.33, ANSWER, 1, cv2.LINE_AA)
        tiles.append(tile)
    return sheet(tiles, columns=3)


def sheet(tiles: Sequence[Picture], columns: int = COLUMNS) -> Picture:
    """Tiles of one size in rows of ``columns``, with thin white lines between."""
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    out = np.full((rows * (height + 2), columns * (width + 2), 3), 255, np.uint8)
    for k, tile in enumerate(tiles):
        v, u = (k // columns) * (height + 2), (k % columns) * (width + 2)
        out[v : v + height, u : u + width] = tile
    return out


def save_picture(path: Path, picture: Picture) -> None:
    """Write an RGB picture (H, W, 3) as PNG, under another name until it is whole."""
    aside = path.with_name(f".{path.stem}.part.png")
    cv2.imwrite(str(aside), picture[..., ::-1])
    os.replace(aside, path)


def _enlarged(crop: Picture) -> Picture:
    return np.asarray(cv2.resize(crop, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC), np.uint8)


def _pixel(uv: Array) -> tuple[int, int]:
    u, v = (ENLARGED * (np.asarray(uv) + 0.5) - 0.5).round().astype(int)
    return int(u), int(v)


def _camera(K: Array) -> Intrinsics:
    return Intrinsics(width=CROP, height=CROP, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])


def _outline(
    tile: Picture,
    table: FaceTable,
    face: int,
    at: tuple[float, float, float],
    T_cam_table: Array,
    camera: Intrinsics,
    colour: tuple[int, int, int],
) -> None:
    """Draw the outline of a part that rests on a face at (x, y, yaw)."""
    T_cam_part = T_cam_table @ planar(*at) @ table[face].stable_pose.T_table_part
    large = camera.resampled(ENLARGED * CROP, ENLARGED * CROP)
    _draw_outline(tile, render_view(table[face].part, T_cam_part, large).mask, (0, 0), colour)


def _draw_outline(
    tile: Picture, mask: NDArray[np.bool_], origin: tuple[int, int], colour: tuple[int, int, int]
) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE, offset=origin)
    cv2.drawContours(tile, contours, -1, colour, 1)
