import numpy as np
import pytest
import trimesh

from cad.decompose import DecomposeConfig, DecompositionError, cut, decompose, excess_m, hull_of, winding_number
from cad.meshes import surface_samples
from cad.parts import load_part


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


def test_coacd_keeps_a_channel_open_and_is_the_same_every_time():
    mesh = channel()
    pieces = decompose(mesh)
    assert 3 <= len(pieces) <= 12
    assert all(p.is_watertight and p.is_convex for p in pieces)
    assert excess_m(mesh, pieces).max() < 1e-4
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


def test_the_excess_of_one_hull_over_a_channel_is_its_depth():
    mesh = channel()
    assert excess_m(mesh, [hull_of(mesh.vertices)], samples=4000).max() == pytest.approx(2e-3, rel=0.05)
    assert excess_m(mesh, [cut(mesh, [((0.0, 0.0, 1.0), 0.999e-3)])]).max() < 1e-8


def test_winding_number_tells_inside_from_outside():
    mesh = channel()
    points = np.array([[0, 0, 0.5e-3], [0, 0, 2e-3], [0, 2.5e-3, 3e-3], [0, 0, -1e-3]])
    np.testing.assert_allclose(winding_number(mesh, points), [1, 0, 1, 0], atol=1e-9)


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
    assert excess_m(part.mesh, solid, samples=100).max() < 35e-6
