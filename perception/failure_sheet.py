"""A contact sheet of failures: crops of the frames with the true silhouette in green and the estimated one in red.

An arrow along the part's x axis, of the silhouette's colour, tells poses apart whose silhouettes are alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.files import replacing
from cad.parts import Part
from cad.spatial import Array, Intrinsics, apply
from perception.estimates import Frame
from perception.evaluate import Found, FrameRecord, outcomes_of
from perception.failure_kinds import KINDS, failure_kind, worst_failures
from perception.ground_truth import FrameTruth, GroundTruth
from perception.outcomes import Outcome
from perception.silhouette import silhouette_mask

Image = NDArray[np.uint8]

GREEN, RED, WHITE, GREY, DARK = (40, 220, 40), (255, 50, 50), (255, 255, 255), (170, 170, 170), 24
TILE_PX, CAPTION_PX, BORDER_PX, COLUMNS = 256, 40, 2, 6
TILE_M = 0.017
"""What a tile shows of the table."""
SIDE_PX = (16, 2048)
"""Smallest and largest side of a tile's window in the frame: raw poses may be at any distance."""
_ARROW_M = 0.004
_FINE = 3  # bits of a pixel's fraction that OpenCV draws with


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedPart:
    """A part and where it is, ``T_cam_part`` (4, 4)."""

    part: Part
    T_cam_part: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Failure:
    """One failure: two lines of ``caption``, what is there and what was estimated, at least one of them.

    ``accepted`` failures get a red frame.
    """

    caption: tuple[str, str]
    accepted: bool
    true: PosedPart | None
    estimated: PosedPart | None


def failure_tile(frame: Frame, failure: Failure) -> Image:
    """The frame round a failure, brought to one scale, RGB, with its caption below.

    Raises ValueError when there is neither a true nor an estimated pose.
    """
    centre = failure.true or failure.estimated
    if centre is None:
        raise ValueError(f"failure {failure.caption}: neither a true nor an estimated pose")
    p_cam = apply(centre.T_cam_part, centre.part.mesh.bounds.mean(axis=0))
    side = int(np.clip(TILE_M * frame.intrinsics.fx / max(p_cam[2], 1e-3), *SIDE_PX))
    u, v = (int(c) for c in np.round(frame.intrinsics.project(p_cam)) - side // 2)
    camera = frame.intrinsics.crop(u, v, side, side).resampled(TILE_PX, TILE_PX)
    image = _window(frame.image, u, v, side)
    how = cv2.INTER_AREA if side > TILE_PX else cv2.INTER_LINEAR
    tile = np.asarray(cv2.resize(image, (TILE_PX, TILE_PX), interpolation=how), np.uint8)
    for posed, colour in ((failure.true, GREEN), (failure.estimated, RED)):
        if posed is not None:
            _draw_pose(tile, camera, posed, colour)
    caption = np.full((CAPTION_PX, TILE_PX, 3), DARK, np.uint8)
    for line, (text, colour) in enumerate(zip(failure.caption, (WHITE, GREY), strict=True)):
        cv2.putText(caption, text, (5, 15 + 18 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
    whole = np.vstack([tile, caption])
    framed = np.full(np.add(whole.shape, (2 * BORDER_PX, 2 * BORDER_PX, 0)), DARK, np.uint8)
    if failure.accepted:
        framed[:] = RED
    framed[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = whole
    return framed


def write_failure_sheet(path: Path, title: str, tiles: Sequence[Image]) -> None:
    """Write the tiles, six a row, below a title; without tiles the title says that there are none."""
    width, height = TILE_PX + 2 * BORDER_PX, TILE_PX + CAPTION_PX + 2 * BORDER_PX
    columns = max(4, min(COLUMNS, len(tiles)))
    rows = -(-len(tiles) // columns)
    sheet = np.full((34 + rows * height, columns * width, 3), DARK, np.uint8)
    said = title if tiles else f"{title}: none"
    cv2.putText(sheet, said, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.55, WHITE, 1, cv2.LINE_AA)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        top, left = 34 + row * height, column * width
        sheet[top : top + height, left : left + width] = tile
    with replacing(path) as temporary:
        if not cv2.imwrite(str(temporary), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
            raise OSError(f"cannot write the picture {path}")


def write_failures(path: Path, truth: GroundTruth, records: Sequence[FrameRecord], most: int = 48) -> None:
    """Show the worst failures of one method, all of ``truth``'s frames in ``records``: ``most`` of them, each kind."""
    outcomes = outcomes_of(records)
    frames = {frame.image: frame for frame in truth.frames}
    poses = {record.image: record.poses for record in records}
    parts = {part.name: part for part in truth.parts}
    worst = worst_failures(outcomes, most)
    tiles: dict[int, Image] = {}
    for image in sorted({outcome.image for _, outcome in worst}):
        frame = frames[image].frame()
        for k, (kind, outcome) in enumerate(worst):
            if outcome.image == image:
                failure = _failure(kind, outcome, frames[image], poses[image], parts)
                tiles[k] = failure_tile(frame, failure)
    counts = Counter(kind for o in outcomes if (kind := failure_kind(o)) is not None)
    said = ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
    shown = "" if len(worst) == counts.total() else f" ({len(worst)} shown)"
    method, n = records[0].method, sum(o.whole and o.is_part for o in outcomes)
    title = f"{method}, {truth.domain}, {n} parts: {said}{shown}" if said else f"{method}, {truth.domain}, {n} parts"
    write_failure_sheet(path, title, [tiles[k] for k in sorted(tiles)])


def _failure(
    kind: str, outcome: Outcome, frame: FrameTruth, poses: Sequence[Found], parts: Mapping[str, Part]
) -> Failure:
    """What is to be drawn of an outcome; its pose is the one of its class and score."""
    true = [p for p in frame.parts if p.number == outcome.instance]
    seen = parts.get(outcome.estimated_part)
    found = [p for p in poses if seen is not None and (p.obj_id, p.score) == (seen.obj_id, outcome.score)]
    was = f"{outcome.part} {outcome.stable_pose}" if true else "no part"
    told = f"{outcome.estimated_part} {outcome.estimated_stable_pose}" if seen else "nothing"
    where = f"image {outcome.image}" + (f" instance {outcome.instance}" if true else "")
    verdict = f"{outcome.verdict} {outcome.score:.2f}" if seen else f"{outcome.visible_share:.0%} visible"
    return Failure(
        caption=(f"{kind}: {was}, taken for {told}", f"{where}, {verdict}"),
        accepted=outcome.accepted,
        true=PosedPart(part=true[0].part, T_cam_part=true[0].T_cam_part) if true else None,
        estimated=PosedPart(part=seen, T_cam_part=found[0].T_cam_part) if seen and found else None,
    )


def _window(image: Image, u: int, v: int, side: int) -> Image:
    """The square window from (u, v) on; black where it reaches beyond the image."""
    height, width = image.shape[:2]
    out = np.zeros((side, side, 3), np.uint8)
    u0, v0, u1, v1 = max(u, 0), max(v, 0), min(u + side, width), min(v + side, height)
    if u1 > u0 and v1 > v0:
        out[v0 - v : v1 - v, u0 - u : u1 - u] = image[v0:v1, u0:u1]
    return out


def _draw_pose(tile: Image, camera: Intrinsics, posed: PosedPart, colour: tuple[int, int, int]) -> None:
    """Outline, twice as finely as the tile, and the arrow along x; nothing where the pose is behind the camera."""
    depth = apply(posed.T_cam_part, posed.part.mesh.vertices)[:, 2]
    if depth.min() <= 0:
        return
    fine = camera.resampled(2 * TILE_PX, 2 * TILE_PX)
    mask, (u, v) = silhouette_mask(posed.part, posed.T_cam_part, fine)
    outlines, _ = cv2.findContours(np.pad(mask, 1).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        at = ((outline.reshape(-1, 2) - 1 + [u, v] + 0.5) / 2 - 0.5) * 2**_FINE
        cv2.polylines(tile, [np.rint(at).astype(np.int32)], True, colour, 1, cv2.LINE_AA, _FINE)
    middle = posed.part.mesh.bounds.mean(axis=0)
    ends = camera.project(apply(posed.T_cam_part, middle + np.array([[0.0, 0.0, 0.0], [_ARROW_M, 0.0, 0.0]])))
    start, tip = (tuple(int(c) for c in np.rint(end)) for end in ends)
    cv2.arrowedLine(tile, start, tip, colour, 1, cv2.LINE_AA, tipLength=0.25)
