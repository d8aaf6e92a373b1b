"""What an image shows: the camera, the window of its frame, and what lies on the board where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cad.spatial import BASLER, Array, Intrinsics, apply, inverse
from cad.tagboard import TagboardConfig
from scenes.distractors import Distractor, distractors
from scenes.errors import SceneError
from scenes.layout import Layout, LayoutRanges, Placed, Shelf
from scenes.randomize import draw_camera
from scenes.ranges import TRAIN_VIEW, Split, ViewRanges
from scenes.rests import Faces, RestPool

__all__ = ["SHOTS", "TEST_SHOTS", "TRAIN_SHOTS", "Placed", "Shot", "ShotRanges", "ShotSampler", "board_point"]

_TRIES = 8


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image to render. ``downscale`` is how much smaller than the full-resolution frame its pixels are.

    ``focus_board`` (x, y) is where the image's centre is on the board; of a crop, where its part is.
    """

    intrinsics: Intrinsics
    downscale: float
    T_board_cam: Array
    focus_board: tuple[float, float]
    parts: tuple[Placed, ...]
    distractors: tuple[Placed, ...]


@dataclass(frozen=True, kw_only=True)
class ShotRanges(LayoutRanges):
    """How many things there are in each kind of image, and where its window is; see the base for how they lie.

    A ``target_share`` of the crops shows a part, within ``centre_jitter_px`` pixels of the full-resolution frame of the
    middle; ``neighbours`` and ``crop_distractors`` are the shares of crops with 0, 1, 2... of them beside it.
    ``window_on_area`` of the windows are centred on the area that parts lie in, the others are anywhere in the frame;
    parts' centres are up to ``window_beyond_m`` outside of the window, so that its border cuts some. The pairs are
    ranges of counts, both ends included; places where there is no room are given up, so there may be fewer.

    Where ``target_share`` is 0, ``empty_beside_px`` may put parts beside the empty middle of crops: as many as
    ``neighbours`` says, their centres that far from it in pixels of the full-resolution frame.
    """

    centre_jitter_px: int = 24
    target_share: float = 0.88
    neighbours: tuple[float, ...] = (0.45, 0.25, 0.2, 0.1)
    crop_distractors: tuple[float, ...] = (0.6, 0.2, 0.12, 0.08)
    crop_crumbs: tuple[int, int] = (0, 1)
    empty_beside_px: tuple[int, int] | None = None
    window_on_area: float = 0.7
    window_beyond_m: float = 0.002
    window_parts: tuple[int, int] = (0, 8)
    window_distractors: tuple[int, int] = (0, 5)
    window_crumbs: tuple[int, int] = (0, 3)
    scene_parts: tuple[int, int] = (3, 14)
    scene_distractors: tuple[int, int] = (0, 8)
    scene_crumbs: tuple[int, int] = (0, 6)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("neighbours", "crop_distractors"):
            shares = getattr(self, name)
            if not shares or min(shares) < 0 or abs(sum(shares) - 1) > 1e-9:
                raise SceneError(f"{name} {shares}: must be shares of 0, 1, 2... things that add up to 1")
        things = [f"{kind}_{thing}" for kind in ("window", "scene") for thing in ("parts", "distractors", "crumbs")]
        for name in (*things, "crop_crumbs"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise SceneError(f"{name} {(low, high)}: must be a range of counts from 0 upwards")
        for name in ("target_share", "window_on_area"):
            if not 0 <= getattr(self, name) <= 1:
                raise SceneError(f"{name} {getattr(self, name)}: must be from 0 to 1")
        if self.empty_beside_px is not None and self.target_share > 0:
            raise SceneError(
                f"empty_beside_px {self.empty_beside_px} and target_share {self.target_share}: a crop's first part "
                "is its target, so only sets without targets show parts beside an empty middle; set target_share to 0"
            )
        if self.empty_beside_px is not None and not 0 < self.empty_beside_px[0] <= self.empty_beside_px[1]:
            raise SceneError(f"empty_beside_px {self.empty_beside_px}: must be a range of pixels above 0")
        if self.centre_jitter_px < 0 or self.window_beyond_m < 0:
            raise SceneError(
                f"centre_jitter_px {self.centre_jitter_px}, window_beyond_m {self.window_beyond_m}: from 0 upwards"
            )

    def most_parts(self, kind: Literal["crop", "window", "scene"]) -> int:
        """The largest number of parts in an image of a kind; all may be of one name."""
        return {"crop": len(self.neighbours), "window": self.window_parts[1], "scene": self.scene_parts[1]}[kind]


TRAIN_SHOTS = ShotRanges()
TEST_SHOTS = ShotRanges(
    area_half_m=(0.115, 0.070),
    gap_m=(0.0015, 0.008),
    touching=0.2,
    close=0.2,
    dust_lean_deg=(0.0, 0.0),
    neighbours=(0.25, 0.3, 0.25, 0.2),
    crop_distractors=(0.4, 0.3, 0.18, 0.12),
    scene_distractors=(2, 10),
)
"""More crowded than training's: parts lie farther out, closer together and more often touching, without dust below."""
SHOTS: dict[Split, ShotRanges] = {"train": TRAIN_SHOTS, "val": TRAIN_SHOTS, "test": TEST_SHOTS}


class ShotSampler:
    """Draws shots of the parts that ``rests`` holds, resting as ``faces`` says, and of distractors.

    The same generator in the same state gives the same shot.
    """

    def __init__(
        self,
        rests: RestPool,
        ranges: ShotRanges = TRAIN_SHOTS,
        view: ViewRanges = TRAIN_VIEW,
        faces: Faces = "physics",
        board: TagboardConfig | None = None,
        others: Mapping[str, Distractor] | None = None,
    ) -> None:
        self._ranges, self._view = ranges, view
        self._faces: Faces = faces
        self._board = board or TagboardConfig()
        free = self._board.free_half_extents_m
        if ranges.area_half_m[0] > free[0] or ranges.area_half_m[1] > free[1]:
            raise SceneError(f"area_half_m {ranges.area_half_m} exceeds the board's free middle {free} m")
        self._shelf = Shelf(rests, distractors() if others is None else others)

    def crop(self, rng: np.random.Generator, size: tuple[int, int] = (256, 256), downscale: int = 1) -> Shot:
        """A window of ``size`` (w, h) pixels, round a part (entry 0) or round none.

        A pixel is as large as ``downscale`` times ``downscale`` of the camera's.
        """
        ranges = self._ranges
        T_board_cam = draw_camera(self._view, rng)
        layout = self._layout(rng)
        if rng.random() < ranges.target_share:
            x, y = self._anywhere(rng)
            layout.add_part(x, y)
            for _ in range(_count(ranges.neighbours, rng)):
                layout.add_beside(x, y, part=True)
        else:
            x, y = self._empty_place(rng)
            if rng.random() < 0.7:
                layout.add_distractor(x, y)
        for _ in range(_count(ranges.crop_distractors, rng)):
            layout.add_beside(x, y, part=False)
        u, v = BASLER.project(apply(inverse(T_board_cam), [x, y, 0.0]))
        jitter = rng.integers(-ranges.centre_jitter_px, ranges.centre_jitter_px + 1, 2)
        width, height = size[0] * downscale, size[1] * downscale
        middle = np.round([u, v]).astype(int) + jitter
        limits = np.array([BASLER.width - width, BASLER.height - height])
        corner = np.clip(middle - np.array([width, height]) // 2, 0, limits)
        window = BASLER.crop(int(corner[0]), int(corner[1]), width, height).downscaled(downscale)
        for _ in range(rng.integers(*ranges.crop_crumbs, endpoint=True)):
            layout.add_crumb(*_place_in(window, T_board_cam, rng))
        if ranges.empty_beside_px is not None:
            low, high = (distance / downscale for distance in ranges.empty_beside_px)
            for _ in range(_count(ranges.neighbours, rng)):
                _add_round_the_middle(layout, window, T_board_cam, (low, high), rng)
        return _shot(window, downscale, T_board_cam, (x, y), layout)

    def window(self, rng: np.random.Generator, size: tuple[int, int] = (320, 320), downscale: int = 4) -> Shot:
        """A window of ``size`` (w, h) pixels of the reduced frame with some parts and distractors in it."""
        ranges = self._ranges
        T_board_cam = draw_camera(self._view, rng)
        frame = BASLER.downscaled(downscale)
        limits = np.array([frame.width - size[0], frame.height - size[1]])
        corner = rng.integers(0, limits, endpoint=True)
        if rng.random() < ranges.window_on_area:
            pixel = frame.project(apply(inverse(T_board_cam), [*self._anywhere(rng), 0.0]))
            corner = np.clip(np.round(pixel - np.array(size) / 2).astype(int), 0, limits)
        window = frame.crop(int(corner[0]), int(corner[1]), *size)
        layout = self._layout(rng)
        beyond = ranges.window_beyond_m * frame.fx / T_board_cam[2, 3]
        for _ in range(rng.integers(*ranges.window_parts, endpoint=True)):
            layout.add_part(*_place_in(window, T_board_cam, rng, beyond))
        for _ in range(rng.integers(*ranges.window_distractors, endpoint=True)):
            layout.add_distractor(*_place_in(window, T_board_cam, rng))
        for _ in range(rng.integers(*ranges.window_crumbs, endpoint=True)):
            layout.add_crumb(*_place_in(window, T_board_cam, rng))
        return _shot(window, downscale, T_board_cam, _middle(window, T_board_cam), layout)

    def frame(self, rng: np.random.Generator, frame: Intrinsics, downscale: float) -> Shot:
        """A whole frame, ``downscale`` times smaller than the camera's: parts all over the area that they lie in, where
        the frame shows it, distractors anywhere on the board.
        """
        ranges = self._ranges
        T_board_cam = draw_camera(self._view, rng)
        T_cam_board = inverse(T_board_cam)
        layout = self._layout(rng)
        for _ in range(rng.integers(*ranges.scene_parts, endpoint=True)):
            for _ in range(_TRIES):
                x, y = self._anywhere(rng)
                u, v = frame.project(apply(T_cam_board, [x, y, 0.0]))
                if 0 <= u < frame.width and 0 <= v < frame.height and layout.add_part(x, y):
                    break
        for _ in range(rng.integers(*ranges.scene_distractors, endpoint=True)):
            layout.add_distractor(*_place_in(frame, T_board_cam, rng))
        for _ in range(rng.integers(*ranges.scene_crumbs, endpoint=True)):
            layout.add_crumb(*_place_in(frame, T_board_cam, rng))
        return _shot(frame, downscale, T_board_cam, _middle(frame, T_board_cam), layout)

    def _layout(self, rng: np.random.Generator) -> Layout:
        return Layout(self._shelf, self._ranges, self._faces, self._board, rng)

    def _anywhere(self, rng: np.random.Generator) -> tuple[float, float]:
        """A place in the area that parts lie in."""
        x, y = rng.uniform(-1, 1, 2) * self._ranges.area_half_m
        return float(x), float(y)

    def _empty_place(self, rng: np.random.Generator) -> tuple[float, float]:
        """A place without a part: round a tag, near the plate's edge or anywhere in the middle."""
        kind = rng.random()
        if kind < 0.3:
            tag = self._board.centre(int(rng.choice(self._board.ids)))
            offset = rng.uniform(-0.6, 0.6, 2) * self._board.label_m
            return float(tag[0] + offset[0]), float(tag[1] + offset[1])
        if kind >= 0.45:
            return self._anywhere(rng)
        x, y = rng.uniform(-1, 1, 2) * (self._board.width_m / 2, self._board.height_m / 2)
        return float(x), float(y)


def board_point(intrinsics: Intrinsics, T_board_cam: Array, pixel: tuple[float, float]) -> tuple[float, float]:
    """Where the ray through a pixel meets the board's face: (x, y) in ``board``."""
    direction = T_board_cam[:3, :3] @ intrinsics.rays(pixel)
    x, y, _ = T_board_cam[:3, 3] - direction * (T_board_cam[2, 3] / direction[2])
    return float(x), float(y)


def _place_in(
    window: Intrinsics, T_board_cam: Array, rng: np.random.Generator, beyond_px: float = 0.0
) -> tuple[float, float]:
    """A place on the board that the window shows, or would if it were wider and higher by ``beyond_px`` all round."""
    u, v = rng.uniform(-beyond_px, np.array([window.width, window.height]) + beyond_px)
    return board_point(window, T_board_cam, (float(u), float(v)))


def _add_round_the_middle(
    layout: Layout, window: Intrinsics, T_board_cam: Array, reach_px: tuple[float, float], rng: np.random.Generator
) -> None:
    """Lay a part so that its centre is that far from the window's middle, where there is room for it."""
    u, v = (window.width - 1) / 2, (window.height - 1) / 2
    layout.keep_clear(*board_point(window, T_board_cam, (u, v)), reach_px[0] * T_board_cam[2, 3] / window.fx)
    for _ in range(_TRIES):
        distance, direction = rng.uniform(*reach_px), rng.uniform(0, 2 * np.pi)
        pixel = (float(u + distance * np.cos(direction)), float(v + distance * np.sin(direction)))
        if layout.add_part(*board_point(window, T_board_cam, pixel)):
            return


def _middle(window: Intrinsics, T_board_cam: Array) -> tuple[float, float]:
    return board_point(window, T_board_cam, (window.width / 2, window.height / 2))


def _count(shares: tuple[float, ...], rng: np.random.Generator) -> int:
    """0, 1, 2... with the given shares."""
    return int(np.searchsorted(np.cumsum(shares)[:-1], rng.random(), side="right"))


def _shot(window: Intrinsics, downscale: float, T_board_cam: Array, focus: tuple[float, float], layout: Layout) -> Shot:
    return Shot(
        intrinsics=window,
        downscale=downscale,
        T_board_cam=T_board_cam,
        focus_board=focus,
        parts=tuple(layout.parts),
        distractors=tuple(layout.distractors),
    )
