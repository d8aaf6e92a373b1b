import numpy as np
import pytest
import trimesh

from cad.decompose import DecomposeConfig, DecompositionError, cut, decompose, hull_of
from cad.meshes import surface_samples
from cad.parts import load_part
from cad.shape_error import beyond, solid_of, union_of_hulls


def channel():
    """U-shaped channel of 8 x 6 x 4 mm with walls of 1 mm, from boxes."""
    boxes = [((0, 0, 0.5), (8, 6, 1)), ((0, 2.5, 2), (8, 1, 4)), ((0, -2.5, 2), (8, 1, 4))]
    solids = [trimesh.creation.box(np.array(e) * 1e-3).apply_translation(np.array(c) * 1e-3) for c, e in boxes]
    return trimesh.boolean.union(solids)


def depth_inside(points, pieces):
    """How deep each point is in the piece that holds it best; negative outside all."""
    best = np.full(len(points), -np.inf)
    for piece in pieces:
        distance = (piece.face_normals * piece.triangles[:, 0]).sum(axis=1) - points @ piece.face_normals.T
        best = np.maximum(best, distance.min(axis=1))
    return best


def excess_m(mesh, pieces):
    return beyond(union_of_hulls(pieces), solid_of(mesh)).max_m


def test_coacd_keeps_a_channel_open_and_is_the_same_every_time():
    mesh = channel()
    pieces = decompose(mesh)
    assert 3 <= len(pieces) <= 12
    assert all(p.is_watertight and p.is_convex for p in pieces)
    assert excess_m(mesh, pieces) < 1e-4
    again = decompose(mesh)
    np.testing.assert_array_equal(pieces[0].vertices, again[0].vertices)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"threshold 2"):
        DecomposeConfig(threshold=2.0)
    with pytest.raises(ValueError, match=r"max_pieces 0"):
        DecomposeConfig(max_pieces=0)


def test_a_cut_is_exact_where_the_part_is_convex():
    mesh = channel()
    floor = cut(mesh, [((0.0, 0.0, 1.0), 0.999e-3)])
    assert floor.volume == pytest.approx(8e-3 * 6e-3 * 0.999e-3, rel=1e-6)
    corner = cut(trimesh.creation.box((2e-3, 2e-3, 2e-3)), [((1.0, 1.0, 0.0), 0.0)])
    assert corner.volume == pytest.approx(4e-9, rel=1e-6)


def test_cuts_and_hulls_without_volume_are_refused():
    with pytest.raises(DecompositionError, match="nothing of the mesh"):
        cut(channel(), [((0.0, 0.0, 1.0), -1.0)])
    with pytest.raises(DecompositionError, match="no volume"):
        hull_of(np.zeros((5, 3)))


@pytest.mark.parametrize(("name", "most"), [("inserted", 12), ("main", 30), ("top", 14)])
def test_stored_pieces_cover_the_part_and_hardly_stand_proud(name, most):
    part = load_part(name)
    assert len(part.hulls) <= most
    assert all(hull.is_watertight and hull.is_convex for hull in part.hulls)
    points, normals = surface_samples(part.mesh, 1000, np.random.default_rng(0))
    assert depth_inside(points - 1e-8 * normals, part.hulls).min() > -1e-6
    np.testing.assert_allclose(np.min([h.bounds[0] for h in part.hulls], axis=0), part.mesh.bounds[0], atol=1e-6)
    np.testing.assert_allclose(np.max([h.bounds[1] for h in part.hulls], axis=0), part.mesh.bounds[1], atol=1e-6)
    # Rows of contacts of `inserted` are one piece each: the gaps between the tails are not looked at.
    solid = [h for h in part.hulls if name != "inserted" or h.bounds[1, 0] > -7.6e-3]
    assert excess_m(part.mesh, solid) < 35e-6
