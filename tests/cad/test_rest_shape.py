import numpy as np
import pytest
import trimesh

from cad.parts import load_part
from cad.rest_shape import rest_pieces
from cad.shape_error import hulls_apart


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_the_pieces_have_the_parts_hull_and_are_few_closed_and_convex(name):
    mesh = load_part(name).mesh
    pieces = rest_pieces(mesh)
    assert 4 <= len(pieces) <= 8
    assert hulls_apart(mesh, pieces) < 1e-9
    assert all(piece.is_watertight and piece.is_convex and piece.volume > 0 for piece in pieces)


def test_every_face_of_a_box_is_touched_at_its_four_corners():
    pieces = rest_pieces(trimesh.creation.box((8e-3, 6e-3, 3e-3)))
    for axis in range(3):
        for sign in (1, -1):
            tops = [(sign * piece.vertices[:, axis]).max() for piece in pieces]
            assert np.isclose(tops, max(tops)).sum() == 4


def test_a_mesh_may_lie_far_from_the_origin():
    mesh = trimesh.creation.cone(radius=2e-3, height=5e-3)
    mesh.apply_translation([0.1, 0.2, -0.3])
    assert hulls_apart(mesh, rest_pieces(mesh)) < 1e-9
