"""What a training image shows: camera, window, where parts and distractors lie. Parts rest on their stable poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cad.parts import Part, StablePose, planar
from cad.spatial import BASLER, Array, Intrinsics, apply, inverse, rotation_from_rotvec, transform
from cad.tagboard import TagboardConfig
from scenes.errors import SceneError
from scenes.randomize import ViewRanges, draw_camera


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A part instance (its name and stable pose) or a distractor (its name, no stable pose) in the board's frame."""

    name: str
    T_board_object: Array
    stable_pose: int = -1


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image to render. ``downscale`` is how much smaller than the full-resolution frame its pixels are."""

    intrinsics: Intrinsics
    downscale: float
    T_board_cam: Array
    focus_board: tuple[float, float]
    parts: tuple[Placed, ...]
    distractors: tuple[Placed, ...]


@dataclass(frozen=True, kw_only=True)
class ShotRanges:
    """What may lie where: half extents of the area parts lie in, shares and counts; metres and degrees.

    ``neighbours`` and ``crop_distractors`` are the shares of crops with 0, 1, 2... of them; ``window_on_area`` of the
    windows are centred on the area parts lie in, the others are anywhere in the frame.
    """

    view: ViewRanges = field(default_factory=ViewRanges)
    area_half_m: tuple[float, float] = (0.105, 0.066)
    centre_jitter_px: int = 24
    target_share: float = 0.88
    tilt_jitter_deg: float = 0.3
    gap_m: tuple[float, float] = (0.0025, 0.012)
    neighbours: tuple[float, ...] = (0.45, 0.25, 0.2, 0.1)
    crop_distractors: tuple[float, ...] = (0.6, 0.2, 0.12, 0.08)
    window_on_area: float = 0.7
    window_parts: tuple[int, int] = (0, 8)
    window_distractors: tuple[int, int] = (0, 5)


class ShotSampler:
    """Draws shots of the given parts and of distractors whose footprint radii are given."""

    def __init__(
        self,
        parts: Sequence[Part],
        distractor_radii_m: Mapping[str, float],
        ranges: ShotRanges,
        board: TagboardConfig | None = None,
    ) -> None:
        for part in parts:
            if not part.stable_poses:
                raise SceneError(f"part {part.name!r} has no stable poses; compute stable_poses.json first")
        self._parts = list(parts)
        self._radii = dict(distractor_radii_m)
        self._names = list(self._radii)
        self._ranges = ranges
        self._board = board or TagboardConfig()
        self._footprints = {
            (part.name, pose.index): footprint_radius(part, pose) for part in parts for pose in part.stable_poses
        }

    def crop(self, rng: np.random.Generator, size: tuple[int, int] = (256, 256), downscale: int = 1) -> Shot:
        """A window of ``size`` (w, h) pixels, ``downscale`` times the camera's, round a part (entry 0) or none."""
        ranges = self._ranges
        T_board_cam = draw_camera(ranges.view, rng)
        taken: list[tuple[float, float, float]] = []
        parts: list[Placed] = []
        distractors: list[Placed] = []
        if rng.random() < ranges.target_share:
            x, y = rng.uniform(-1, 1, 2) * ranges.area_half_m
            parts.append(self._place_part(x, y, taken, rng))
            for _ in range(rng.choice(len(ranges.neighbours), p=ranges.neighbours)):
                self._add_near(x, y, parts, taken, rng, part=True)
        else:
            x, y = self._empty_place(rng)
            if rng.random() < 0.7:
                distractors.append(self._place_distractor(x, y, taken, rng))
        for _ in range(rng.choice(len(ranges.crop_distractors), p=ranges.crop_distractors)):
            self._add_near(x, y, distractors, taken, rng, part=False)
        u, v = BASLER.project(apply(inverse(T_board_cam), [x, y, 0.0]))
        jitter = rng.integers(-ranges.centre_jitter_px, ranges.centre_jitter_px + 1, 2)
        width, height = size[0] * downscale, size[1] * downscale
        corner = np.round([u, v]).astype(int) + jitter - np.array([width, height]) // 2
        window = BASLER.crop(int(corner[0]), int(corner[1]), width, height)
        return Shot(
            intrinsics=window.downscaled(downscale),
            downscale=downscale,
            T_board_cam=T_board_cam,
            focus_board=(float(x), float(y)),
            parts=tuple(parts),
            distractors=tuple(distractors),
        )

    def window(self, rng: np.random.Generator, size: tuple[int, int] = (320, 320), downscale: int = 4) -> Shot:
        """A window of ``size`` (w, h) pixels of the reduced frame with some parts and distractors in it."""
        ranges = self._ranges
        T_board_cam = draw_camera(ranges.view, rng)
        frame = BASLER.downscaled(downscale)
        limits = np.array([frame.width - size[0], frame.height - size[1]])
        corner = rng.integers(0, limits)
        if rng.random() < ranges.window_on_area:
            middle = rng.uniform(-1, 1, 2) * ranges.area_half_m
            pixel = frame.project(apply(inverse(T_board_cam), [*middle, 0.0]))
            corner = np.clip(np.round(pixel - np.array(size) / 2).astype(int), 0, limits)
        window = frame.crop(int(corner[0]), int(corner[1]), *size)
        return self._scatter(rng, window, T_board_cam, downscale)

    def frame(self, rng: np.random.Generator, frame: Intrinsics, downscale: float) -> Shot:
        """A whole frame, ``downscale`` times smaller than the camera's, with some parts and distractors in it."""
        return self._scatter(rng, frame, draw_camera(self._ranges.view, rng), downscale)

    def _scatter(self, rng: np.random.Generator, window: Intrinsics, T_board_cam: Array, downscale: float) -> Shot:
        """Parts and distractors anywhere in a window."""
        ranges, size = self._ranges, np.array([window.width, window.height])
        focus = board_point(window, T_board_cam, (size[0] / 2, size[1] / 2))
        taken: list[tuple[float, float, float]] = []
        parts: list[Placed] = []
        distractors: list[Placed] = []
        wanted = ((parts, ranges.window_parts, True), (distractors, ranges.window_distractors, False))
        for objects, bounds, is_part in wanted:
            for _ in range(rng.integers(*bounds, endpoint=True)):
                pixel = rng.uniform(0, size)
                x, y = board_point(window, T_board_cam, (pixel[0], pixel[1]))
                if is_part and not self._in_area(x, y):
                    continue
                self._add_at(x, y, objects, taken, rng, part=is_part)
        return Shot(
            intrinsics=window,
            downscale=downscale,
            T_board_cam=T_board_cam,
            focus_board=focus,
            parts=tuple(parts),
            distractors=tuple(distractors),
        )

    def _in_area(self, x: float, y: float) -> bool:
        half = self._ranges.area_half_m
        return abs(x) <= half[0] and abs(y) <= half[1]

    def _empty_place(self, rng: np.random.Generator) -> tuple[float, float]:
        """A place without a part: round a tag, near the plate's edge or anywhere in the middle."""
        kind = rng.random()
        if kind < 0.3:
            tag = self._board.centre(int(rng.choice(self._board.ids)))
            offset = rng.uniform(-0.6, 0.6, 2) * self._board.label_m
            return float(tag[0] + offset[0]), float(tag[1] + offset[1])
        half = (self._board.width_m / 2, self._board.height_m / 2) if kind < 0.45 else self._ranges.area_half_m
        x, y = rng.uniform(-1, 1, 2) * half
        return float(x), float(y)

    def _place_part(
        self, x: float, y: float, taken: list[tuple[float, float, float]], rng: np.random.Generator
    ) -> Placed:
        part, pose = self._draw_part(rng)
        taken.append((x, y, self._footprints[part.name, pose.index]))
        return self._rest(part, pose, x, y, rng)

    def _draw_part(self, rng: np.random.Generator) -> tuple[Part, StablePose]:
        part = self._parts[rng.integers(len(self._parts))]
        return part, part.stable_poses[rng.integers(len(part.stable_poses))]

    def _rest(self, part: Part, pose: StablePose, x: float, y: float, rng: np.random.Generator) -> Placed:
        """The part on one of its faces with any yaw, leaning a little as a grain of dust below it would make it.

        A pose that may roll is rolled to any angle.
        """
        angle, direction = np.radians(rng.uniform(0, self._ranges.tilt_jitter_deg)), rng.uniform(0, 2 * np.pi)
        lean = rotation_from_rotvec([angle * np.cos(direction), angle * np.sin(direction), 0.0])
        T_board_table = planar(x, y, rng.uniform(-np.pi, np.pi))
        T_table_part = pose.T_table_part
        if pose.roll is not None:
            T_table_part = T_table_part @ pose.roll.turn(rng.uniform(-np.pi, np.pi))
        T = T_board_table @ transform(lean) @ T_table_part
        return Placed(name=part.name, stable_pose=pose.index, T_board_object=T)

    def _place_distractor(
        self, x: float, y: float, taken: list[tuple[float, float, float]], rng: np.random.Generator
    ) -> Placed:
        name = self._names[rng.integers(len(self._names))]
        taken.append((x, y, self._radii[name]))
        return Placed(name=name, T_board_object=planar(x, y, rng.uniform(-np.pi, np.pi)))

    def _add_near(
        self,
        x: float,
        y: float,
        objects: list[Placed],
        taken: list[tuple[float, float, float]],
        rng: np.random.Generator,
        *,
        part: bool,
    ) -> None:
        """Try a few places a small gap away from (x, y)."""
        for _ in range(6):
            reach = (taken[0][2] if taken else 0.0) + rng.uniform(*self._ranges.gap_m) + rng.uniform(0.002, 0.006)
            direction = rng.uniform(0, 2 * np.pi)
            at = x + reach * np.cos(direction), y + reach * np.sin(direction)
            if self._add_at(*at, objects, taken, rng, part=part):
                return

    def _add_at(
        self,
        x: float,
        y: float,
        objects: list[Placed],
        taken: list[tuple[float, float, float]],
        rng: np.random.Generator,
        *,
        part: bool,
    ) -> bool:
        """Put an object at (x, y) unless it would come closer to another than the smallest gap."""
        mine: list[tuple[float, float, float]] = []
        placed = self._place_part(x, y, mine, rng) if part else self._place_distractor(x, y, mine, rng)
        radius, gap = mine[0][2], self._ranges.gap_m[0]
        if any(np.hypot(x - ox, y - oy) < radius + other + gap for ox, oy, other in taken):
            return False
        objects.append(placed)
        taken.append(mine[0])
        return True


def footprint_radius(part: Part, pose: StablePose) -> float:
    """Radius of the circle round the centre of a resting part's bounding rectangle that holds its footprint."""
    return float(np.linalg.norm(apply(pose.T_table_part, part.mesh.vertices)[:, :2], axis=1).max())


def board_point(intrinsics: Intrinsics, T_board_cam: Array, pixel: tuple[float, float]) -> tuple[float, float]:
    """Where the ray through a pixel meets the board's face: (x, y) in ``board``."""
    direction = T_board_cam[:3, :3] @ intrinsics.rays(pixel)
    x, y, _ = T_board_cam[:3, 3] - direction * (T_board_cam[2, 3] / direction[2])
    return float(x), float(y)
