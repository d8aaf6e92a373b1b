"""Annotated pictures of what perception saw and what the controller chose to do about it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, Intrinsics, apply, inverse
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.silhouette import silhouette_mask

Image = NDArray[np.uint8]

COLOURS = {"inserted": (255, 140, 0), "main": (0, 170, 255), "top": (60, 200, 60)}  # RGB
AXIS_M = 0.003
INSET = 300  # pixels of the frame shown full size around a part
OVERVIEW = 4  # the frame is shown at a quarter of its size


def annotate(
    frame: Frame,
    estimate: FrameEstimate,
    parts: Mapping[str, Part],
    chosen: Array | None = None,
    opening_m: float = 0.0,
) -> Image:
    """The frame with masks, boxes and axes, the chosen grasp, and a full-size inset of every part.

    ``chosen`` is ``T_cam_tcp`` (4, 4) of the grasp to come and ``opening_m`` the opening of the fingers. A part without
    a mask is drawn with the silhouette of its CAD, from ``parts`` by name, at the estimated pose. Returns RGB.
    """
    estimate = replace(estimate, parts=tuple(_with_mask(p, parts, frame.intrinsics) for p in estimate.parts))
    size = frame.intrinsics.width // OVERVIEW, frame.intrinsics.height // OVERVIEW
    overview = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    for part in estimate.parts:
        u, v, w, h = _box(part, frame.intrinsics)
        corner, opposite = (int(u / OVERVIEW), int(v / OVERVIEW)), (int((u + w) / OVERVIEW), int((v + h) / OVERVIEW))
        cv2.rectangle(overview, corner, opposite, _colour(part), 2, cv2.LINE_AA)
        _text(overview, part.part, (corner[0], corner[1] - 6), _colour(part))
    if chosen is not None:
        _draw_grasp(overview, frame.intrinsics.downscaled(OVERVIEW), chosen, opening_m, 1)
    header = f"{len(estimate.parts)} parts   {estimate.tags_seen} tags, {estimate.tag_rms_px:.3f} px rms"
    _text(overview, header, (12, 24), (255, 255, 255))
    insets = [_inset(frame, part, chosen, opening_m) for part in estimate.parts]
    return np.vstack([overview, *_rows(insets, overview.shape[1])])


def save_picture(path: Path, image: Image) -> None:
    """Write an RGB image as JPEG or PNG after the suffix, beside the path and then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    if not cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90]):
        raise OSError(f"cannot write the picture {path}")
    os.replace(temporary, path)


def _with_mask(part: PartEstimate, parts: Mapping[str, Part], camera: Intrinsics) -> PartEstimate:
    if part.mask is not None:
        return part
    mask, origin = silhouette_mask(parts[part.part], part.T_cam_part, camera)
    return replace(part, mask=mask, mask_origin=origin)


def _inset(frame: Frame, part: PartEstimate, chosen: Array | None, opening_m: float) -> Image:
    u, v, w, h = _box(part, frame.intrinsics)
    x0 = int(np.clip(u + (w - INSET) / 2, 0, frame.intrinsics.width - INSET))
    y0 = int(np.clip(v + (h - INSET) / 2, 0, frame.intrinsics.height - INSET))
    image = frame.image[y0 : y0 + INSET, x0 : x0 + INSET].copy()
    camera = frame.intrinsics.crop(x0, y0, INSET, INSET)
    if part.mask is not None:
        mask = _mask_in(part, x0, y0)
        image[mask] = (0.75 * image[mask] + 0.25 * np.array(_colour(part))).astype(np.uint8)
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, _colour(part), 1, cv2.LINE_AA)
    _draw_axes(image, camera, part.T_cam_part)
    if chosen is not None and np.linalg.norm(chosen[:3, 3] - part.T_cam_part[:3, 3]) < 0.012:
        _draw_grasp(image, camera, chosen, opening_m, 2)
    _text(image, f"{part.part} face {part.stable_pose}", (8, 20), _colour(part))
    _text(image, part.verdict if not part.accepted else f"{part.score:.2f}", (8, INSET - 10), (255, 255, 255))
    edge = _colour(part) if part.accepted else (200, 0, 0)
    return np.asarray(cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=edge), np.uint8)


def _rows(insets: Sequence[Image], width: int) -> list[Image]:
    if not insets:
        return []
    size = insets[0].shape[0]
    per_row = max(1, width // size)
    rows = []
    for start in range(0, len(insets), per_row):
        row = np.full((size, width, 3), 32, np.uint8)
        for k, inset in enumerate(insets[start : start + per_row]):
            row[:, k * size : (k + 1) * size] = inset
        rows.append(row)
    return rows


def _box(part: PartEstimate, camera: Intrinsics) -> tuple[int, int, int, int]:
    if part.mask is not None and part.mask.any():
        u, v, w, h = cv2.boundingRect(part.mask.astype(np.uint8))
        return u + part.mask_origin[0], v + part.mask_origin[1], w, h
    u, v = camera.project(part.T_cam_part[:3, 3])
    return int(u) - 80, int(v) - 80, 160, 160


def _mask_in(part: PartEstimate, x0: int, y0: int) -> NDArray[np.bool_]:
    """The part's mask moved into the inset that starts at (x0, y0)."""
    assert part.mask is not None
    out = np.zeros((INSET, INSET), bool)
    v, u = np.nonzero(part.mask)
    u, v = u + part.mask_origin[0] - x0, v + part.mask_origin[1] - y0
    inside = (u >= 0) & (u < INSET) & (v >= 0) & (v < INSET)
    out[v[inside], u[inside]] = True
    return out


def _draw_axes(image: Image, camera: Intrinsics, T_cam_part: Array) -> None:
    points = camera.project(apply(T_cam_part, AXIS_M * np.vstack([np.zeros(3), np.eye(3)])))
    origin = _pixel(points[0])
    for tip, colour in zip(points[1:], ((255, 40, 40), (40, 220, 40), (60, 110, 255)), strict=True):
        cv2.line(image, origin, _pixel(tip), colour, 2, cv2.LINE_AA)


def _draw_grasp(image: Image, camera: Intrinsics, T_cam_tcp: Array, opening_m: float, thickness: int) -> None:
    """Both pads as seen from above: a rectangle each, at the opening of the approach."""
    for side in (-1, 1):
        near, far = side * opening_m / 2, side * (opening_m / 2 + 0.0025)
        corners = np.array([[near, -0.003, 0], [near, 0.003, 0], [far, 0.003, 0], [far, -0.003, 0]])
        outline = camera.project(apply(T_cam_tcp, corners))
        cv2.polylines(image, [np.rint(outline).astype(np.int32)], True, (255, 0, 255), thickness, cv2.LINE_AA)


def grasp_in_camera(T_base_tcp: Array, T_base_board: Array, T_cam_board: Array) -> Array:
    """``T_cam_tcp`` of a grasp given in the robot's base frame."""
    return T_cam_board @ inverse(T_base_board) @ T_base_tcp


def _pixel(p: Array) -> tuple[int, int]:
    return round(float(p[0])), round(float(p[1]))


def _colour(part: PartEstimate) -> tuple[int, int, int]:
    return COLOURS.get(part.part, (230, 230, 0))


def _text(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Text with its baseline at ``at`` on a dark strip."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    u, v = at[0], max(at[1], height + 2)
    strip = image[max(v - height - 3, 0) : v + below, max(u - 3, 0) : u + width + 3]
    strip[:] = strip // 4
    cv2.putText(image, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 1, cv2.LINE_AA)
