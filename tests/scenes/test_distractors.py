from collections import Counter
from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from cad.parts import load_part, part_names
from scenes.distractors import CRUMB, distractor_meshes, distractors
from scenes.layout import Shelf
from scenes.rests import RestPool


def test_distractors_stand_steadily_on_the_board():
    for thing in distractors().values():
        low = thing.mesh.bounds[0, 2]
        assert abs(low) < 1e-9
        assert thing.mesh.extents.max() < 0.025
        corners = np.concatenate([piece.vertices for piece in thing.pieces])
        sides = ConvexHull(corners[corners[:, 2] < 1e-6, :2]).equations
        volumes = np.array([piece.volume for piece in thing.pieces])
        centre = volumes @ [piece.center_mass for piece in thing.pieces] / volumes.sum()
        assert (sides[:, :2] @ centre[:2] + sides[:, 2] < -5e-6).all(), thing.name


def test_the_pieces_of_a_distractor_hold_what_is_drawn():
    for thing in distractors().values():
        drawn, pieces = thing.mesh.bounds, np.array([piece.bounds for piece in thing.pieces])
        held = np.array([pieces[:, 0].min(axis=0), pieces[:, 1].max(axis=0)])
        np.testing.assert_allclose(drawn, held, atol=6e-5, err_msg=thing.name)
        assert all(piece.is_convex for piece in thing.pieces), thing.name


def test_distractors_are_of_many_kinds_and_always_the_same():
    kinds = Counter(thing.kind for thing in distractors().values())
    assert len(kinds) >= 20
    assert {"screw", "nut", "washer", "chip", "wire", "coin", "paper", "ring", "channel", CRUMB} <= kinds.keys()
    assert list(distractor_meshes()) == list(distractors())


def test_a_distractor_that_could_be_a_part_is_left_out():
    parts = {name: load_part(name) for name in part_names()}
    block = distractors()["block_0"]
    part = replace(parts["main"], name="block", mesh=block.mesh)
    assert block.resembles(part)
    assert not any(thing.resembles(parts[name]) for thing in distractors().values() for name in parts)
    pool = RestPool.make([parts["main"]])
    pool.parts = (part,)
    assert "block_0" not in Shelf(pool, distractors()).distractors
