"""Rotational symmetries of a part, found from its mesh and written in BOP's ``models_info`` form.

Only proper rotations count: a mirror plane cannot be reached by turning the part. A rotation about the centroid is a
symmetry when it moves no point of the surface farther than the tolerance from the surface. Candidates come from two
places that complement each other: simple turns about the principal axes of inertia (right for any tessellation) and
maps between pairs of hull vertices (right for solids with equal moments, such as a cube).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from cad.equivalence import Axis, Symmetries, symmetries_to_json
from cad.meshes import distance_to_surface, surface_samples
from cad.spatial import Array, rotation_from_rotvec, transform

RELATIVE_TOLERANCE = 0.01
"""A symmetry may move the surface by this share of the part's diameter."""
SAME_ROTATION_RAD = np.radians(5.0)
TURNS = (2, 3, 4, 5, 6, 8)
_ODD_ANGLES_RAD = (0.41, 1.0, 1.73, 2.6)  # shared by no finite turn: what passes them is continuous
_GOOD = 0.25  # a rotation found this well, relative to the tolerance, is not looked for again
_SAMPLES = 600
_DENSE = 20_000
_DOUBTFUL = 20  # points whose distance from the dense samples is largest, measured exactly
_MAX_PAIRS = 4000


def find_symmetries(mesh: trimesh.Trimesh, tolerance_m: float | None = None) -> Symmetries:
    """All proper rotational symmetries of a closed mesh within ``tolerance_m`` (default 1 % of its diameter)."""
    checker = _Checker(mesh, tolerance_m)
    axes = [axis for axis in checker.principal_axes if checker.is_continuous(axis)]
    found: list[tuple[float, Array]] = []
    for R in checker.candidates():
        if _covered(R, axes):
            continue
        if any(d < _GOOD * checker.tolerance_m and _same(R, other, axes) for d, other in found):
            continue
        if not checker.may_pass(R):
            continue
        deviation = checker.deviation(R)
        if deviation <= checker.tolerance_m:
            found.append((deviation, R))
    kept: list[Array] = []
    for _, R in sorted(found, key=lambda item: item[0]):
        if not any(_same(R, other, axes) for other in kept):
            kept.append(R)
    c = checker.centre
    return Symmetries(
        discrete=np.array([transform(R, c - R @ c) for R in kept]).reshape(-1, 4, 4),
        continuous=tuple(Axis(direction=axis, point=c) for axis in axes),
        tolerance_m=checker.tolerance_m,
    )


def models_info(mesh: trimesh.Trimesh, symmetries: Symmetries) -> dict[str, Any]:
    """The part's entry of a BOP ``models_info.json``: millimetres, transforms as 16 numbers row by row."""
    low, high = 1e3 * mesh.bounds
    info: dict[str, Any] = {"diameter": round(1e3 * diameter(mesh), 6)}
    info |= {f"min_{a}": round(float(v), 6) for a, v in zip("xyz", low, strict=True)}
    info |= {f"size_{a}": round(float(v), 6) for a, v in zip("xyz", high - low, strict=True)}
    info |= symmetries_to_json(symmetries)
    info["symmetry_tolerance"] = round(1e3 * symmetries.tolerance_m, 9)
    return info


def diameter(mesh: trimesh.Trimesh) -> float:
    """Largest distance in metres between two points of the mesh."""
    v = mesh.convex_hull.vertices
    return float(max(np.linalg.norm(v - p, axis=1).max() for p in v))


class _Checker:
    """One mesh about its centroid, prepared for testing many rotations."""

    def __init__(self, mesh: trimesh.Trimesh, tolerance_m: float | None) -> None:
        self.tolerance_m = RELATIVE_TOLERANCE * diameter(mesh) if tolerance_m is None else float(tolerance_m)
        if not self.tolerance_m > 0:
            raise ValueError(f"tolerance {self.tolerance_m} m: it must be positive")
        self.centre = np.array(mesh.center_mass)
        self.mesh = trimesh.Trimesh(mesh.vertices - self.centre, mesh.faces, process=False)
        self.corners = np.array(self.mesh.convex_hull.vertices)
        rng = np.random.default_rng(0)
        self.samples = np.concatenate([surface_samples(self.mesh, _SAMPLES, rng)[0], self.mesh.vertices[:_SAMPLES]])
        dense = np.concatenate([surface_samples(self.mesh, _DENSE, rng)[0], self.mesh.vertices])
        self._tree = cKDTree(dense)
        self._spacing = 4 * np.sqrt(self.mesh.area / _DENSE)
        moments, axes = np.linalg.eigh(self.mesh.moment_inertia)
        self.moments, self.principal_axes = moments, [_signed(axis) for axis in axes.T]

    def deviation(self, R: Array) -> float:
        """Largest distance in metres from the surface of the sample points turned by ``R``."""
        turned = self.samples @ R.T
        near = self._tree.query(turned)[0]
        doubtful = turned[np.argsort(-near)[:_DOUBTFUL]]
        return float(distance_to_surface(self.mesh, doubtful).max())

    def may_pass(self, R: Array) -> bool:
        """Cheap test that rejects most rotations that are no symmetry and never one that is."""
        near = self._tree.query(self.samples[::8] @ R.T)[0]
        return bool(near.max() <= self.tolerance_m + self._spacing)

    def is_continuous(self, axis: Array) -> bool:
        """True when turning about ``axis`` by angles that no finite turn shares leaves the surface in place."""
        turns = [rotation_from_rotvec(angle * axis) for angle in _ODD_ANGLES_RAD]
        return all(self.may_pass(R) and self.deviation(R) <= self.tolerance_m for R in turns)

    def candidates(self) -> Iterator[Array]:
        for axis in self.principal_axes:
            for n in TURNS:
                for k in range(1, n):
                    yield rotation_from_rotvec(2 * np.pi * k / n * axis)
        yield from self._vertex_maps()

    def _vertex_maps(self) -> Iterator[Array]:
        """Rotations that map a rare hull vertex and a second one to vertices as far out and as far apart."""
        v, tol = self.corners, self.tolerance_m
        radius = np.linalg.norm(v, axis=1)
        far = np.flatnonzero(radius > 0.5 * radius.max())
        same_radius = np.abs(radius[far, None] - radius[None]) <= tol
        a = far[np.argmin(same_radius.sum(axis=1))]
        apart = np.linalg.norm(v - v[a], axis=1)
        spread = np.linalg.norm(np.cross(v[a], v), axis=1) / radius[a]
        b = int(np.argmax(spread))
        count = 0
        for i in np.flatnonzero(np.abs(radius - radius[a]) <= tol):
            partners = np.abs(radius - radius[b]) <= tol
            partners &= np.abs(np.linalg.norm(v - v[i], axis=1) - apart[b]) <= 2 * tol
            for j in np.flatnonzero(partners):
                count += 1
                if count > _MAX_PAIRS:
                    return
                yield _frame(v[i], v[j]) @ _frame(v[a], v[b]).T


def _frame(p: Array, q: Array) -> Array:
    x = p / np.linalg.norm(p)
    z = np.cross(p, q)
    z = z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _signed(axis: Array) -> Array:
    """The axis or its opposite, whichever has its largest component positive."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def _covered(R: Array, axes: list[Array]) -> bool:
    """True for the identity and for turns about a continuous axis."""
    return _same(R, np.eye(3), axes)


def _same(a: Array, b: Array, axes: list[Array]) -> bool:
    """True when two rotations are alike, or differ by a turn about a continuous axis only."""
    if np.trace(a.T @ b) > 1 + 2 * np.cos(SAME_ROTATION_RAD):
        return True
    return any(float((a @ axis) @ (b @ axis)) > np.cos(SAME_ROTATION_RAD) for axis in axes)
