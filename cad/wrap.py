"""Wraps a surface that cannot be repaired: a new closed surface at half a cell, whatever the winding and the holes.

After Nooruddin and Turk 2003, "Simplification and repair of polygonal models using volumetric techniques": along each
axis the parity of the surfaces crossed says what is inside, columns that enter more often than they leave do not vote,
and the votes, spread between the cells that the surface leaves free, decide by majority. The surface between inside and
outside is found by marching tetrahedra and drawn onto the triangles nearby.
"""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from cad.soup import Ints, Soup
from cad.spatial import Array

_MARGIN = 3  # cells around the surface
_OFF_CENTRE = 0.017  # of a cell, so that lines do not run along edges
_SMOOTHING = 0.6  # cells
_SPREADING = 40  # steps of a cell, for votes that holes led astray
_CHUNK = 4_000_000


def wrap(soup: Soup, cells: int) -> Soup | None:
    """A closed surface around what the triangles enclose, with ``cells`` along its longest side.

    None where they enclose nothing.
    """
    low, high = soup.vertices.min(axis=0), soup.vertices.max(axis=0)
    cell = float((high - low).max()) / cells
    origin = low - (_MARGIN + _OFF_CENTRE) * cell
    shape = np.ceil((high - origin) / cell).astype(int) + _MARGIN
    votes, voters = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    triangles = (soup.triangles - origin) / cell
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        within, valid = _parity(triangles[:, :, order], shape[order])
        back = np.argsort(order)
        votes += within.transpose(back)
        voters += valid.transpose(back)
    points, owner = _samples(triangles)
    free = np.ones(shape, bool)
    free[tuple(np.round(points).astype(int).T)] = False
    share = _settled(np.where(voters > 0, votes / np.maximum(voters, 1), 0.5), free)
    if not (share > 0.5).any():
        return None
    surface = march(gaussian_filter((share > 0.5).astype(np.float32), _SMOOTHING), 0.5)
    nearest = owner[KDTree(points).query(surface.vertices)[1]]
    target = closest_point(triangles[nearest], surface.vertices)
    near = np.linalg.norm(target - surface.vertices, axis=1, keepdims=True) <= 1
    return Soup(vertices=np.where(near, target, surface.vertices) * cell + origin, faces=surface.faces)


def march(field: Array, level: float) -> Soup:
    """The closed surface where a field over a grid (X, Y, Z), below ``level`` at its border, crosses it; in cells."""
    shape = np.array(field.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    above = field > level
    x, y, z = shape - 1  # cells
    corners = np.array([above[i : x + i, j : y + j, k : z + k] for i, j, k in np.ndindex(2, 2, 2)])
    base = np.argwhere(corners.any(axis=0) & ~corners.all(axis=0)) @ strides
    values, flat = field.reshape(-1), above.reshape(-1)
    cut: list[Ints] = []
    for axes in permutations(range(3)):  # Kuhn's six tetrahedra share the diagonal, and neighbours' faces agree
        tetrahedra = base[:, None] + np.concatenate([[0], np.cumsum(strides[list(axes)])])
        order = np.argsort(~flat[tetrahedra], axis=1, kind="stable")  # inside first
        tetrahedra = np.take_along_axis(tetrahedra, order, axis=1)
        count = flat[tetrahedra].sum(axis=1)
        a, b, c, d = np.moveaxis(tetrahedra, 1, 0)[:, :, None]
        one, two, three = count == 1, count == 2, count == 3
        cut.append(np.stack([np.hstack(e)[one] for e in ((a, b), (a, c), (a, d))], axis=1))
        cut.append(np.stack([np.hstack(e)[three] for e in ((a, d), (b, d), (c, d))], axis=1))
        cut.append(np.stack([np.hstack(e)[two] for e in ((a, c), (a, d), (b, d))], axis=1))
        cut.append(np.stack([np.hstack(e)[two] for e in ((a, c), (b, d), (b, c))], axis=1))
    inner_outer = np.concatenate(cut)  # (F, 3, 2) grid points above and below, for every corner of every triangle
    keys, index = np.unique(inner_outer[..., 0] * len(values) + inner_outer[..., 1], return_inverse=True)
    inner, outer = keys // len(values), keys % len(values)
    share = ((values[inner] - level) / (values[inner] - values[outer]))[:, None]
    p, q = (np.stack(np.unravel_index(points, field.shape), axis=1).astype(float) for points in (inner, outer))
    vertices, faces = p + share * (q - p), index.reshape(-1, 3)
    outwards = (q - p)[faces].sum(axis=1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    turn = np.einsum("ij,ij->i", np.cross(b - a, c - a), outwards) < 0
    return Soup(vertices=vertices, faces=np.where(turn[:, None], faces[:, ::-1], faces).astype(np.int64))


def _parity(triangles: Array, shape: Ints) -> tuple[Array, Array]:
    """Grid points (X, Y, Z) that an odd number of triangles (F, 3, 3) lies below in z, and those in even columns."""
    toggles = np.zeros(shape, np.int16)
    low = np.ceil(triangles[:, :, :2].min(axis=1)).astype(int)
    extent = np.maximum(np.floor(triangles[:, :, :2].max(axis=1)).astype(int) - low + 1, 0)
    total = extent.prod(axis=1)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(np.cumsum(total) // _CHUNK)) + 1, [len(total)]])
    for begin, end in pairwise(starts):
        owner = np.repeat(np.arange(begin, end), total[begin:end])
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(total[begin:end]) - total[begin:end], total[begin:end])
        x, y = low[owner, 0] + rank // extent[owner, 1], low[owner, 1] + rank % extent[owner, 1]
        a, b, c = np.moveaxis(triangles[owner], 1, 0)
        weights = [_twice_area(q, r, x, y) for q, r in ((b, c), (c, a), (a, b))]
        area = np.sum(weights, axis=0)
        hit = (area != 0) & ((np.min(weights, axis=0) >= 0) | (np.max(weights, axis=0) <= 0))
        heights = np.stack([a[:, 2], b[:, 2], c[:, 2]])
        depth = (np.stack(weights) * heights).sum(axis=0)[hit] / area[hit]
        np.add.at(toggles, (x[hit], y[hit], np.ceil(depth).astype(int)), 1)
    crossed = np.cumsum(toggles, axis=2)
    valid = np.broadcast_to(crossed[:, :, -1:] % 2 == 0, crossed.shape)
    return (crossed % 2 == 1) & valid, valid


def _twice_area(a: Array, b: Array, x: Array, y: Array) -> Array:
    return (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])


def _samples(triangles: Array) -> tuple[Array, Ints]:
    """Points (N, 3) on triangles (F, 3, 3) and the triangle (N,) of each, about two along a cell; lengths in cells."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    owner = np.repeat(np.arange(len(areas)), np.ceil(4 * areas).astype(int))
    u, v = np.random.default_rng(0).random((2, len(owner), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(triangles[owner], 1, 0)
    return a + u * (b - a) + v * (c - a), owner


def _settled(share: Array, free: NDArray[np.bool_]) -> Array:
    """Shares of votes (X, Y, Z) after they have spread between the cells that the surface leaves free."""
    weight = free.astype(np.float32)
    shifts = [(step, axis) for step in (1, -1) for axis in range(3)]
    around = 1 + np.sum([np.roll(weight, step, axis) for step, axis in shifts], axis=0)
    for _ in range(_SPREADING):
        held = share * weight
        spread = share + sum(np.roll(held, step, axis) for step, axis in shifts)
        share = np.where(free, spread / around, share)
    return share
