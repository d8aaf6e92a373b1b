"""The tagboard: a flat plate with a ring of AprilTag 36h11 labels round a free middle on which parts lie.

Frame ``board``: origin at the centre of the plate's top face, +x along the width, +y along the height, +z up.
Tag family and bit patterns are OpenCV's ``DICT_APRILTAG_36h11``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import CadError
from cad.spatial import Array

DICTIONARY = cv2.aruco.DICT_APRILTAG_36h11
DICTIONARY_SIZE = 587
"""Number of markers in the 36h11 family."""
TAG_CELLS = 8
"""Cells along the black square of a 36h11 tag: six of code and one of border on each side."""
LABEL_CELLS = TAG_CELLS + 2
"""Cells along a label: the black square and a quiet zone of one cell on each side."""


class TagboardError(CadError):
    """A tagboard that cannot be made, or a tag that is not on it."""


@dataclass(frozen=True, kw_only=True)
class TagboardConfig:
    """A ``columns`` x ``rows`` grid of square labels of which only the outermost ring is used.

    Lengths in metres. ``tag_m`` is the side of a tag's black square; the label round it is 10 / 8 of that wide.
    ``edge_m`` is the distance between the plate's edge and the outermost labels. Tags are numbered from ``first_id``,
    row by row from the corner at (-x, +y).
    """

    width_m: float = 0.320
    height_m: float = 0.220
    thickness_m: float = 0.005
    tag_m: float = 0.024
    columns: int = 9
    rows: int = 6
    edge_m: float = 0.001
    first_id: int = 0

    def __post_init__(self) -> None:
        if self.columns < 2 or self.rows < 2:
            raise TagboardError(f"a ring needs at least 2 columns and 2 rows of tags, got {self.columns} x {self.rows}")
        if min(self.width_m, self.height_m, self.thickness_m, self.tag_m) <= 0 or self.edge_m < 0:
            raise TagboardError("plate size and tag_m must be positive and edge_m must not be negative")
        pitch_x, pitch_y = self.pitch_m
        if min(pitch_x, pitch_y) < self.label_m:
            raise TagboardError(
                f"labels of {self.label_m * 1e3:.1f} mm overlap at a pitch of {pitch_x * 1e3:.1f} x "
                f"{pitch_y * 1e3:.1f} mm; use fewer columns or rows, or a smaller tag_m"
            )
        if self.first_id < 0 or self.first_id + self.count > DICTIONARY_SIZE:
            raise TagboardError(
                f"ids {self.first_id}..{self.first_id + self.count - 1} are not all in 0..{DICTIONARY_SIZE - 1}"
            )

    @property
    def label_m(self) -> float:
        """Side of a label: black square and quiet zone."""
        return self.tag_m * LABEL_CELLS / TAG_CELLS

    @property
    def pitch_m(self) -> tuple[float, float]:
        """Distance between the centres of neighbouring labels along x and y."""
        span_x = self.width_m - 2 * self.edge_m - self.label_m
        span_y = self.height_m - 2 * self.edge_m - self.label_m
        return span_x / (self.columns - 1), span_y / (self.rows - 1)

    @property
    def count(self) -> int:
        """Number of tags in the ring."""
        return 2 * self.columns + 2 * self.rows - 4

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of all tags on the board."""
        return tuple(range(self.first_id, self.first_id + self.count))

    @property
    def free_half_extents_m(self) -> tuple[float, float]:
        """Half width and half height of the middle that holds no label."""
        inset = self.edge_m + self.label_m
        return self.width_m / 2 - inset, self.height_m / 2 - inset

    @cached_property
    def _centres(self) -> dict[int, tuple[float, float]]:
        pitch_x, pitch_y = self.pitch_m
        x0, y0 = -pitch_x * (self.columns - 1) / 2, pitch_y * (self.rows - 1) / 2
        ring = [
            (x0 + column * pitch_x, y0 - row * pitch_y)
            for row in range(self.rows)
            for column in range(self.columns)
            if row in (0, self.rows - 1) or column in (0, self.columns - 1)
        ]
        return dict(zip(self.ids, ring, strict=True))

    def centre(self, tag_id: int) -> tuple[float, float]:
        """(x, y) of a tag's centre in ``board``; raises TagboardError for an id that is not on the board."""
        if tag_id not in self._centres:
            raise TagboardError(f"no tag {tag_id} on this board; its ids are {self.ids[0]}..{self.ids[-1]}")
        return self._centres[tag_id]

    def corners(self, tag_id: int) -> Array:
        """(4, 3) corners of a tag's black square in ``board``, in the order in which OpenCV detects them.

        The order is top left, top right, bottom right, bottom left of the printed tag; its top points along +y.
        """
        x, y = self.centre(tag_id)
        h = self.tag_m / 2
        return np.array([[x - h, y + h, 0.0], [x + h, y + h, 0.0], [x + h, y - h, 0.0], [x - h, y - h, 0.0]])

    def texture(self, pixels_per_m: float, background: NDArray[np.uint8] | int = 220) -> NDArray[np.uint8]:
        """The printed board (H, W) or (H, W, 3), row 0 at +y and column 0 at -x, for printing and for figures.

        ``background`` is a grey level or an image (h, w) or (h, w, 3), which is stretched over the plate.
        """
        width, height = round(self.width_m * pixels_per_m), round(self.height_m * pixels_per_m)
        if min(width, height) < 1:
            raise TagboardError(f"{pixels_per_m} pixels a metre leave no pixel of a {self.width_m} m wide board")
        if isinstance(background, np.ndarray):
            board = cv2.resize(background, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        else:
            board = np.full((height, width), background, np.uint8)
        columns = (np.arange(width) + 0.5) / pixels_per_m - self.width_m / 2
        rows = self.height_m / 2 - (np.arange(height) + 0.5) / pixels_per_m
        cell = self.tag_m / TAG_CELLS
        for tag_id in self.ids:
            x, y = self.centre(tag_id)
            i = np.floor((columns - x + self.label_m / 2) / cell).astype(int)
            j = np.floor((y + self.label_m / 2 - rows) / cell).astype(int)
            inside_x, inside_y = (i >= 0) & (i < LABEL_CELLS), (j >= 0) & (j < LABEL_CELLS)
            label = label_image(tag_id, 1)[np.ix_(j[inside_y], i[inside_x])]
            board[np.ix_(inside_y, inside_x)] = label if board.ndim == 2 else label[..., None]
        return board


def label_image(tag_id: int, pixels_per_cell: int) -> NDArray[np.uint8]:
    """One label with its quiet zone: (10 p, 10 p) uint8 where p = ``pixels_per_cell``, 0 black and 255 white."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    label = np.full((LABEL_CELLS, LABEL_CELLS), 255, np.uint8)
    label[1:-1, 1:-1] = cv2.aruco.generateImageMarker(dictionary, tag_id, TAG_CELLS)
    return np.kron(label, np.ones((pixels_per_cell, pixels_per_cell), np.uint8))
