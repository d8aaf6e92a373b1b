"""Pictures of what was estimated: silhouette, edges, axes and uncertainty of every part, drawn onto the photograph.

An overview of the frame, and below it an inset of every part at one scale whatever the camera's resolution, so that a
wrong class or a turned pose shows. Another drawing may be added to all of them, such as a grasp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.files import replacing
from cad.parts import Part
from cad.spatial import Array, Intrinsics, apply, inverse
from perception.edges import visible_edges
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.silhouette import silhouette_mask

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
Extra = Callable[[Image, Intrinsics, PartEstimate | None], None]
"""Draws onto an image through its intrinsics; the part is None for the overview."""

COLOURS = {"inserted": (255, 140, 0), "main": (0, 170, 255), "top": (60, 200, 60)}  # RGB
OTHER_COLOUR, WHITE, DECLINED = (230, 230, 0), (255, 255, 255), (200, 0, 0)
AXIS_M = 0.003
INSET = 340  # pixels of an inset's side
BORDER = 2
INSET_M = 0.017  # and what it shows of the table
OVERVIEW_WIDTH = 1368  # pixels, about
ELLIPSE_SIGMAS = 2.0
ELLIPSE_SCALE = 20.0
"""Error ellipses are drawn this many times larger than they are: 2 sigma of 20 um becomes 0.8 mm."""
FINE = 3  # bits of a pixel's fraction that OpenCV draws with


def draw_overlay(frame: Frame, estimate: FrameEstimate, parts: Mapping[str, Part], extra: Extra | None = None) -> Image:
    """The frame reduced, with boxes and classes, and an inset of every part; RGB.

    A part without a mask is drawn with the silhouette of its CAD, from ``parts`` by name, at the estimated pose. All
    insets show ``INSET_M`` of the table. A red box and border mean that the estimate is declined; the inset says why.
    """
    factor = max(1, round(frame.intrinsics.width / OVERVIEW_WIDTH))
    size = frame.intrinsics.width // factor, frame.intrinsics.height // factor
    overview = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    camera = frame.intrinsics.resampled(*size)
    shown = [with_mask(part, parts, frame.intrinsics) for part in estimate.parts]
    for number, part in enumerate(shown):
        u, v, w, h = mask_box(part, frame.intrinsics)
        corner = int(u / factor), int(v / factor)
        opposite = int((u + w) / factor), int((v + h) / factor)
        cv2.rectangle(overview, corner, opposite, colour_of(part) if part.accepted else DECLINED, 2, cv2.LINE_AA)
        draw_text(overview, f"{number} {part.part}", (corner[0], corner[1] - 6), colour_of(part))
    if extra is not None:
        extra(overview, camera, None)
    header = f"{len(shown)} found   {estimate.tags_seen} tags, {estimate.tag_rms_px:.3f} px rms   "
    header += f"ellipses: {ELLIPSE_SIGMAS:.0f} sigma x {ELLIPSE_SCALE:.0f}"
    draw_text(overview, header, (12, 24), WHITE)
    insets = [
        _inset(frame, part, parts[part.part], number, estimate.T_cam_board, extra) for number, part in enumerate(shown)
    ]
    width = max(overview.shape[1], INSET + 2 * BORDER)
    overview = cv2.copyMakeBorder(overview, 0, 0, 0, width - overview.shape[1], cv2.BORDER_CONSTANT)
    return np.vstack([np.asarray(overview, np.uint8), *_rows(insets, width)])


def save_picture(path: Path, image: Image) -> None:
    """Write an RGB image as JPEG or PNG after the suffix; a reader never sees half a file."""
    with replacing(path) as temporary:
        quality = [cv2.IMWRITE_JPEG_QUALITY, 90] if path.suffix in (".jpg", ".jpeg") else []
        if not cv2.imwrite(str(temporary), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality):
            raise OSError(f"cannot write the picture {path}")


def with_mask(part: PartEstimate, parts: Mapping[str, Part], camera: Intrinsics) -> PartEstimate:
    """The estimate with the silhouette of its CAD as its mask where it has none."""
    if part.mask is not None:
        return part
    mask, origin = silhouette_mask(parts[part.part], part.T_cam_part, camera)
    return replace(part, mask=mask, mask_origin=origin)


def mask_box(part: PartEstimate, camera: Intrinsics) -> tuple[int, int, int, int]:
    """First pixel, width and height of the mask, or of a square round the part's origin where there is none."""
    if part.mask is not None and part.mask.any():
        u, v, w, h = cv2.boundingRect(part.mask.astype(np.uint8))
        return u + part.mask_origin[0], v + part.mask_origin[1], w, h
    u, v = camera.project(part.T_cam_part[:3, 3])
    return int(u) - 80, int(v) - 80, 160, 160


def colour_of(part: PartEstimate) -> Colour:
    """RGB of the part's class."""
    return COLOURS.get(part.part, OTHER_COLOUR)


def draw_text(image: Image, text: str, at: tuple[int, int], colour: Colour) -> None:
    """Text with its baseline at ``at`` on a dark strip, kept inside of the image."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    u, v = max(min(at[0], image.shape[1] - width - 3), 3), max(at[1], height + 2)
    strip = image[max(v - height - 3, 0) : v + below, max(u - 3, 0) : u + width + 3]
    strip[:] = strip // 4
    cv2.putText(image, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def draw_axes(image: Image, camera: Intrinsics, T_cam_part: Array) -> None:
    """X red, y green, z blue, 3 mm long."""
    ends = apply(T_cam_part, AXIS_M * np.vstack([np.zeros(3), np.eye(3)]))
    for tip, colour in zip((1, 2, 3), ((255, 40, 40), (40, 220, 40), (60, 110, 255)), strict=True):
        draw_lines(image, camera, [ends[[0, tip]]], colour, 2)


def draw_lines(
    image: Image, camera: Intrinsics, lines: Sequence[Array], colour: Colour, thickness: int = 1, closed: bool = False
) -> None:
    """Polygons through points (N, 3) in ``cam``."""
    fixed = [np.rint(camera.project(points) * 2**FINE).astype(np.int32) for points in lines]
    cv2.polylines(image, fixed, closed, colour, thickness, cv2.LINE_AA, FINE)


def draw_edges(image: Image, camera: Intrinsics, part: Part, estimate: PartEstimate, colour: Colour) -> None:
    """The edges inside of the part's outline that its CAD shows at the estimated pose, as dots of a pixel."""
    T_cam_rest = estimate.T_cam_part @ inverse(part.stable_poses[estimate.stable_pose].T_table_part)
    eye = inverse(T_cam_rest)[:3, 3]
    if eye[2] <= 0:
        return  # the estimate is of another face than the one named: there is nothing to compare with
    samples = visible_edges(part, estimate.stable_pose, eye)
    inner = apply(T_cam_rest, samples.points[~samples.outline])
    u, v = np.rint(camera.project(inner)).astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    image[v[inside], u[inside]] = colour


def draw_error_ellipse(image: Image, camera: Intrinsics, estimate: PartEstimate, T_cam_board: Array) -> None:
    """The 2-sigma ellipse of the origin's place on the board, ``ELLIPSE_SCALE`` times enlarged, in white."""
    R = T_cam_board[:3, :3]
    planar = (R.T @ estimate.covariance[:3, :3] @ R)[:2, :2]
    variances, axes = np.linalg.eigh(planar)
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    radii = ELLIPSE_SCALE * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radii @ axes.T  # (48, 2) on the board
    points = estimate.T_cam_part[:3, 3] + np.pad(circle, ((0, 0), (0, 1))) @ R.T
    draw_lines(image, camera, [points], WHITE, 1, closed=True)


def _inset(
    frame: Frame, estimate: PartEstimate, part: Part, number: int, T_cam_board: Array, extra: Extra | None
) -> Image:
    image, camera = _window(frame, estimate)
    colour = colour_of(estimate)
    mask, origin = silhouette_mask(part, estimate.T_cam_part, camera)
    if mask.any():
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=origin)
        cv2.drawContours(image, outline, -1, colour, 1, cv2.LINE_AA)
        draw_edges(image, camera, part, estimate, colour)
    draw_axes(image, camera, estimate.T_cam_part)
    draw_error_ellipse(image, camera, estimate, T_cam_board)
    if extra is not None:
        extra(image, camera, estimate)
    draw_text(image, f"{number} {estimate.part} face {estimate.stable_pose}", (8, 18), colour)
    sigma_um = 1e6 * float(np.sqrt(max(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1], 0.0)))
    verdict = f"{estimate.verdict}, {estimate.score:.2f}" if estimate.accepted else estimate.verdict
    poses = f" ({len(estimate.alternatives)} poses)" if len(estimate.alternatives) > 1 else ""
    draw_text(image, f"{verdict}{poses}   {sigma_um:.0f} um", (8, INSET - 10), WHITE)
    edge = colour if estimate.accepted else DECLINED
    return np.asarray(
        cv2.copyMakeBorder(image, BORDER, BORDER, BORDER, BORDER, cv2.BORDER_CONSTANT, value=edge), np.uint8
    )


def _window(frame: Frame, estimate: PartEstimate) -> tuple[Image, Intrinsics]:
    """What is ``INSET_M`` wide round the middle of the part's mask, ``INSET`` pixels wide, and its intrinsics."""
    k = frame.intrinsics
    side = min(max(2, round(INSET_M * k.fx / float(estimate.T_cam_part[2, 3]))), k.width, k.height)
    u, v, w, h = mask_box(estimate, k)
    x0 = int(np.clip(u + (w - side) / 2, 0, k.width - side))
    y0 = int(np.clip(v + (h - side) / 2, 0, k.height - side))
    window = frame.image[y0 : y0 + side, x0 : x0 + side]
    how = cv2.INTER_AREA if side > INSET else cv2.INTER_CUBIC
    image = np.array(cv2.resize(window, (INSET, INSET), interpolation=how), np.uint8)
    return image, k.crop(x0, y0, side, side).resampled(INSET, INSET)


def _rows(insets: Sequence[Image], width: int) -> list[Image]:
    if not insets:
        return []
    size = insets[0].shape[0]
    per_row = width // size
    rows = []
    for start in range(0, len(insets), per_row):
        row = np.full((size, width, 3), 32, np.uint8)
        for k, inset in enumerate(insets[start : start + per_row]):
            row[:, k * size : (k + 1) * size] = inset
        rows.append(row)
    return rows
