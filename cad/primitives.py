"""Capsules, cylinders and boxes that stand for a body in collision detection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from cad.parts import CadError
from cad.spatial import Array, apply, inverse, transform

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


def cylinder_between(name: str, body: str, start: ArrayLike, end: ArrayLike, radius: float) -> Primitive:
    """Cylinder of ``radius`` whose end faces are centred at ``start`` and ``end`` (3,), metres in the body frame.

    Raises PrimitiveError when the two points coincide.
    """
    p, q = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(q - p))
    if length == 0:
        raise PrimitiveError(f"{name}: both ends are at {p.tolist()}; a cylinder needs two different points")
    R = Rotation.align_vectors([(q - p) / length], [[0.0, 0.0, 1.0]])[0].as_matrix()
    return Primitive(
        name=name, body=body, kind="cylinder", size=(radius, length / 2), T_body_geom=transform(R, (p + q) / 2)
    )


def box_between(name: str, body: str, low: ArrayLike, high: ArrayLike, *, touches: bool = False) -> Primitive:
    """Box parallel to the body frame's axes with opposite corners ``low`` and ``high`` (3,) in metres, in any order."""
    p, q = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    x, y, z = (float(v) for v in np.abs(q - p) / 2)
    return Primitive(
        name=name, body=body, kind="box", size=(x, y, z), T_body_geom=transform(t=(p + q) / 2), touches=touches
    )
