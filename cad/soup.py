"""Triangle soups and how their triangles hang together along edges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cad.spatial import Array

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Soup:
    """Triangles without any promise: vertices (V, 3) in one unit of length, faces (F, 3) of vertex indices."""

    vertices: Array
    faces: Ints

    @cached_property
    def edges(self) -> Edges:
        """The edges between the triangles."""
        return Edges.of(self.faces)

    @property
    def triangles(self) -> Array:
        """(F, 3, 3) corners."""
        return self.vertices[self.faces]

    @property
    def volume(self) -> float:
        """Signed volume; positive where the normals of a closed surface point outwards."""
        a, b, c = np.moveaxis(self.triangles - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    @property
    def is_closed(self) -> bool:
        """Every edge joins exactly two triangles."""
        return bool(len(self.faces)) and bool((self.edges.counts == 2).all())

    def take(self, faces: Mask | Ints) -> Soup:
        """The soup of some faces (a mask or indices) with only the vertices they use."""
        used, index = np.unique(self.faces[faces], return_inverse=True)
        return Soup(vertices=self.vertices[used], faces=index.reshape(-1, 3).astype(np.int64))

    def flipped(self, mask: Mask | bool = True) -> Soup:
        """With the winding of some triangles (F,) turned round."""
        turn = np.broadcast_to(mask, len(self.faces))
        return Soup(vertices=self.vertices, faces=np.where(turn[:, None], self.faces[:, ::-1], self.faces))

    def pieces(self) -> Ints:
        """(F,) number of the piece that each triangle belongs to; a piece hangs together along edges."""
        edges = self.edges
        owner = np.arange(3 * len(self.faces)) // 3
        links = coo_matrix((np.ones(len(owner), bool), (owner, edges.index)), (len(self.faces), len(edges.counts)))
        return connected_components(links @ links.T, directed=False)[1].astype(np.int64)

    def components(self) -> list[Soup]:
        """The pieces one by one, in the order of their first triangles."""
        piece = self.pieces()
        if not piece.any():
            return [self] if len(piece) else []
        order = np.argsort(piece, kind="stable")
        return [self.take(faces) for faces in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)]


def soups_of(scene: trimesh.Scene) -> list[Soup]:
    """The triangles of every mesh in a scene, where the scene places it."""
    soups = []
    for node in scene.graph.nodes_geometry:
        pose, key = scene.graph[node]
        mesh = scene.geometry[key]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            vertices = trimesh.transform_points(np.asarray(mesh.vertices, dtype=np.float64), pose)
            soups.append(Soup(vertices=vertices, faces=np.array(mesh.faces, dtype=np.int64)))
    return soups


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Edges of triangles; half-edge ``3 f + k`` is the side of triangle f from its corner k to the next.

    ``ends`` (E, 2) are the vertices of each edge, the lower first; ``counts`` (E,) how many sides lie on it; ``index``
    (3F,) is each side's edge and ``forward`` (3F,) whether the side runs from the lower vertex to the higher.
    """

    ends: Ints
    counts: Ints
    index: Ints
    forward: Mask

    @staticmethod
    def of(faces: Ints) -> Edges:
        """The edges of triangles (F, 3)."""
        sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high = sides.min(axis=1), sides.max(axis=1)
        stride = int(high.max(initial=0)) + 1
        keys, index, counts = np.unique(low * stride + high, return_inverse=True, return_counts=True)
        ends = np.stack([keys // stride, keys % stride], axis=1)
        return Edges(ends=ends, counts=counts, index=index.reshape(-1), forward=sides[:, 0] == low)

    def sides(self, edge: int) -> Ints:
        """The half-edges on one edge."""
        return np.flatnonzero(self.index == edge)


def orient(soup: Soup) -> tuple[Soup, Ints, bool]:
    """Wind triangles alike across every edge that joins just two of them, turning as few as possible.

    Returns the soup, the number (F,) of the patch each triangle belongs to (a patch is what such edges join), and
    whether all patches can be oriented (a Moebius strip cannot). Every triangle is taken twice, once as it is and
    once turned; joining the copies that agree leaves two components for a patch that can be oriented, one otherwise.
    """
    edges, count = soup.edges, len(soup.faces)
    order = np.argsort(edges.index, kind="stable")
    order = order[edges.counts[edges.index[order]] == 2]
    first, second = order[0::2], order[1::2]
    agree = edges.forward[first] != edges.forward[second]
    a, b = first // 3, second // 3
    rows = np.concatenate([a, a + count])
    columns = np.concatenate([np.where(agree, b, b + count), np.where(agree, b + count, b)])
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1]
    kept, turned = label[:count], label[count:]
    patches, patch = np.unique(np.minimum(kept, turned), return_inverse=True)
    patch = patch.reshape(-1)
    turn = kept > turned
    share = np.bincount(patch, turn, len(patches)) / np.bincount(patch, minlength=len(patches))
    turn ^= (share > 0.5)[patch]
    return soup.flipped(turn), patch.astype(np.int64), bool((kept != turned).all())


def weld(soup: Soup, digits: int) -> Soup:
    """Make vertices one that agree in ``digits`` decimals; drop triangles that vanish and vertices without any."""
    rounded = np.round(soup.vertices, digits) + 0.0  # no -0.0
    _, first, index = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    return Soup(vertices=soup.vertices[first], faces=index.reshape(-1)[soup.faces]).take(
        distinct_corners(index.reshape(-1)[soup.faces])
    )


def distinct_corners(faces: Ints) -> Mask:
    """(F,) whether a triangle has three different vertices."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)
