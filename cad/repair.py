"""Repairs of triangle soups, each for one fault: copies, inner walls, gaps, T-junctions and holes.

Every repair returns the soup it was given, itself, where there is nothing to do.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from manifold3d import triangulate
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from cad.soup import Ints, Soup, distinct_corners, orient
from cad.spatial import Array

_MOST_WALLS = 64
_PARALLEL = 1e-6  # 1 - |cosine| between the normals of holes in one plane


@dataclass(frozen=True, kw_only=True)
class Hole:
    """A hole that was filled: its largest width, and how far its rim leaves a plane, both in metres."""

    width: float
    unevenness: float


def open_edges(soup: Soup) -> Ints:
    """Edges on which an odd number of triangles meets, so that the surface does not close there."""
    return np.flatnonzero(soup.edges.counts % 2 == 1)


def drop_copies(soup: Soup) -> tuple[Soup, int]:
    """Without triangles that occur several times; also returns how many were dropped.

    Of a patch of copies one stays, unless the surface closes better without: two solids that touch, whose common wall
    occurs once for each, become one.
    """
    corners = np.sort(soup.faces, axis=1)
    _, first, index, counts = np.unique(corners, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if (counts == 1).all():
        return soup, 0
    keep = np.zeros(len(soup.faces), bool)
    keep[first] = True
    multiple = first[(counts > 1)]
    even = keep & (counts[index.reshape(-1)] % 2 == 0)
    sides = soup.edges.index.reshape(-1, 3)
    counts = np.bincount(sides[keep].reshape(-1), minlength=len(soup.edges.counts))
    for patch in _patches(soup, multiple):
        pairs = patch[even[patch]]
        touched, removed = np.unique(sides[pairs], return_counts=True)
        if ((counts[touched] - removed) % 2).sum() < (counts[touched] % 2).sum():
            keep[pairs] = False
    return soup.take(keep), int((~keep).sum())


def drop_walls(soup: Soup) -> tuple[Soup, int]:
    """Without inner walls between compartments (three surfaces meet along the wall's rim), and how many there were."""
    given, walls = soup, 0
    while (soup.edges.counts[open_edges(soup)] > 1).any():
        if walls == _MOST_WALLS:
            return given, 0  # these are no walls
        edges, (_, patch, _) = soup.edges, orient(soup)
        rim = edges.counts[edges.index] != 2
        sound = rim & (edges.counts[edges.index] % 2 == 1) & (edges.counts[edges.index] > 1)
        of_side = np.repeat(patch, 3)
        sides, odd = np.bincount(of_side, rim), np.bincount(of_side, sound)
        candidates = np.flatnonzero((sides > 0) & (sides == odd))
        if not len(candidates):
            break
        a, b, c = np.moveaxis(soup.triangles, 1, 0)
        areas = np.bincount(patch, np.linalg.norm(np.cross(b - a, c - a), axis=1))
        soup = soup.take(patch != candidates[np.argmin(areas[candidates])])
        walls += 1
    return soup, walls


def close_gaps(soup: Soup, gap: float) -> Soup:
    """Vertices of open edges that lie within ``gap`` of each other made one."""
    rim = np.unique(soup.edges.ends[open_edges(soup)])
    pairs = KDTree(soup.vertices[rim]).query_pairs(gap, output_type="ndarray") if len(rim) else np.empty((0, 2), int)
    if not len(pairs):
        return soup
    links = coo_matrix((np.ones(len(pairs), bool), (rim[pairs[:, 0]], rim[pairs[:, 1]])), 2 * (len(soup.vertices),))
    _, first, label = np.unique(connected_components(links, directed=False)[1], return_index=True, return_inverse=True)
    faces = label.reshape(-1)[soup.faces]
    return Soup(vertices=soup.vertices[first], faces=faces).take(distinct_corners(faces))


def split_t_junctions(soup: Soup, gap: float) -> tuple[Soup, int]:
    """Triangles split where an open edge passes within ``gap`` of a vertex of another open edge; returns the splits."""
    loose = open_edges(soup)
    ends = soup.edges.ends[loose]
    rim = np.unique(ends)
    if not len(rim):
        return soup, 0
    a, b = soup.vertices[ends[:, 0]], soup.vertices[ends[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    near = KDTree(soup.vertices[rim]).query_ball_point((a + b) / 2, length / 2 + gap)
    edge = np.repeat(np.arange(len(ends)), [len(points) for points in near])
    point = rim[np.concatenate(near).astype(np.int64)]
    direction = ((b - a) / length[:, None])[edge]
    offset = soup.vertices[point] - a[edge]
    along = np.einsum("ij,ij->i", offset, direction)
    away = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    on = (away <= gap) & (along > gap) & (along < length[edge] - gap) & (point[:, None] != ends[edge]).all(axis=1)
    order = np.lexsort([along[on], edge[on]])
    edge, point = edge[on][order], point[on][order]
    if not len(edge):
        return soup, 0
    split, first = np.unique(edge, return_index=True)
    inserted = dict(zip(loose[split].tolist(), np.split(point, first[1:]), strict=True))
    sides = soup.edges.index.reshape(-1, 3)
    touched = np.isin(sides, list(inserted)).any(axis=1)
    faces = [face for f in np.flatnonzero(touched) for face in _split(soup, int(f), inserted)]
    stacked = np.concatenate([soup.faces[~touched], np.array(faces, dtype=np.int64)])
    return Soup(vertices=soup.vertices, faces=stacked).take(distinct_corners(stacked)), len(point)


def fill_holes(soup: Soup, flat: float) -> tuple[Soup, list[Hole]]:
    """Holes filled with triangles between their rims; rims within ``flat`` of one plane are filled together.

    A rim inside another in the same plane is an island: the ring between them is filled.
    """
    loops = _loops(soup.edges.ends[open_edges(soup)])
    if not loops:
        return soup, []
    planes = [_plane(soup.vertices[loop]) for loop in loops]
    centres, normals = (np.array(values) for values in zip(*planes, strict=True))
    holes, unevenness = [], np.empty(len(loops))
    for i, loop in enumerate(loops):
        points = soup.vertices[loop]
        unevenness[i] = np.abs((points - centres[i]) @ normals[i]).max()
        holes.append(Hole(width=float(np.linalg.norm(np.ptp(points, axis=0))), unevenness=float(unevenness[i])))
    faces, left = [soup.faces], np.ones(len(loops), bool)
    for i in range(len(loops)):
        if not left[i]:
            continue
        group = left & (np.arange(len(loops)) == i)
        if unevenness[i] <= flat:
            offset = np.abs((centres - centres[i]) @ normals[i])
            group |= left & (unevenness <= flat) & (1 - np.abs(normals @ normals[i]) < _PARALLEL) & (offset <= flat)
        left &= ~group
        faces.append(_fill(soup.vertices, [loops[j] for j in np.flatnonzero(group)], centres[i], normals[i]))
    return Soup(vertices=soup.vertices, faces=np.concatenate(faces)), holes


def _patches(soup: Soup, faces: Ints) -> list[Ints]:
    """The given faces, by what hangs together along edges."""
    sides = soup.edges.index.reshape(-1, 3)[faces].reshape(-1)
    owner = np.arange(len(sides)) // 3
    links = coo_matrix((np.ones(len(sides), bool), (owner, sides)), (len(faces), len(soup.edges.counts))).tocsr()
    label = connected_components(links @ links.T, directed=False)[1]
    return [faces[label == i] for i in range(label.max(initial=-1) + 1)]


def _split(soup: Soup, face: int, inserted: dict[int, Ints]) -> list[tuple[int, int, int]]:
    """The triangles of a face whose sides have vertices inserted: fans, one side after the other."""
    corners = [int(v) for v in soup.faces[face]]
    edges = [int(e) for e in soup.edges.index[3 * face : 3 * face + 3]]
    done, pending = [], [(corners, edges)]
    while pending:
        (a, b, c), (ab, bc, ca) = pending.pop()
        if ab not in inserted:
            if bc in inserted:
                pending.append(([b, c, a], [bc, ca, ab]))
            elif ca in inserted:
                pending.append(([c, a, b], [ca, ab, bc]))
            else:
                done.append((a, b, c))
            continue
        middle = [int(v) for v in inserted[ab]]
        if soup.edges.ends[ab][0] != a:
            middle.reverse()
        chain = [a, *middle, b]
        fan = [([chain[i], chain[i + 1], c], [-1, -1, -1]) for i in range(len(chain) - 1)]
        fan[0][1][2], fan[-1][1][1] = ca, bc
        pending.extend(fan)
    return done


def _loops(ends: Ints) -> list[Ints]:
    """Simple closed loops that edges (E, 2) fall into; every vertex has an even number of them."""
    around = defaultdict(list)
    for i, (a, b) in enumerate(ends):
        around[int(a)].append((i, int(b)))
        around[int(b)].append((i, int(a)))
    used, loops = np.zeros(len(ends), bool), []
    for start in list(around):
        path, place = [start], {start: 0}
        while True:
            step = next(((i, to) for i, to in around[path[-1]] if not used[i]), None)
            if step is None:
                break
            used[step[0]] = True
            if step[1] in place:
                at = place[step[1]]
                loops.append(np.array(path[at:], dtype=np.int64))
                for vertex in path[at + 1 :]:
                    del place[vertex]
                del path[at + 1 :]
            else:
                place[step[1]] = len(path)
                path.append(step[1])
    return loops


def _plane(points: Array) -> tuple[Array, Array]:
    """Centre and unit normal of the plane of a loop of points (N, 3)."""
    centre = points.mean(axis=0)
    around = points - centre
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    if np.linalg.norm(normal) < 1e-9 * (around**2).sum():  # a slit
        normal = np.linalg.svd(around)[2][2]
    return centre, normal / np.linalg.norm(normal)


def _fill(vertices: Array, loops: list[Ints], centre: Array, normal: Array) -> Ints:
    """Triangles (F, 3) between loops of vertex indices in one plane."""
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    basis = np.stack([u, np.cross(normal, u)], axis=1).astype(np.float64)
    flat = [np.asarray((vertices[loop] - centre) @ basis, dtype=np.float64) for loop in loops]
    polygons, order = [], []
    for i, (loop, polygon) in enumerate(zip(loops, flat, strict=True)):
        depth = sum(_within(polygon[0], other) for j, other in enumerate(flat) if j != i)
        turn = (_area(polygon) > 0) == bool(depth % 2)
        polygons.append(polygon[::-1] if turn else polygon)
        order.append(loop[::-1] if turn else loop)
    return np.concatenate(order)[np.asarray(triangulate(polygons), dtype=np.int64).reshape(-1, 3)]


def _area(polygon: Array) -> float:
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _within(point: Array, polygon: Array) -> bool:
    a, b = polygon, np.roll(polygon, -1, axis=0)
    crosses = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    a, b = a[crosses], b[crosses]
    return bool((a[:, 0] + (point[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]) > point[0]).sum() % 2)
