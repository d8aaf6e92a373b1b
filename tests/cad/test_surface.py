"""Surfaces as they should not be: the repaired part equals the clean one."""

import numpy as np
import pytest
import trimesh
from part_files import box, clean, mirrored, refusal, same, written

from cad.intake import IntakeConfig, read_part
from cad.meshes import check_mesh
from cad.nearest import Surface
from cad.surface import RepairConfig


def test_a_clean_mesh_is_left_as_it_is(tmp_path):
    vertices, faces = clean()
    intake = read_part(written(tmp_path / "part.ply", (vertices, faces)))
    same(intake, vertices, faces)
    assert intake.notes == () and intake.solids == 1
    assert len(intake.mesh.faces) == len(faces)


def faults():
    """Name, the bracket with a fault, and a word of the note that tells of it."""
    rng = np.random.default_rng(2)
    vertices, faces = clean()
    areas = trimesh.Trimesh(vertices, faces, process=False).area_faces
    large = np.argsort(-areas)
    some = np.sort(rng.choice(len(faces), 300, replace=False))
    turned = faces.copy()
    turned[some] = turned[some, ::-1]
    soup = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    point = np.stack([faces[:40, 0], faces[:40, 0], faces[:40, 1]], axis=1)
    return {
        "separate triangles": (*soup, ""),
        "inverted": (vertices, faces[:, ::-1], "inward normals"),
        "mixed winding": (vertices, turned, "wound against"),
        "everything twice": (vertices, np.concatenate([faces, faces]), "more than once"),
        "some twice, inverted": (vertices, np.concatenate([faces, faces[:50, ::-1]]), "more than once"),
        "degenerate triangles": (vertices, np.concatenate([faces, point]), "two corners at one place"),
        "unused vertices": (np.concatenate([vertices, [[90, 0, 0], [0, 70, 0]]]), faces, ""),
        "T-junctions": (*trimesh.remesh.subdivide(vertices, faces, face_index=large[:30]), "T-junction"),
        "holes": (vertices, np.delete(faces, large[:9], axis=0), "filled"),
        "one hole, all inverted": (vertices, np.delete(faces, large[:1], axis=0)[:, ::-1], "filled"),
    }


@pytest.mark.parametrize("fault", list(faults()))
def test_a_broken_mesh_comes_out_as_the_clean_one(tmp_path, fault):
    vertices, faces, word = faults()[fault]
    intake = read_part(written(tmp_path / "part.ply", (vertices, faces)))
    same(intake, *clean())
    assert any(word in note for note in intake.notes) or (not word and not intake.notes)


def test_small_gaps_are_closed_within_their_width(tmp_path):
    vertices, faces = clean()
    rng = np.random.default_rng(5)
    corners = vertices[faces].reshape(-1, 3)
    corners = corners + rng.uniform(-1e-3, 1e-3, corners.shape)  # a micrometre
    intake = read_part(written(tmp_path / "part.ply", (corners, np.arange(len(corners)).reshape(-1, 3))))
    same(intake, *clean(), ppm=500, um=2)
    assert any("gaps" in note for note in intake.notes)


def test_a_missing_face_with_an_island_is_filled_as_a_ring(tmp_path):
    ring = trimesh.creation.annulus(1.5, 3, 2)
    sides = np.abs(ring.face_normals[:, 2]) < 0.5
    intake = read_part(written(tmp_path / "part.ply", (np.array(ring.vertices), np.array(ring.faces)[sides])))
    same(intake, np.array(ring.vertices), np.array(ring.faces))
    assert any("4 holes filled" in note and "all flat" in note for note in intake.notes)


def two_boxes():
    """Two boxes that share a face, in every state of neglect; together they are a box of 16 x 6 x 3 mm."""
    one, other = box(), box(at=(8, 0, 0))
    turned = one[1].copy()
    turned[::3] = turned[::3, ::-1]
    wall = trimesh.creation.box((8, 6, 3)).face_normals[:, 0] < -0.5
    return {
        "sound": (one, other),
        "one inverted": (one, (other[0], other[1][:, ::-1])),
        "mixed winding": ((one[0], turned), (other[0], turned)),
        "one common wall": (one, (other[0], other[1][~wall])),
        "the same wall twice": (one, mirrored(other)),
        "the same wall twice, mixed winding": ((one[0], turned), mirrored(other)),
    }


@pytest.mark.parametrize("state", list(two_boxes()))
def test_boxes_that_share_a_face_become_one_box(tmp_path, state):
    intake = read_part(written(tmp_path / "part.ply", *two_boxes()[state]))
    same(intake, *box((16, 6, 3), at=(4, 0, 0)))


def test_overlapping_boxes_are_united(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(), box(at=(1, 2, 1))))
    assert intake.mesh.volume * 1e9 == pytest.approx(2 * 144 - 7 * 4 * 2, rel=1e-6)
    assert any("2 solids united; they overlap by 56 mm3" in note for note in intake.notes)


@pytest.mark.parametrize("inward", [True, False])
@pytest.mark.parametrize("all_inverted", [True, False])
def test_what_lies_inside_is_left_out(tmp_path, inward, all_inverted):
    outer, (vertices, faces) = box(), box((4, 3, 1.5))
    pieces = [outer, (vertices, faces[:, ::-1] if inward else faces)]
    pieces = [(v, f[:, ::-1]) for v, f in pieces] if all_inverted else pieces
    intake = read_part(written(tmp_path / "part.ply", *pieces))
    same(intake, *outer)
    assert intake.solids == 2
    assert any("18 mm3" in note and "solid there" in note for note in intake.notes)


def test_a_cavity_between_solids_is_filled(tmp_path):
    walls = [box((8, 6, 1)), box((8, 6, 1), at=(0, 0, 3))]
    walls += [box((8, 1, 2), at=(0, y, 1.5)) for y in (-2.5, 2.5)] + [
        box((1, 4, 2), at=(x, 0, 1.5)) for x in (-3.5, 3.5)
    ]
    intake = read_part(written(tmp_path / "part.ply", *walls))
    same(intake, *box((8, 6, 4), at=(0, 0, 1.5)))
    assert any("48 mm3" in note and "filled" in note for note in intake.notes)


def test_separate_bodies_stay_and_are_told_of(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(), box(at=(20, 0, 0))))
    assert intake.mesh.volume * 1e9 == pytest.approx(288, rel=1e-6)
    assert intake.mesh.body_count == 2
    assert any("2 bodies" in note for note in intake.notes)


def test_a_surface_without_thickness_is_refused(tmp_path):
    vertices, faces = box()
    top = trimesh.creation.box((8, 6, 3)).face_normals[:, 2] > 0.5
    path = written(tmp_path / "part.ply", (vertices, faces[top]))
    assert "no volume" in refusal(path)


def test_a_part_far_from_the_origin_gets_one_of_its_own(tmp_path):
    intake = read_part(written(tmp_path / "part.ply", box(at=(500, 0, 0))))
    same(intake, *box(), um=0.1, ppm=100)  # single precision at half a metre
    np.testing.assert_allclose(intake.origin_m, (0.5, 0, 0), atol=1e-7)
    assert any("500 mm" in note for note in intake.notes)


def test_a_surface_that_cannot_be_closed_is_wrapped_and_the_error_told(tmp_path):
    rng = np.random.default_rng(3)
    ring = trimesh.creation.annulus(1.5, 3, 2).subdivide().subdivide()
    faces = np.array(ring.faces)[rng.random(len(ring.faces)) > 0.1]  # a tenth is missing,
    turn = rng.random(len(faces)) < 0.5
    faces[turn] = faces[turn, ::-1]  # half is inverted
    third = len(faces) // 3
    torn = np.array(ring.vertices)[faces[:third]].reshape(-1, 3)
    torn += rng.uniform(-0.02, 0.02, torn.shape)  # and a third does not meet its neighbours
    pieces = (torn, np.arange(3 * third).reshape(-1, 3)), (np.array(ring.vertices), faces[third:])
    cells = RepairConfig(wrap_cells=64)
    intake = read_part(written(tmp_path / "part.ply", *pieces), config=IntakeConfig(repair=cells))
    check_mesh(intake.mesh)
    assert any("wrapped" in note and "um of the wrap" in note for note in intake.notes)
    assert intake.mesh.volume * 1e9 == pytest.approx(ring.volume, rel=0.03)
    np.testing.assert_allclose(intake.mesh.bounds, 1e-3 * ring.bounds, atol=50e-6)
    sound = trimesh.Trimesh(1e-3 * ring.vertices, ring.faces, process=False)
    assert np.percentile(Surface(sound).distance(np.asarray(intake.mesh.vertices[::20])), 95) < 50e-6


def test_a_part_of_many_triangles_is_simplified_within_its_tolerance(tmp_path):
    ball = trimesh.creation.icosphere(6, 4.0)
    ball.vertices *= [1.0, 0.7, 0.5]
    intake = read_part(written(tmp_path / "part.ply", (np.array(ball.vertices), np.array(ball.faces))))
    assert len(ball.faces) > 60_000 > 40_000 > len(intake.mesh.faces)
    assert any("simplified" in note and "2 um" in note for note in intake.notes)
    scaled = 1e-3 * np.asarray(ball.vertices)
    assert Surface(intake.mesh).largest(scaled) <= 2e-6
