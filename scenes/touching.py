"""How far a thing on the board can be pushed towards another one before they touch, or come within a given distance.

Both are unions of convex pieces. Of each pair of pieces MuJoCo tells the distance and the direction in which it is
shortest; a plane across that direction keeps the two apart, so the moving piece may go on until it reaches the plane
(conservative advancement, Mirtich 1996, with the plane's normal in place of a bound on the speed). Pairs are looked at
in the order in which their bounding boxes meet, and most never are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from cad.spatial import Array, rotation_from_quat_wxyz, transform
from scenes.errors import SceneError
from scenes.free_part import add_piece
from scenes.gl import mujoco

TOUCH_M = 2e-6
"""Things this near touch: contact at rest carries no force and has no depth."""
_SLACK_M = 1e-5
_FAR_M = 1.0
_STEPS = 40


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pieces:
    """Convex pieces of one thing: all corners (V, 3) in its frame, where each piece's begin, and for both of the sides
    that it can be on the pieces' geoms and their frames ``T_object_geom`` (P, 4, 4).
    """

    corners: Array
    starts: list[int]
    geoms: tuple[list[int], list[int]]
    T_object_geom: Array


class Slider:
    """Slides things of known shape over the board; ``pieces`` maps a name to its convex pieces in its own frame."""

    def __init__(self, pieces: Mapping[str, Sequence[trimesh.Trimesh]]) -> None:
        spec = mujoco.MjSpec()
        for name, solids in pieces.items():
            if not solids:
                raise SceneError(f"{name!r} has no convex pieces that could touch anything")
            for k, solid in enumerate(solids):
                add_piece(spec, f"{name}/{k}", solid)
                for side in (0, 1):
                    spec.worldbody.add_geom(
                        name=f"{name}/{k}/{side}", type=mujoco.mjtGeom.mjGEOM_MESH.value, meshname=f"{name}/{k}"
                    )
        self._model = model = spec.compile()
        self._data = mujoco.MjData(model)
        self._fromto = np.zeros((6, 1))
        self._things: dict[str, _Pieces] = {}
        for name, solids in pieces.items():
            geoms = tuple([model.geom(f"{name}/{k}/{side}").id for k in range(len(solids))] for side in (0, 1))
            sizes = [len(solid.vertices) for solid in solids]
            self._things[name] = _Pieces(
                corners=np.concatenate([np.asarray(solid.vertices) for solid in solids]),
                starts=[0, *np.cumsum(sizes[:-1]).tolist()],
                geoms=(geoms[0], geoms[1]),
                T_object_geom=np.array(
                    [transform(rotation_from_quat_wxyz(model.geom_quat[g]), model.geom_pos[g]) for g in geoms[0]]
                ),
            )

    def travel(
        self,
        moving: tuple[str, Array],
        fixed: tuple[str, Array],
        direction: Array,
        gap_m: float = TOUCH_M,
    ) -> float | None:
        """How far in m ``moving`` goes along ``direction`` (2,), a unit vector in the plane, until it is ``gap_m`` from
        ``fixed``, to within 10 um more; None where it passes.

        Both are a name and ``T_board_object`` (4, 4). They must be more than ``gap_m`` apart along ``direction``.
        """
        a, b = self._things[moving[0]], self._things[fixed[0]]
        along = np.array([*direction, 0.0])
        R = np.array([along, [-direction[1], direction[0], 0.0], [0.0, 0.0, 1.0]])
        low_a, high_a = _boxes(a, moving[1], R)
        low_b, high_b = _boxes(b, fixed[1], R)
        meets = (low_a[:, None, 1:] < high_b[None, :, 1:] + gap_m) & (high_a[:, None, 1:] > low_b[None, :, 1:] - gap_m)
        free = low_b[None, :, 0] - high_a[:, None, 0] - gap_m
        order = np.argsort(np.where(meets.all(axis=2), free, np.inf), axis=None)[: int(meets.all(axis=2).sum())]
        T_a, T_b = moving[1] @ a.T_object_geom, fixed[1] @ b.T_object_geom
        best = np.inf
        for k in order.tolist():
            i, j = divmod(k, len(b.starts))
            if free[i, j] >= best:
                break
            self._put(b.geoms[1][j], T_b[j])
            limit = min(best, high_b[j, 0] - low_a[i, 0] + gap_m)
            best = min(
                best, self._advance(a.geoms[0][i], T_a[i], b.geoms[1][j], along, gap_m, float(free[i, j]), limit)
            )
        return None if best == np.inf else best

    def distance(self, one: tuple[str, Array], other: tuple[str, Array]) -> float:
        """Smallest distance in m between two things, negative by how deep they are in each other."""
        a, b = self._things[one[0]], self._things[other[0]]
        for geom, T in zip(a.geoms[0], one[1] @ a.T_object_geom, strict=True):
            self._put(geom, T)
        for geom, T in zip(b.geoms[1], other[1] @ b.T_object_geom, strict=True):
            self._put(geom, T)
        return min(self._between(g, h) for g in a.geoms[0] for h in b.geoms[1])

    def _advance(
        self, geom: int, T: Array, fixed: int, along: Array, gap_m: float, start_m: float, limit_m: float
    ) -> float:
        """How far one piece gets before it is ``gap_m`` from another one, infinity if that is ``limit_m`` or more."""
        travelled = start_m
        self._put(geom, T)
        for _ in range(_STEPS):
            self._data.geom_xpos[geom] = T[:3, 3] + travelled * along
            spare = self._between(geom, fixed) - gap_m
            if spare <= _SLACK_M:
                return travelled
            towards = self._fromto[3:, 0] - self._fromto[:3, 0]
            approach = float(towards @ along)
            if approach <= 0:
                return np.inf
            travelled += spare * float(np.linalg.norm(towards)) / approach
            if travelled >= limit_m:
                return np.inf
        return travelled

    def _between(self, geom: int, other: int) -> float:
        return mujoco.mj_geomDistance(self._model, self._data, geom, other, _FAR_M, self._fromto)

    def _put(self, geom: int, T_board_geom: Array) -> None:
        self._data.geom_xpos[geom] = T_board_geom[:3, 3]
        self._data.geom_xmat[geom] = T_board_geom[:3, :3].ravel()


def _boxes(thing: _Pieces, T_board_object: Array, R: Array) -> tuple[Array, Array]:
    """Lowest and highest corners (P, 3) of the pieces' bounding boxes along the rows of ``R``."""
    corners = thing.corners @ (R @ T_board_object[:3, :3]).T + R @ T_board_object[:3, 3]
    return np.minimum.reduceat(corners, thing.starts), np.maximum.reduceat(corners, thing.starts)
