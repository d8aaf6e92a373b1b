import numpy as np
import pytest
import trimesh

from cad.repair import close_gaps, drop_copies, drop_walls, fill_holes, open_edges, split_t_junctions
from cad.shells import all_inside, shells_of
from cad.solids import bounds_solid, outer_union, to_mesh, to_solid
from cad.soup import Soup, orient, weld
from cad.wrap import march, wrap


def soup_of(*meshes):
    mesh = trimesh.util.concatenate(meshes)
    return Soup(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces, dtype=np.int64))


def box(size=(8, 6, 3), at=(0, 0, 0)):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return mesh


def strip(twist):
    """A closed band of 40 quadrilaterals, turned over ``twist`` times."""
    count, faces = 40, []
    angles = 2 * np.pi * np.arange(count) / count
    across = np.stack(
        [np.cos(twist * angles / 2) * np.cos(angles), np.cos(twist * angles / 2) * np.sin(angles)], axis=1
    )
    across = np.column_stack([across, np.sin(twist * angles / 2)])
    middle = 4 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    vertices = np.concatenate([middle - across, middle + across])
    for i in range(count):
        j, low, high = (i + 1) % count, 0, count
        if i == count - 1 and twist % 2:
            low, high = high, low
        faces += [[i, j + low, j + high], [i, j + high, i + count]]
    return Soup(vertices=vertices, faces=np.array(faces))


def test_a_soup_knows_its_edges_volume_and_pieces():
    soup = soup_of(box(), box(at=(20, 0, 0)))
    assert soup.is_closed and soup.volume == pytest.approx(288)
    assert len(soup.edges.ends) == 2 * 18 and (soup.edges.counts == 2).all()
    assert [piece.volume for piece in soup.components()] == pytest.approx([144, 144])
    assert soup.flipped().volume == pytest.approx(-288)
    assert not soup.take(np.arange(1, 24)).is_closed


def test_winding_is_made_consistent_and_a_moebius_strip_is_found_out():
    soup = soup_of(trimesh.creation.icosphere(2))
    turned = soup.flipped(np.random.default_rng(0).random(len(soup.faces)) < 0.4)
    oriented, patch, orientable = orient(turned)
    assert orientable and not patch.any()
    np.testing.assert_array_equal(oriented.faces, soup.faces)  # the fewest triangles are turned
    assert orient(strip(2))[2] and orient(strip(0))[2]
    assert not orient(strip(1))[2]


def test_equal_vertices_are_welded_and_triangles_that_vanish_dropped():
    soup = soup_of(box())
    loose = Soup(vertices=soup.triangles.reshape(-1, 3), faces=np.arange(36).reshape(-1, 3))
    loose = Soup(vertices=loose.vertices + 1e-12, faces=np.concatenate([loose.faces, [[0, 0, 1]]]))
    welded = weld(loose, 9)
    assert len(welded.vertices) == 8 and len(welded.faces) == 12 and welded.is_closed


def test_copies_are_dropped_but_never_opened():
    soup = soup_of(box())
    assert drop_copies(soup) == (soup, 0)
    for copies in (soup.faces, soup.faces[:, ::-1], soup.faces[:3], np.repeat(soup.faces[:2], 2, axis=0)):
        both = Soup(vertices=soup.vertices, faces=np.concatenate([soup.faces, copies]))
        clean, dropped = drop_copies(both)
        assert clean.is_closed and abs(clean.volume) == pytest.approx(144) and dropped == len(copies)


def test_a_wall_between_two_compartments_is_dropped():
    wall = box().face_normals[:, 0] > 0.5
    one = box()
    one.update_faces(~wall)
    soup = weld(soup_of(one, box(at=(8, 0, 0))), 9)
    assert (soup.edges.counts == 3).sum() == 4
    opened, walls = drop_walls(soup)
    assert walls == 1 and opened.is_closed and opened.volume == pytest.approx(288)


def test_gaps_close_up_to_their_width_only():
    soup = soup_of(box())
    shift = np.random.default_rng(1).uniform(-0.1, 0.1, (36, 3))
    loose = Soup(vertices=soup.triangles.reshape(-1, 3) + shift, faces=np.arange(36).reshape(-1, 3))
    assert close_gaps(loose, 0.01) is loose
    assert close_gaps(loose, 0.4).is_closed


def test_t_junctions_are_split_at_the_vertex():
    soup = soup_of(box())
    vertices, faces = trimesh.remesh.subdivide(soup.vertices, soup.faces, face_index=[0, 5, 7])
    junctions = Soup(vertices=np.array(vertices), faces=np.array(faces))
    assert len(open_edges(junctions))
    closed, split = split_t_junctions(junctions, 1e-6)
    assert closed.is_closed and closed.volume == pytest.approx(144) and split > 0
    assert split_t_junctions(soup, 1e-6) == (soup, 0)


def test_holes_are_filled_in_their_planes():
    ring = trimesh.creation.annulus(1.5, 3, 2)
    ring.update_faces(ring.face_normals[:, 2] < 0.5)
    filled, holes = fill_holes(soup_of(ring), 1e-6)
    assert filled.is_closed and len(holes) == 2
    assert abs(orient(filled)[0].volume) == pytest.approx(trimesh.creation.annulus(1.5, 3, 2).volume)
    assert max(hole.unevenness for hole in holes) < 1e-9
    assert sorted(hole.width for hole in holes) == pytest.approx([3 * np.sqrt(2), 6 * np.sqrt(2)], rel=0.01)
    corner = box()
    corner.update_faces(~((corner.vertices[corner.faces] == [4, 3, 1.5]).all(axis=2).any(axis=1)))
    bent, holes = fill_holes(soup_of(corner), 1e-6)
    assert bent.is_closed and holes[0].unevenness > 0.1


def test_boxes_that_touch_along_an_edge_are_told_apart():
    soup = weld(soup_of(box(), box(at=(8, 6, 0))), 9)
    assert len(soup.components()) == 1
    turned = soup.flipped(np.random.default_rng(0).random(24) < 0.3)
    for state in (soup, soup.flipped(), turned):
        shells = shells_of(state)
        assert shells is not None and [abs(shell.volume) for shell in shells] == pytest.approx([144, 144])
    assert shells_of(strip(0)) is None


def test_points_inside_a_shell_are_found():
    soup = soup_of(trimesh.creation.icosphere(3))
    points = np.random.default_rng(0).normal(size=(20, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert all_inside(soup, 0.98 * points)
    assert not any(all_inside(soup, point[None]) for point in 1.01 * points)


def test_the_union_has_no_cavities():
    hollow = soup_of(box((4, 4, 4)))
    shells = [hollow, soup_of(box((2, 2, 2))).flipped()]
    assert all(map(bounds_solid, shells))
    union, filled = outer_union([to_solid(shell) for shell in shells])
    assert union.volume() == pytest.approx(64) and filled == 0
    lid = [box((4, 4, 1), (0, 0, z)) for z in (-1.5, 1.5)] + [box((4, 1, 2), (0, y, 0)) for y in (-1.5, 1.5)]
    lid += [box((1, 2, 2), (x, 0, 0)) for x in (-1.5, 1.5)]
    union, filled = outer_union([to_solid(soup_of(mesh)) for mesh in lid])
    assert (union.volume(), filled) == pytest.approx((64, 8))
    assert to_mesh(union).is_watertight


def test_the_surface_of_a_field_is_closed_and_lies_on_its_level():
    grid = np.indices((24, 20, 22)).transpose(1, 2, 3, 0) - [11.3, 9.6, 10.2]
    surface = march(7 - np.linalg.norm(grid, axis=3), 0.0)
    assert surface.is_closed
    np.testing.assert_array_equal(orient(surface)[0].faces, surface.faces)
    assert surface.volume == pytest.approx(4 / 3 * np.pi * 7**3, rel=0.02)
    radius = np.linalg.norm(surface.vertices - [11.3, 9.6, 10.2], axis=1)
    np.testing.assert_allclose(radius, 7, atol=3 / (8 * 7))  # a cell's diagonal, taken for straight


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_a_wrap_closes_a_surface_whatever_its_winding(missing):
    rng = np.random.default_rng(4)
    mesh = trimesh.creation.box((8, 6, 3)).subdivide().subdivide().subdivide()
    soup = soup_of(mesh).take(rng.random(len(mesh.faces)) >= missing)
    soup = soup.flipped(rng.random(len(soup.faces)) < 0.5)
    wrapped = wrap(soup, 48)
    assert wrapped is not None and wrapped.is_closed
    assert wrapped.volume == pytest.approx(144, rel=0.02)
    np.testing.assert_allclose(np.ptp(wrapped.vertices, axis=0), (8, 6, 3), atol=8 / 48)
    assert wrap(soup_of(box()).take(box().face_normals[:, 2] > 0.5), 48) is None
