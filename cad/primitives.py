"""Capsules, cylinders and boxes that stand for a body in collision detection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from cad.parts import CadError
from cad.spatial import Array, apply, inverse

Kind = Literal["capsule", "cylinder", "box"]
SIZES = {"capsule": 2, "cylinder": 2, "box": 3}


class PrimitiveError(CadError):
    """A collision primitive of an unknown kind or of impossible size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitive:
    """A solid fixed to ``body``.

    ``size`` in metres follows MuJoCo: (radius, half length) of the straight part along the geom's z for ``capsule`` and
    ``cylinder``, half extents (x, y, z) for ``box``. ``T_body_geom`` (4, 4) puts the solid's centre in the body frame.
    ``name`` is unique in the cell. ``touches`` marks a surface that is meant to touch parts (a finger pad).
    """

    name: str
    body: str
    kind: Kind
    size: tuple[float, ...]
    T_body_geom: Array
    touches: bool = False

    def __post_init__(self) -> None:
        if self.kind not in SIZES:
            raise PrimitiveError(f"{self.name}: kind {self.kind!r} is not one of {', '.join(SIZES)}")
        if len(self.size) != SIZES[self.kind] or min(self.size) <= 0:
            raise PrimitiveError(
                f"{self.name}: size {self.size}; a {self.kind} takes {SIZES[self.kind]} positive lengths in metres"
            )

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (N,) in metres of points (N, 3) in the body frame; negative inside."""
        p = apply(inverse(self.T_body_geom), points)
        if self.kind == "capsule":
            axis = np.stack([np.zeros(len(p)), np.zeros(len(p)), np.clip(p[:, 2], -self.size[1], self.size[1])], axis=1)
            return np.linalg.norm(p - axis, axis=1) - self.size[0]
        if self.kind == "cylinder":
            q = np.stack([np.hypot(p[:, 0], p[:, 1]) - self.size[0], np.abs(p[:, 2]) - self.size[1]], axis=1)
        else:
            q = np.abs(p) - np.array(self.size)
        return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
