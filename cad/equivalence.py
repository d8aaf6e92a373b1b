"""Which transforms of a part look, or rest, the same: its group of proper rotations, and poses compared modulo it.

A symmetry ``S`` (4, 4) maps the part onto itself in its own frame, so ``T_a_part`` and ``T_a_part @ S`` put the same
solid in the same place. Every symmetry is one of ``discrete`` (or the identity) followed by any turn about one of the
``continuous`` axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cad.spatial import Array, rotation_angle, rotation_from_rotvec, transform

_PARALLEL = 1e-3
_SAME_RAD = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """A line in the part's frame: unit ``direction`` (3,) and a ``point`` (3,) on it, metres."""

    direction: Array
    point: Array

    def turn(self, angle: float) -> Array:
        """(4, 4) rotation by ``angle`` rad about the line."""
        R = rotation_from_rotvec(angle * self.direction)
        return transform(R, self.point - R @ self.point)


@dataclass(frozen=True, kw_only=True, eq=False)
class Symmetries:
    """Proper rotations that map a part onto itself, in the part's frame, metres.

    ``discrete`` (S, 4, 4) leaves out the identity and what the ``continuous`` axes cover. ``tolerance_m`` is how far a
    symmetry may move the surface.
    """

    discrete: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    continuous: tuple[Axis, ...] = ()
    tolerance_m: float = 0.0

    @property
    def is_trivial(self) -> bool:
        """Whether only the identity maps the part onto itself."""
        return not len(self.discrete) and not self.continuous

    @property
    def elements(self) -> Array:
        """(1 + S, 4, 4) the identity, then the discrete symmetries."""
        return np.concatenate([np.eye(4)[None], self.discrete])

    def describe(self) -> str:
        """For people: how many turns, and about which axes the part is round."""
        if self._any_rotation:
            return "a ball"
        axes = [f"round about {(np.round(a.direction, 3) + 0.0).tolist()}" for a in self.continuous]
        turns = len(self.discrete)
        return ", ".join([*axes, f"{turns} turn{'' if turns == 1 else 's'}"] if turns or axes else ["none"])

    def with_axis(self, axis: Axis) -> Symmetries:
        """The same with one more continuous axis, unless there is one along it already."""
        if any(abs(abs(float(a.direction @ axis.direction)) - 1.0) < _PARALLEL for a in self.continuous):
            return self
        return replace(self, continuous=(*self.continuous, axis))

    def nearest(self, T_reference: Array, T: Array) -> Array:
        """Of all transforms ``T @ S`` the one turned least from ``T_reference``, both (4, 4) into one frame.

        A tie between orientations goes to the one whose origin is nearer.
        """
        candidates = [T @ S for S in self._towards(T_reference, T)]
        angles = np.array([rotation_angle(T_reference[:3, :3], c[:3, :3]) for c in candidates])
        distances = np.array([np.linalg.norm(c[:3, 3] - T_reference[:3, 3]) for c in candidates])
        near = np.flatnonzero(angles <= angles.min() + _SAME_RAD)
        return candidates[int(near[np.argmin(distances[near])])]

    def difference(self, T_reference: Array, T: Array) -> tuple[float, float]:
        """Distance in m between the origins and angle in rad between the orientations, modulo the symmetries."""
        near = self.nearest(T_reference, T)
        return (
            float(np.linalg.norm(near[:3, 3] - T_reference[:3, 3])),
            rotation_angle(T_reference[:3, :3], near[:3, :3]),
        )

    def nearest_direction(self, reference: Array, direction: Array) -> Array:
        """Of all directions (3,) in the part's frame that a symmetry makes of ``direction``, the nearest one."""
        options = [R @ direction for R in self.elements[:, :3, :3]]
        if self._any_rotation:
            return reference / np.linalg.norm(reference) * np.linalg.norm(direction)
        for axis in self.continuous:
            n = axis.direction
            across = reference - (reference @ n) * n
            if np.linalg.norm(across) < 1e-9:
                continue
            across /= np.linalg.norm(across)
            options += [(u @ n) * n + np.linalg.norm(u - (u @ n) * n) * across for u in list(options)]
        return min(options, key=lambda u: float(np.linalg.norm(u - reference)))

    def sampled(self, steps: int = 72) -> Array:
        """(N, 4, 4) all symmetries, each continuous axis in ``steps`` turns (as BOP's toolkit discretises them).

        Of a ball, whose symmetries are all rotations, ``steps`` of them spread at random.
        """
        if self._any_rotation:
            c = self.continuous[0].point
            turns = Rotation.random(steps, rng=np.random.default_rng(0)).as_matrix()
            return np.array([transform(R, c - R @ c) for R in turns])
        elements = list(self.elements)
        for axis in self.continuous:
            turns = [axis.turn(angle) for angle in 2 * np.pi * np.arange(1, steps) / steps]
            elements += [S @ turn for S in list(elements) for turn in turns]
        return np.array(elements)

    @property
    def _any_rotation(self) -> bool:
        """Whether the axes generate every rotation, as a ball's do."""
        return len(self.continuous) > 1

    def _towards(self, T_reference: Array, T: Array) -> Iterator[Array]:
        """Symmetries that may bring ``T`` nearest to ``T_reference``."""
        if self._any_rotation:
            R, c = T[:3, :3].T @ T_reference[:3, :3], self.continuous[0].point
            yield transform(R, c - R @ c)
            return
        for S in self.elements:
            yield S
            for axis in self.continuous:
                # the angle maximises trace(Q Rot(n, angle)) = cos (tr Q - n.Qn) + sin (n . vee(Q' - Q)) + n.Qn
                Q = T_reference[:3, :3].T @ (T @ S)[:3, :3]
                n = axis.direction
                sine = float(n @ [Q[1, 2] - Q[2, 1], Q[2, 0] - Q[0, 2], Q[0, 1] - Q[1, 0]])
                cosine = float(np.trace(Q) - n @ Q @ n)
                if np.hypot(sine, cosine) > 1e-12:
                    yield S @ axis.turn(float(np.arctan2(sine, cosine)))


def symmetries_to_json(symmetries: Symmetries) -> dict[str, Any]:
    """BOP's ``symmetries_discrete`` and ``symmetries_continuous``: millimetres, transforms as 16 numbers row by row."""
    discrete = symmetries.discrete.copy()
    discrete[:, :3, 3] *= 1e3
    return {
        "symmetries_discrete": [(np.round(T, 9) + 0.0).reshape(-1).tolist() for T in discrete],
        "symmetries_continuous": [axis_to_json(axis) for axis in symmetries.continuous],
    }


def symmetries_from_json(info: dict[str, Any]) -> Symmetries:
    """The symmetries of a ``models_info`` entry; none when it names none."""
    discrete = np.array(info.get("symmetries_discrete", []), dtype=np.float64).reshape(-1, 4, 4)
    discrete[:, :3, 3] *= 1e-3
    axes = tuple(axis_from_json(entry) for entry in info.get("symmetries_continuous", []))
    return Symmetries(discrete=discrete, continuous=axes, tolerance_m=1e-3 * float(info.get("symmetry_tolerance", 0.0)))


def axis_to_json(axis: Axis) -> dict[str, list[float]]:
    """BOP's form of a continuous axis: unit ``axis`` and a point on it, ``offset``, in millimetres."""
    return {
        "axis": (np.round(axis.direction, 9) + 0.0).tolist(),
        "offset": (np.round(1e3 * axis.point, 9) + 0.0).tolist(),
    }


def axis_from_json(entry: dict[str, Sequence[float]]) -> Axis:
    """The axis that ``axis_to_json`` wrote."""
    direction = np.array(entry["axis"], dtype=np.float64)
    return Axis(direction=direction / np.linalg.norm(direction), point=1e-3 * np.array(entry["offset"], np.float64))
