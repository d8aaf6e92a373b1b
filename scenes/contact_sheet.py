"""A picture of what the ranges of a data set do: a row for each, from low to high, then images drawn from all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.image_maker import ENVIRONMENTS, TEXTURES, WORN_TAGS, ImageMaker, LabelledImage
from scenes.sheet_rows import COLUMNS, TILE, Image, Row, RowMaker, SheetRanges

ROWS = 27
"""Rows that vary one range each; one more in a physically based domain, one less where all parts are alike."""
DRAWN_ROWS = 4
"""Rows of images drawn from all ranges; the contours of their labels are marked on every other one."""
CAPTION_PX, GAP_PX = 156, 2
LINE_PX, FONT, FONT_SCALE = 16, cv2.FONT_HERSHEY_SIMPLEX, 0.4
PAPER, INK, CONTOUR = 255, (0, 0, 0), (0, 255, 0)
SUFFIXES = (".png", ".jpg", ".jpeg")
JPEG_QUALITY = 80


def contact_sheet(config: DatasetConfig, *, progress: Callable[[float], None] | None = None) -> Image:
    """The sheet (H, W, 3) of a data set's domain, split and parts; ``progress`` hears of the share that is done.

    Rows vary one range each. They show crops whatever the kind; the images at the end are the data set's first. Raises
    SceneError when the domain cannot be drawn.
    """
    report = progress or (lambda share: None)
    maker = ImageMaker(config)
    ranges = SheetRanges(
        look=config.look_ranges,
        view=config.view_ranges,
        sensor=config.sensor,
        lens=config.lens,
        textures=TEXTURES,
        environments=0 if config.domain == "classic" else ENVIRONMENTS,
        worn=WORN_TAGS,
        physical=config.domain != "classic",
    )
    strips = []
    try:
        for row in RowMaker(maker.stage, config.load_parts(), ranges).rows():
            strips.append(_strip(row))
            report(min(len(strips), ROWS) / (ROWS + DRAWN_ROWS))
        for k in range(DRAWN_ROWS):
            drawn = [maker.make(index) for index in range(k * COLUMNS, (k + 1) * COLUMNS)]
            tiles = [_fitted(_marked(image) if i % 2 else image.image) for i, image in enumerate(drawn)]
            caption = ("drawn from all", "ranges; labels on", "every other one") if k == 0 else ()
            strips.append(_strip(Row(caption=caption, tiles=tiles)))
            report(1 - (DRAWN_ROWS - 1 - k) / (ROWS + DRAWN_ROWS))
    finally:
        maker.close()
    return _columns(strips)


def write_contact_sheet(config: DatasetConfig, out: Path, *, progress: Callable[[float], None] | None = None) -> None:
    """Write the sheet as PNG or JPEG, whichever ``out`` is named; raises SceneError when that cannot be done."""
    if out.suffix.lower() not in SUFFIXES:
        raise SceneError(f"{out}: a contact sheet is a picture; name it {', '.join(SUFFIXES)}")
    sheet = contact_sheet(config, progress=progress)
    options = [] if out.suffix.lower() == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    ok, data = cv2.imencode(out.suffix.lower(), sheet[..., ::-1], options)
    assert ok
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(data.tobytes())
    except OSError as error:
        raise SceneError(f"cannot write {out}: {error}") from error


def _columns(strips: list[Image]) -> Image:
    """Two columns of strips."""
    half = -(-len(strips) // 2)
    strips = strips + [np.full_like(strips[0], PAPER)] * (2 * half - len(strips))
    return np.hstack([np.vstack(strips[:half]), np.vstack(strips[half:])])


def _strip(row: Row) -> Image:
    """Caption and tiles side by side, with a gap round each."""
    strip = np.full((TILE + GAP_PX, CAPTION_PX + COLUMNS * (TILE + GAP_PX), 3), PAPER, np.uint8)
    top = (TILE - LINE_PX * (len(row.caption) - 1)) // 2 + 4
    for k, line in enumerate(row.caption):
        cv2.putText(strip, line, (6, top + k * LINE_PX), FONT, FONT_SCALE, INK, 1, cv2.LINE_AA)
    for k, tile in enumerate(row.tiles):
        x = CAPTION_PX + k * (TILE + GAP_PX)
        strip[:TILE, x : x + TILE] = tile
    return strip


def _marked(image: LabelledImage) -> Image:
    """The image with the contour of every part's visible pixels."""
    marked = np.ascontiguousarray(image.image.copy())
    for annotation in image.annotations:
        mask = annotation.mask_visible(marked.shape[:2]).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(marked, contours, -1, CONTOUR, max(1, marked.shape[1] // 200))
    return marked


def _fitted(image: NDArray[np.uint8]) -> Image:
    """The image in a tile, smaller if need be, on paper."""
    height, width = image.shape[:2]
    scale = min(TILE / width, TILE / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    tile = np.full((TILE, TILE, 3), PAPER, np.uint8)
    y, x = (TILE - size[1]) // 2, (TILE - size[0]) // 2
    tile[y : y + size[1], x : x + size[0]] = small
    return tile
