"""Cuts a closed soup into oriented shells: separates what only touches along edges, and turns normals outwards."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cad.soup import Ints, Soup, distinct_corners, orient
from cad.spatial import Array

_RAYS = np.array(
    [[0.36, 0.48, 0.80], [-0.64, 0.60, 0.48], [0.28, -0.80, 0.53], [-0.53, -0.36, 0.77], [0.77, 0.1, -0.63]]
)
"""Directions without meaning for any part, so that rays meet no edge."""
_MOST_PATCHES = 400
_SAME_ANGLE_RAD = 1e-4


def shells_of(soup: Soup) -> list[Soup] | None:
    """The closed, consistently wound shells of a soup that hangs together; None where it does not close.

    Where more than two triangles share an edge, the winding as given decides which of them belong together, and if that
    contradicts itself the parity of the surfaces that a ray crosses.
    """
    oriented, patch, orientable = orient(soup)
    if oriented.is_closed:
        return [oriented] if orientable else None
    if (soup.edges.counts % 2).any() or patch.max() >= _MOST_PATCHES:
        return None
    given = soup if soup.volume > 0 else soup.flipped()
    for candidate in (given, oriented_by_parity(oriented, patch)):
        cut = cut_apart(candidate)
        if cut is not None and cut.is_closed and distinct_corners(cut.faces).all():
            return cut.components()
    return None


def oriented_by_parity(soup: Soup, patch: Ints) -> Soup:
    """Patches (a number (F,) for every triangle) wound outwards; those with solid on both sides are dropped."""
    a, b, c = np.moveaxis(soup.triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    size = np.linalg.norm(normals, axis=1)
    turn, keep = np.zeros(len(soup.faces), bool), np.zeros(len(soup.faces), bool)
    for i in range(patch.max() + 1):
        members = np.flatnonzero(patch == i)
        largest = members[np.argmax(size[members])]
        origin, normal = soup.triangles[largest].mean(axis=0), normals[largest]
        rays = _RAYS * np.sign(_RAYS @ normal)[:, None]
        front, back = (_mostly_inside(soup, origin, side * rays) for side in (1, -1))
        keep[members], turn[members] = front != back, front
    return soup.flipped(turn).take(keep)


def cut_apart(soup: Soup) -> Soup | None:
    """Vertices doubled so that every edge joins two triangles, each with the one across the solid between them.

    None where the winding at an edge contradicts itself.
    """
    edges = soup.edges
    order = np.argsort(edges.index, kind="stable")
    simple = edges.counts[edges.index[order]] == 2
    first, second = order[simple][0::2], order[simple][1::2]
    if not len(soup.faces) or (edges.forward[first] == edges.forward[second]).any():
        return None
    pairs = [np.stack([first, second], axis=1)]
    starts = np.concatenate([[0], np.cumsum(edges.counts)])
    for edge in np.flatnonzero(edges.counts != 2):
        joined = _pairs_around(soup, int(edge), order[starts[edge] : starts[edge + 1]])
        if joined is None:
            return None
        pairs.append(joined)
    one, other = np.concatenate(pairs).T
    corners = 3 * len(soup.faces)
    after = np.arange(corners) + np.where(np.arange(corners) % 3 == 2, -2, 1)  # the corner a side runs to
    rows, columns = np.concatenate([one, after[one]]), np.concatenate([after[other], other])
    links = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (corners, corners))
    _, first, label = np.unique(connected_components(links, directed=False)[1], return_index=True, return_inverse=True)
    return Soup(vertices=soup.vertices[soup.faces.reshape(-1)[first]], faces=label.reshape(-1, 3).astype(np.int64))


def all_inside(soup: Soup, points: Array) -> bool:
    """Whether all points (N, 3) lie inside a closed shell."""
    return all(_mostly_inside(soup, point, _RAYS[:3]) for point in points)


def _pairs_around(soup: Soup, edge: int, sides: Ints) -> Ints | None:
    """Pairs (K, 2) of the sides on an edge whose triangles have solid between them."""
    low, high = soup.vertices[soup.edges.ends[edge]]
    axis = (high - low) / np.linalg.norm(high - low)
    across = _opposite(soup, sides) - low
    across = across - np.outer(across @ axis, axis)
    u = across[0] / np.linalg.norm(across[0])
    angle = np.arctan2(across @ np.cross(axis, u), across @ u)
    order = np.argsort(angle)
    gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    order = np.roll(order, -1 - int(np.argmax(gaps)))
    place = np.cumsum(np.roll(gaps, -1 - int(np.argmax(gaps))) > _SAME_ANGLE_RAD)
    place = np.concatenate([[0], place[:-1]])
    forward = soup.edges.forward[sides[order]]  # forward: solid at smaller angles
    order = order[np.lexsort([~forward, place])]
    ring, turn = sides[order], soup.edges.forward[sides[order]]
    if turn[0]:
        ring, turn = np.roll(ring, -1), np.roll(turn, -1)
    if len(ring) % 2 or turn[0::2].any() or not turn[1::2].all():
        return None
    return np.stack([ring[0::2], ring[1::2]], axis=1)


def _opposite(soup: Soup, sides: Ints) -> Array:
    """(K, 3) corner opposite to each side."""
    return soup.vertices[soup.faces[sides // 3, (sides % 3 + 2) % 3]]


def _mostly_inside(soup: Soup, origin: Array, rays: Array) -> bool:
    return sum(_crossings(soup.triangles, origin, ray) % 2 for ray in rays) > len(rays) / 2


def _crossings(triangles: Array, origin: Array, ray: Array) -> int:
    """How many triangles (F, 3, 3) a ray crosses, away from where it begins (Moeller and Trumbore 1997)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    ab, ac, start = b - a, c - a, origin - a
    p = np.cross(ray, ac)
    determinant = np.einsum("ij,ij->i", ab, p)
    hit = np.abs(determinant) > 1e-12 * np.linalg.norm(ab, axis=1) * np.linalg.norm(ac, axis=1)
    ab, ac, start, p, determinant = ab[hit], ac[hit], start[hit], p[hit], determinant[hit]
    u = np.einsum("ij,ij->i", start, p) / determinant
    q = np.cross(start, ab)
    v = q @ ray / determinant
    t = np.einsum("ij,ij->i", ac, q) / determinant
    return int(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)).sum())
