"""What arm and hand touch: the contacts of a physics step, sorted by the thing touched.

Called after every step, so it must be cheap: which geoms touch changes far less often than where, and the contacts are
sorted again only when it does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array
from scenes.gl import mujoco

ROBOT, LEFT_PAD, RIGHT_PAD, BOARD, TRAY, OTHER = -1, -2, -3, -4, -5, -6
_NAMES = {BOARD: "board", TRAY: "tray", OTHER: "table or stand"}
_ALONG = 0.9
"""Cosine to the closing direction from which on a pad's contact counts as one of its inner face."""


@dataclass(frozen=True, kw_only=True)
class _Sorted:
    """Rows of the contact array: ``strikes`` (row, thing) and, for each part at both pads, the rows of either pad."""

    touched: frozenset[int]
    strikes: tuple[tuple[int, str], ...]
    between: tuple[tuple[int, list[int], list[int]], ...]

    @property
    def touches(self) -> bool:
        return bool(self.touched or self.strikes)


_NONE = _Sorted(touched=frozenset(), strikes=(), between=())


class RobotContacts:
    """Contacts of arm and hand in the step last made; call ``update`` after each step."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, part_bodies: Iterable[int]) -> None:
        """Part ``i`` is the body ``part_bodies[i]``; every other body is known by its name or its geoms' names."""
        self._data = data
        self._kind = _classify(model, part_bodies)
        self._closing = data.site_xmat[model.site("tcp").id][0::3]
        self._geoms = b""
        self._sorted = _NONE

    def update(self) -> bool:
        """Take over the contacts of the step just made; returns whether arm or hand touches anything."""
        if not self._data.ncon:
            self._geoms, self._sorted = b"", _NONE
            return False
        geoms = self._data.contact.geom
        if (seen := geoms.tobytes()) != self._geoms:
            self._geoms, self._sorted = seen, self._sort(geoms)
        return self._sorted.touches

    @property
    def touched(self) -> frozenset[int]:
        """Parts that any of arm and hand touches."""
        return self._sorted.touched

    @property
    def strikes(self) -> list[tuple[str, Array]]:
        """Everything touched that is not a part: its name and the point (3,) in the world."""
        if not self._sorted.strikes:
            return []
        pos = self._data.contact.pos
        return [(name, pos[row].copy()) for row, name in self._sorted.strikes]

    @property
    def held(self) -> list[int]:
        """Parts that both pads push along the closing direction, as their inner faces do, and not sideways."""
        if not self._sorted.between:
            return []
        along = (np.abs(self._data.contact.frame[:, :3] @ self._closing) > _ALONG).tolist()
        return [
            part
            for part, left, right in self._sorted.between
            if any(along[row] for row in left) and any(along[row] for row in right)
        ]

    def _sort(self, geoms: NDArray[np.int32]) -> _Sorted:
        touched: set[int] = set()
        strikes: list[tuple[int, str]] = []
        pads: dict[int, dict[int, list[int]]] = {}
        for row, (a, b) in enumerate(self._kind[geoms].tolist()):
            tool, thing = (a, b) if _is_robot(a) else (b, a)
            if not _is_robot(tool) or _is_robot(thing):
                continue
            if thing < 0:
                strikes.append((row, _NAMES[thing]))
                continue
            touched.add(thing)
            if tool != ROBOT:
                pads.setdefault(thing, {LEFT_PAD: [], RIGHT_PAD: []})[tool].append(row)
        between = tuple((i, rows[LEFT_PAD], rows[RIGHT_PAD]) for i, rows in pads.items() if all(rows.values()))
        return _Sorted(touched=frozenset(touched), strikes=tuple(strikes), between=between)


def _is_robot(kind: int) -> bool:
    return RIGHT_PAD <= kind <= ROBOT


def _classify(model: mujoco.MjModel, part_bodies: Iterable[int]) -> NDArray[np.int64]:
    """For each geom the index of the part it belongs to, or what else it is."""
    kind = np.full(model.ngeom, OTHER)
    part_of_body = {int(body): i for i, body in enumerate(part_bodies)}
    for g in range(model.ngeom):
        name = model.geom(g).name
        body = int(model.geom_bodyid[g])
        if body in part_of_body:
            kind[g] = part_of_body[body]
        elif name == "pad_left":
            kind[g] = LEFT_PAD
        elif name == "pad_right":
            kind[g] = RIGHT_PAD
        elif model.body(body).name.startswith(("ur5e_", "hande_")):
            kind[g] = ROBOT
        elif name.startswith("board"):
            kind[g] = BOARD
        elif name.startswith("tray"):
            kind[g] = TRAY
    return kind
