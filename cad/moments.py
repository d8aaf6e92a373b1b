"""Directions that a rotation axis of a solid may have, from the moments of its volume.

A rotation that maps a solid onto itself leaves every function of direction that the solid determines unchanged, so
the gradient of such a function over the unit sphere must vanish on the rotation's axis. The functions here are the
moments ``f_k(u)``, the integrals of ``(u . x) ** k`` over the volume about its centroid, for k = 2, 4 and 6. Integrals
over the volume hardly depend on how a surface is cut into triangles.
"""

from __future__ import annotations

from itertools import combinations_with_replacement, product

import numpy as np
import trimesh
from numpy.typing import NDArray

from cad.spatial import Array

Ints = NDArray[np.int64]

_DEGREE = 6
_STARTS, _TRIALS = 240, 36
_STEPS = 25
_LONGEST_STEP = 0.1
_FLAT = 1e-3  # a gradient this small, relative to the function's range, is none
_SAME = np.cos(np.radians(1.0))


def axis_directions(mesh: trimesh.Trimesh, centre: Array) -> Array:
    """(A, 3) unit directions, no two along one line, that hold every rotation axis of a closed mesh about ``centre``.

    The principal axes of inertia come first. Where a moment is the same all round an axis, directions across it are a
    sample only.
    """
    corners = np.asarray(mesh.triangles) - centre
    corners = corners / np.abs(corners).max()
    volumes = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    starts, trials = _hemisphere(_STARTS), _hemisphere(_TRIALS)
    moments = np.array([_moments(corners @ u, volumes) for u in trials])
    found = [np.linalg.eigh(mesh.moment_inertia)[1].T]
    for degree in (4, 6):
        found.append(_Polynomial(degree, trials, moments[:, degree]).critical_directions(starts))
    kept: list[Array] = []
    for u in np.concatenate(found):
        if all(abs(float(u @ other)) < _SAME for other in kept):
            kept.append(u * np.sign(u[np.argmax(np.abs(u))]))
    return np.array(kept)


class _Polynomial:
    """A homogeneous polynomial of three variables, fitted to values (N,) in directions (N, 3)."""

    def __init__(self, degree: int, directions: Array, values: Array) -> None:
        self._powers = np.array([p for p in product(range(degree + 1), repeat=3) if sum(p) == degree])
        monomials = self._monomials(directions, self._powers)
        self._coefficients = np.linalg.lstsq(monomials, values, rcond=None)[0]
        self._range = float(np.ptp(values))

    def critical_directions(self, starts: Array) -> Array:
        """(M, 3) unit directions where the gradient along the sphere vanishes, by Newton's method from (N, 3)."""
        u = starts
        for _ in range(_STEPS):
            gradient, hessian = self._on_sphere(u)
            step = -np.einsum("nij,nj->ni", np.linalg.pinv(hessian, rcond=1e-7, hermitian=True), gradient)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            u = u + step * np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-300))
            u = u / np.linalg.norm(u, axis=1, keepdims=True)
        gradient, _ = self._on_sphere(u)
        return u[np.linalg.norm(gradient, axis=1) <= _FLAT * self._range]

    def _on_sphere(self, u: Array) -> tuple[Array, Array]:
        """Riemannian gradient (N, 3) and Hessian (N, 3, 3) at unit directions (N, 3)."""
        first = np.stack([self._derivative(u, (i,)) for i in range(3)], axis=-1)
        second = np.empty((len(u), 3, 3))
        for i, j in combinations_with_replacement(range(3), 2):
            second[:, i, j] = second[:, j, i] = self._derivative(u, (i, j))
        across = np.eye(3) - u[:, :, None] * u[:, None, :]
        radial = np.einsum("ni,ni->n", u, first)
        gradient = np.einsum("nij,nj->ni", across, first)
        return gradient, across @ second @ across - radial[:, None, None] * across

    def _derivative(self, u: Array, variables: tuple[int, ...]) -> Array:
        powers, factors = self._powers.copy(), self._coefficients.copy()
        for i in variables:
            factors *= powers[:, i]
            powers[:, i] = np.maximum(powers[:, i] - 1, 0)
        return self._monomials(u, powers) @ factors

    @staticmethod
    def _monomials(u: Array, powers: Ints) -> Array:
        """(N, M) products of the powers (M, 3) of the coordinates of u (N, 3)."""
        table = np.ones((powers.max() + 1, *u.shape))
        for k in range(1, len(table)):
            table[k] = table[k - 1] * u
        x, y, z = (table[powers[:, i], :, i] for i in range(3))
        return (x * y * z).T


def _moments(heights: Array, volumes: Array) -> Array:
    """Integrals of height ** k, k = 0 to 6, over tetrahedra from the origin with corner heights (N, 3), volumes (N,).

    Over a simplex it is the complete homogeneous symmetric polynomial of the heights times a constant (Lasserre and
    Avrachenkov, American Mathematical Monthly, 2001); the origin's height is zero. The constants are left out.
    """
    a, b, c = np.ascontiguousarray(heights.T)
    powers = [np.ones_like(a)]
    for _ in range(_DEGREE):
        powers.append(powers[-1] * a)
    for other in (b, c):
        for k in range(1, _DEGREE + 1):
            powers[k] = powers[k] + other * powers[k - 1]
    return np.array([p @ volumes for p in powers])


def _hemisphere(count: int) -> Array:
    """(count, 3) unit vectors spread evenly over half the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = k / count, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
