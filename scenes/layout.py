"""What lies on the board in one shot, put there thing by thing: apart from each other, close together or touching.

Everything lies at rest. Things that touch do so from the side: one is pushed over the board towards the other until
they meet. Contact at rest carries no force, so physics could have left them there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cad.collision import contact_pieces
from cad.parts import Part
from cad.spatial import Array, rotation_from_rotvec
from cad.tagboard import TagboardConfig
from scenes.distractors import CRUMB, Distractor
from scenes.errors import SceneError
from scenes.ranges import Range
from scenes.rests import Faces, RestPool
from scenes.touching import TOUCH_M, Slider

_TRIES = 6


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A part instance (its name and stable pose) or a distractor (its name, no stable pose) in the board's frame."""

    name: str
    T_board_object: Array
    stable_pose: int = -1


@dataclass(frozen=True, kw_only=True)
class LayoutRanges:
    """What may lie where; metres and degrees.

    Parts' centres keep within ``area_half_m`` of the board's centre along x and y. The circles round two footprints are
    at least ``gap_m[0]`` apart, and up to ``gap_m[1]`` and some more where a thing is put beside another one. But a
    share ``touching`` of the things that are put beside others touch one of them, and a share ``close`` come within
    ``close_gap_m`` of one, from surface to surface. ``dust_lean_deg`` is how far dust below a part tilts it on top of
    how physics left it: 20 um under the edge of 8 mm are 0.14 degrees.
    """

    area_half_m: tuple[float, float] = (0.105, 0.066)
    gap_m: Range = (0.0025, 0.012)
    touching: float = 0.12
    close: float = 0.15
    close_gap_m: Range = (0.0001, 0.0025)
    dust_lean_deg: Range = (0.0, 0.15)

    def __post_init__(self) -> None:
        if not min(self.area_half_m) > 0:
            raise SceneError(f"area_half_m {self.area_half_m}: both must be positive")
        for name in ("gap_m", "close_gap_m", "dust_lean_deg"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise SceneError(f"{name} {(low, high)}: must be a range from 0 upwards")
        if not (self.touching >= 0 and self.close >= 0 and self.touching + self.close <= 1):
            raise SceneError(f"touching {self.touching} and close {self.close}: shares of 0 to 1, at most 1 together")


class Shelf:
    """The parts and distractors that may be laid out, and their shapes for touching. Never changes.

    Distractors that could be taken for one of the parts are left out.
    """

    def __init__(self, rests: RestPool, distractors: Mapping[str, Distractor]) -> None:
        self.rests, self.parts = rests, rests.parts
        self.distractors = {
            name: distractor
            for name, distractor in sorted(distractors.items())
            if not any(distractor.resembles(part) for part in rests.parts)
        }
        self.kinds: dict[str, list[Distractor]] = {}
        for distractor in self.distractors.values():
            self.kinds.setdefault(distractor.kind, []).append(distractor)
        self.crumbs = self.kinds.pop(CRUMB, [])
        self.corners = {part.name: np.asarray(part.mesh.convex_hull.vertices) for part in self.parts}
        pieces = {f"part {part.name}": contact_pieces(part, "grasp") for part in self.parts}
        self.slider = Slider(pieces | {name: distractor.pieces for name, distractor in self.distractors.items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class _Thing:
    """Something to be laid out: ``T_table_object`` rests round the table's origin inside a circle."""

    shape: str
    name: str
    stable_pose: int
    T_table_object: Array
    radius_m: float


class Layout:
    """Holds what lies on the board of one shot; every draw comes from ``rng``."""

    def __init__(
        self, shelf: Shelf, ranges: LayoutRanges, faces: Faces, board: TagboardConfig, rng: np.random.Generator
    ) -> None:
        self.parts: list[Placed] = []
        self.distractors: list[Placed] = []
        self._shelf, self._ranges, self._rng = shelf, ranges, rng
        self._faces: Faces = faces
        self._board_half = board.width_m / 2, board.height_m / 2
        self._laid: list[tuple[_Thing, Array, float, float]] = []
        self._clear = (0.0, 0.0, 0.0)

    def keep_clear(self, x: float, y: float, radius_m: float) -> None:
        """From now on lay no part with its centre inside of this circle."""
        self._clear = x, y, radius_m

    def add_part(self, x: float, y: float) -> bool:
        """Lay a part at (x, y), or push it against what lies there; returns whether there was room for it."""
        return self._put(self._draw_part(), x, y, self._draw_gap())

    def add_distractor(self, x: float, y: float) -> bool:
        """The same with a distractor of any kind."""
        thing = self._draw_distractor()
        return thing is not None and self._put(thing, x, y, self._draw_gap())

    def add_crumb(self, x: float, y: float) -> bool:
        """The same with a crumb, which never touches anything."""
        thing = self._pick(self._shelf.crumbs)
        return thing is not None and self._lay(thing, x, y, self._turned(thing))

    def add_beside(self, x: float, y: float, *, part: bool) -> bool:
        """Lay a part or a distractor beside (x, y), where something may lie; returns whether there was room for it."""
        thing = self._draw_part() if part else self._draw_distractor()
        if thing is None:
            return False
        first = self._laid[0][0].radius_m if self._laid else 0.0
        gap = self._draw_gap()
        for _ in range(_TRIES):
            reach = first + self._rng.uniform(*self._ranges.gap_m) + self._rng.uniform(0.002, 0.006)
            direction = self._rng.uniform(0, 2 * np.pi)
            if self._put(thing, x + reach * np.cos(direction), y + reach * np.sin(direction), gap):
                return True
        return False

    def _draw_part(self) -> _Thing:
        part = self._shelf.parts[self._rng.integers(len(self._shelf.parts))]
        rest = self._shelf.rests.draw(part, self._faces, self._rng)
        return _Thing(
            shape=f"part {part.name}",
            name=part.name,
            stable_pose=rest.stable_pose,
            T_table_object=self._leaning(part, rest.T_table_part),
            radius_m=rest.radius_m,
        )

    def _leaning(self, part: Part, T_table_part: Array) -> Array:
        """The part tilted a little any way, as far above the table as before."""
        low, high = np.radians(self._ranges.dust_lean_deg)
        if high == 0:
            return T_table_part
        angle, direction = self._rng.uniform(low, high), self._rng.uniform(0, 2 * np.pi)
        lean = rotation_from_rotvec([angle * np.cos(direction), angle * np.sin(direction), 0.0])
        T, corners = T_table_part.copy(), self._shelf.corners[part.name]
        T[:3] = lean @ T_table_part[:3]
        T[2, 3] = T_table_part[2, 3] + (corners @ T_table_part[2, :3]).min() - (corners @ T[2, :3]).min()
        return T

    def _draw_distractor(self) -> _Thing | None:
        kinds = list(self._shelf.kinds.values())
        return self._pick(kinds[self._rng.integers(len(kinds))]) if kinds else None

    def _pick(self, options: list[Distractor]) -> _Thing | None:
        """One that does not lie on the board yet; None where all do."""
        used = {placed.name for placed in self.distractors}
        left = [option for option in options if option.name not in used]
        if not left:
            return None
        chosen = left[self._rng.integers(len(left))]
        return _Thing(
            shape=chosen.name, name=chosen.name, stable_pose=-1, T_table_object=np.eye(4), radius_m=chosen.radius_m
        )

    def _draw_gap(self) -> float | None:
        """How near the next thing is to come to another one; None for one that keeps apart from all."""
        ranges, kind = self._ranges, self._rng.random()
        if kind < ranges.touching:
            return TOUCH_M
        return float(self._rng.uniform(*ranges.close_gap_m)) if kind < ranges.touching + ranges.close else None

    def _put(self, thing: _Thing, x: float, y: float, gap_m: float | None) -> bool:
        turned = self._turned(thing)
        if gap_m is None or not self._laid:
            return self._lay(thing, x, y, turned)
        return self._push(thing, x, y, turned, gap_m)

    def _turned(self, thing: _Thing) -> Array:
        """``T_table_object`` at any yaw."""
        yaw, T = self._rng.uniform(-np.pi, np.pi), thing.T_table_object.copy()
        c, s = np.cos(yaw), np.sin(yaw)
        T[:2] = np.array([[c, -s], [s, c]]) @ T[:2]
        return T

    def _push(self, thing: _Thing, x: float, y: float, turned: Array, gap_m: float) -> bool:
        """Push a thing from (x, y) towards what lies nearest until it is ``gap_m`` away from it."""
        k = int(np.argmin([np.hypot(x - ox, y - oy) for _, _, ox, oy in self._laid]))
        target, T_target, target_x, target_y = self._laid[k]
        reach = thing.radius_m + target.radius_m
        towards = np.array([target_x - x, target_y - y])
        distance = np.linalg.norm(towards)
        direction = towards / distance if distance > 0 else np.array([1.0, 0.0])
        aside = self._rng.uniform(-0.5, 0.5) * reach * np.array([-direction[1], direction[0]])
        start = np.array([target_x, target_y]) + aside - (reach + gap_m + TOUCH_M) * direction
        T_start = _moved(turned, start[0], start[1])
        travel = self._shelf.slider.travel((thing.shape, T_start), (target.shape, T_target), direction, gap_m)
        if travel is None:
            return False
        end = start + travel * direction
        return self._lay(thing, float(end[0]), float(end[1]), turned, beside=k)

    def _lay(self, thing: _Thing, x: float, y: float, turned: Array, beside: int = -1) -> bool:
        """Put a thing down unless it leaves its area or comes nearer to another than the gap, but for ``beside``."""
        half = self._ranges.area_half_m if thing.stable_pose >= 0 else self._board_half
        inset = 0.0 if thing.stable_pose >= 0 else thing.radius_m
        if abs(x) > half[0] - inset or abs(y) > half[1] - inset:
            return False
        clear_x, clear_y, clear_m = self._clear
        if thing.stable_pose >= 0 and np.hypot(x - clear_x, y - clear_y) < clear_m:
            return False
        gap = thing.radius_m + self._ranges.gap_m[0]
        for k, (other, _, other_x, other_y) in enumerate(self._laid):
            if k != beside and np.hypot(x - other_x, y - other_y) < other.radius_m + gap:
                return False
        T = _moved(turned, x, y)
        self._laid.append((thing, T, x, y))
        placed = Placed(name=thing.name, stable_pose=thing.stable_pose, T_board_object=T)
        (self.parts if thing.stable_pose >= 0 else self.distractors).append(placed)
        return True


def _moved(T: Array, x: float, y: float) -> Array:
    moved = T.copy()
    moved[0, 3] += x
    moved[1, 3] += y
    return moved
