"""Rotational symmetries of a part, found from its mesh and written in BOP's ``models_info`` form.

Only proper rotations count: a mirror plane cannot be reached by turning the part. Every symmetry turns about an axis
through the centroid, and the moments of the volume leave few directions for one (``cad.moments``). Along each the
largest order is found, from which the group is generated, drawn to an exact group, and tested: an element counts when
it moves no point of the surface farther than the tolerance from the surface. As the inverse of each element is an
element, that is the Hausdorff distance both ways.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from cad.equivalence import Axis, Symmetries, symmetries_to_json
from cad.meshes import surface_samples
from cad.moments import axis_directions
from cad.nearest import Surface
from cad.spatial import Array, diameter, rotation_from_rotvec, rotvec_from_rotation, transform

RELATIVE_TOLERANCE = 0.003
TOLERANCE_BOUNDS_M = (5e-6, 30e-6)
"""The default tolerance is the relative one times the diameter, within these bounds.

A tenth of a millimetre that breaks a symmetry must be seen, and as the centroid moves along, a side that is longer by
0.1 mm moves the surface by 0.05 mm only: hence 30 um. CAD surfaces are meshed to 2 um, and a turn of such a cylinder
moves its surface by as much: hence 5 um.
"""
MAX_ORDER = 60
_PRIMES = tuple(p for p in range(2, MAX_ORDER) if all(p % k for k in range(2, p)))
_ODD_ANGLES_RAD = (0.41, -1.0, 1.73, -2.6)  # shared by no finite turn: what passes them is continuous
_SAME_RAD = np.radians(2.0)
_STEP_RAD = np.radians(0.5)
_POLYHEDRAL = 5  # turns of a higher order have one axis
_QUICK, _SOME, _SAMPLES, _MOST_CORNERS = 64, 500, 4000, 8000
_REFINEMENTS = 4
_KEPT = 0.8  # of the points: the others are near edges, where the face found may be the wrong one
_WEAK = 1e-6
_TRIES = 4
_LARGEST_GROUP = 2 * MAX_ORDER


def find_symmetries(mesh: trimesh.Trimesh, tolerance_m: float | None = None) -> Symmetries:
    """All proper rotational symmetries of a closed mesh in metres within ``tolerance_m``.

    The default is ``default_tolerance_m``. Turns of up to 60 a circle are told from round; a ball has two axes, which
    generate every rotation. Raises ValueError for a tolerance that is not positive.
    """
    tolerance_m = default_tolerance_m(_diameter(mesh)) if tolerance_m is None else float(tolerance_m)
    if not tolerance_m > 0:
        raise ValueError(f"tolerance {tolerance_m} m: it must be positive")
    solid = _Solid(mesh, tolerance_m)
    directions = axis_directions(mesh, solid.centre)
    round_axes = solid.round_axes(directions)
    rotations = solid.flip(round_axes[0], None) if len(round_axes) == 1 else []
    if not round_axes:
        rotations = solid.group(directions)
    c = solid.centre
    return Symmetries(
        discrete=np.array([transform(R, c - R @ c) for R in rotations]).reshape(-1, 4, 4),
        continuous=tuple(Axis(direction=axis, point=c) for axis in round_axes),
        tolerance_m=tolerance_m,
    )


def deviation_m(mesh: trimesh.Trimesh, symmetries: Symmetries, steps: int = 12) -> float:
    """Largest distance in metres that a symmetry moves the surface by, continuous axes taken in ``steps`` turns."""
    solid = _Solid(mesh, symmetries.tolerance_m)
    turns = [axis.turn(angle) for axis in symmetries.continuous for angle in 2 * np.pi * np.arange(1, steps) / steps]
    return max((solid.deviation(T[:3, :3]) for T in [*symmetries.discrete, *turns]), default=0.0)


def default_tolerance_m(diameter_m: float) -> float:
    """0.3 % of the diameter, at least 5 um and at most 30 um."""
    return float(np.clip(RELATIVE_TOLERANCE * diameter_m, *TOLERANCE_BOUNDS_M))


def models_info(mesh: trimesh.Trimesh, symmetries: Symmetries) -> dict[str, Any]:
    """The part's entry of a BOP ``models_info.json`` in millimetres; ``symmetry_tolerance`` is ours."""
    low, high = 1e3 * mesh.bounds
    info: dict[str, Any] = {"diameter": round(1e3 * _diameter(mesh), 6)}
    info |= {f"min_{a}": round(float(v), 6) for a, v in zip("xyz", low, strict=True)}
    info |= {f"size_{a}": round(float(v), 6) for a, v in zip("xyz", high - low, strict=True)}
    info |= symmetries_to_json(symmetries)
    info["symmetry_tolerance"] = round(1e3 * symmetries.tolerance_m, 9)
    return info


class _Solid:
    """A mesh about its centroid, prepared for testing many rotations."""

    def __init__(self, mesh: trimesh.Trimesh, tolerance_m: float) -> None:
        self.tolerance_m = tolerance_m
        self.centre = np.array(mesh.center_mass)
        centred = trimesh.Trimesh(mesh.vertices - self.centre, mesh.faces, process=False)
        rng = np.random.default_rng(0)
        corners = _sharpest(centred, _MOST_CORNERS)
        self.points = np.concatenate([surface_samples(centred, _SAMPLES, rng)[0], corners])
        self.some = rng.choice(self.points, _SOME)
        self.few = np.concatenate([self.some[:_QUICK], rng.choice(corners[:_SOME], _QUICK)])
        self.surface = Surface(centred)
        self.slack_m = 2 * float(np.sin(_STEP_RAD) * np.linalg.norm(corners, axis=1).max())

    def may_pass(self, R: Array, slack_m: float = 0.0) -> bool:
        """Cheap test that rejects most rotations that are no symmetry and hardly ever one that is."""
        return not self.surface.surely_beyond(self.few @ R.T, self.tolerance_m + slack_m)

    def deviation(self, R: Array) -> float:
        """Largest distance in metres from the surface of the points turned by ``R``."""
        return self.surface.largest(self.points @ R.T)

    def passes(self, R: Array) -> bool:
        """Whether the rotation is a symmetry."""
        if not self.may_pass(R):
            return False
        return all(self.surface.all_within(points @ R.T, self.tolerance_m) for points in (self.some, self.points))

    def refined(self, R: Array) -> Array:
        """The rotation next to ``R`` that lays the solid on itself best: distances along normals, least squares."""
        start = R
        for _ in range(_REFINEMENTS):
            turned = self.some @ R.T
            found, normals = self.surface.nearest(turned)
            distances = np.einsum("ni,ni->n", normals, found - turned)
            kept = np.argsort(np.linalg.norm(found - turned, axis=1))[: round(_KEPT * len(turned))]
            step = np.linalg.lstsq(np.cross(turned, normals)[kept], distances[kept], rcond=_WEAK)[0]
            R = rotation_from_rotvec(step) @ R
        return R if _is_among(R, start[None]) else start

    def round_axes(self, directions: Array) -> list[Array]:
        """The axis about which every turn leaves the surface in place; two of them when every rotation does."""
        for direction in directions:
            if not all(self.may_pass(_turn(direction, angle), self.slack_m) for angle in _ODD_ANGLES_RAD):
                continue
            axis = _axis(self.refined(_turn(direction, _ODD_ANGLES_RAD[2])))
            if self._is_round(axis):
                other = _across(axis)
                return [axis, other] if self._is_round(other) else [axis]
        return []

    def _is_round(self, axis: Array) -> bool:
        return all(self.passes(_turn(axis, angle)) for angle in _ODD_ANGLES_RAD)

    def flip(self, axis: Array, order: int | None) -> list[Array]:
        """A half-turn about an axis across ``axis`` if there is one; ``order`` is None when the solid is round."""
        count = max(1, round(np.pi / order / _STEP_RAD)) if order else 1
        x = _across(axis)
        y = np.cross(axis, x)
        options: list[tuple[float, Array]] = []
        for angle in np.pi / (order or 1) * np.arange(count) / count:
            R = _turn(np.cos(angle) * x + np.sin(angle) * y, np.pi)
            if self.may_pass(R, self.slack_m):
                options.append((float(self.surface.upper_bounds(self.some @ R.T).mean()), R))
        for _, R in sorted(options, key=lambda item: item[0])[:_TRIES]:
            found = _axis(self.refined(R))
            found -= (found @ axis) * axis
            R = _turn(found / np.linalg.norm(found), np.pi)
            if self.passes(R):
                return [R]
        return []

    def order(self, direction: Array) -> tuple[int, Array]:
        """The largest order of a turn about an axis near ``direction`` that is a symmetry, 1 when none is; the axis."""
        fails = [p for p in _PRIMES if not self.may_pass(_turn(direction, 2 * np.pi / p), self.slack_m)]
        if len(fails) == len(_PRIMES):
            return 1, direction
        for n in range(MAX_ORDER, 1, -1):
            angles = 2 * np.pi / n * np.arange(1, n // 2 + 1)  # all of them: one may pass by chance
            if any(n % p == 0 for p in fails):
                continue
            if not all(self.may_pass(_turn(direction, angle), self.slack_m) for angle in angles):
                continue
            axis = _axis(self.refined(_turn(direction, angles[0])))
            if all(self.passes(_turn(axis, angle)) for angle in angles):
                return n, axis
        return 1, direction

    def group(self, directions: Array) -> list[Array]:
        """Rotations but the identity that, with it, form a finite group of symmetries."""
        turns: list[tuple[int, Array]] = []
        for direction in directions:
            n, axis = self.order(direction)
            if n > _POLYHEDRAL:
                turns = [(n, axis)]
                break
            turns += [(n, axis)] if n > 1 else []
        turns.sort(key=lambda item: -item[0])
        generators = [_turn(axis, 2 * np.pi / n) for n, axis in turns]
        if turns:
            generators += self.flip(turns[0][1], turns[0][0])
        group = np.eye(3)[None]
        for generator in generators:
            if not _is_among(generator, group):
                larger = _closure(group, generator)
                if all(self.passes(R) for R in larger[1:]):
                    group = larger
        return list(group[1:])


def _closure(group: Array, generator: Array) -> Array:
    """The exact group (N, 3, 3) that a group and ``generator`` (3, 3) generate; the group itself if too large."""
    generators, larger = [*group[1:], generator], group
    queue = [generator]
    while queue:
        a = queue.pop()
        if _is_among(a, larger):
            continue
        larger = np.concatenate([larger, a[None]])
        if len(larger) > _LARGEST_GROUP:
            return group
        queue += [a @ b for b in generators]
    return _exact(larger)


def _exact(group: Array) -> Array:
    """The exact group next to rotations (N, 3, 3) that form one nearly: each becomes the mean of all its products."""
    flat = group.reshape(len(group), 9)
    products = np.einsum("iab,jcb->ijac", group, group).reshape(-1, 9)  # R_i R_j^-1
    table = np.argmax(products @ flat.T, axis=1).reshape(len(group), len(group))
    for _ in range(_REFINEMENTS):
        means = np.einsum("ijab,jbc->iac", group[table], group)
        u, _, vt = np.linalg.svd(means)
        group = u @ vt
    return group


def _is_among(R: Array, group: Array) -> bool:
    """Whether a rotation (3, 3) is nearly one of ``group`` (N, 3, 3)."""
    return bool((np.einsum("nab,ab->n", group, R) > 1 + 2 * np.cos(_SAME_RAD)).any())


def _diameter(mesh: trimesh.Trimesh) -> float:
    return diameter(mesh.convex_hull.vertices)


def _sharpest(mesh: trimesh.Trimesh, count: int) -> Array:
    """Up to ``count`` vertices (N, 3), those of the sharpest edges first."""
    sharpness = np.zeros(len(mesh.vertices))
    np.maximum.at(sharpness, mesh.face_adjacency_edges, mesh.face_adjacency_angles[:, None])
    return np.asarray(mesh.vertices)[np.argsort(-sharpness, kind="stable")[:count]]


def _turn(axis: Array, angle: float) -> Array:
    return rotation_from_rotvec(angle * axis)


def _axis(R: Array) -> Array:
    rotvec = rotvec_from_rotation(R)
    return rotvec / np.linalg.norm(rotvec)


def _across(axis: Array) -> Array:
    """A unit vector (3,) across ``axis``."""
    across = np.asarray(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]), dtype=np.float64)
    return across / np.linalg.norm(across)
