import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import trimesh

from cad.collision import (
    CollisionConfig,
    contact_pieces,
    cut_shapes,
    find_collision_shapes,
    fitted,
    measure,
    read_collision,
    write_collision,
)
from cad.meshes import check_mesh, write_mesh
from cad.parts import load_part
from cad.shape_error import beyond, hulls_apart, solid_of, union_of_hulls

BUILT_IN = ("inserted", "main", "top")
COARSE = CollisionConfig(thresholds=(0.2,), max_excess_m=1e-6)


def block(*size_mm, at=(0, 0, 0)):
    return trimesh.creation.box(np.array(size_mm) * 1e-3).apply_translation(np.array(at) * 1e-3)


def union(*meshes):
    in_mm = [mesh.copy().apply_scale(1e3) for mesh in meshes]
    return trimesh.boolean.union(in_mm).apply_scale(1e-3)


def channel():
    """U-shaped channel of 8 x 6 x 4 mm with walls of 1 mm."""
    return union(block(8, 6, 1, at=(0, 0, 0.5)), block(8, 1, 4, at=(0, 2.5, 2)), block(8, 1, 4, at=(0, -2.5, 2)))


def ring(sections=32):
    outer, inner = (trimesh.creation.cylinder(r, h, sections=sections) for r, h in ((3.0, 1.5), (1.5, 4.0)))
    return trimesh.boolean.difference([outer, inner]).apply_scale(1e-3)


def test_what_a_solid_has_beyond_another_is_volume_and_distance():
    large, small = solid_of(block(4, 4, 4)), solid_of(block(4, 4, 3))
    found = beyond(large, small)
    assert found.max_m == pytest.approx(0.5e-3, rel=1e-9)
    assert found.volume_m3 == pytest.approx(16e-9, rel=1e-9)
    assert found.p99_m == pytest.approx(0.5e-3, rel=1e-2)
    assert beyond(small, large).max_m == beyond(small, large).volume_m3 == 0.0


def test_a_small_excess_counts_in_the_maximum_only():
    part = block(8, 8, 8)
    bump = union(part, block(0.2, 0.2, 0.2, at=(0, 0, 4)))
    found = beyond(solid_of(bump), solid_of(part))
    assert found.max_m == pytest.approx(0.1e-3, rel=1e-6)
    assert found.p99_m == 0.0
    assert found.volume_m3 == pytest.approx(4e-12, rel=1e-6)


def test_hulls_are_apart_by_what_a_part_at_rest_would_be_too_high_or_low():
    part = block(4, 4, 2)
    assert hulls_apart(part, [block(4, 4, 2.2)]) == pytest.approx(0.1e-3, rel=1e-6)
    assert hulls_apart(part, [block(4, 4, 1.8)]) == pytest.approx(0.1e-3, rel=1e-6)
    assert hulls_apart(channel(), [block(8, 6, 4, at=(0, 0, 2))]) < 1e-9


@pytest.mark.parametrize(
    "mesh",
    [block(4, 3, 2), trimesh.creation.cylinder(2e-3, 3e-3), trimesh.creation.icosphere(3, 2e-3)],
    ids=["box", "cylinder", "ball"],
)
def test_a_convex_part_is_its_own_hull(mesh):
    shapes = find_collision_shapes(mesh)
    report = shapes.report
    assert (report.method, report.pieces, report.limit, report.threshold) == ("hull", 1, None, None)
    assert max(report.excess_max_um, report.missing_max_um, report.hull_um) < 0.01
    assert shapes.pieces[0].volume == pytest.approx(mesh.volume, rel=1e-6)


@pytest.mark.parametrize("make", [channel, pytest.param(ring, marks=pytest.mark.slow)])
def test_other_parts_are_decomposed_and_lie_as_their_hull_does(make):
    mesh = make()
    shapes = find_collision_shapes(mesh, CollisionConfig(thresholds=(0.1, 0.05), max_excess_m=0.15e-3))
    report = shapes.report
    assert report.method == "coacd"
    assert 3 <= report.pieces == len(shapes.pieces) <= 20
    assert report.excess_max_um < 250
    assert report.excess_p99_um <= report.excess_max_um
    assert report.hull_um < 1.1
    assert report.missing_max_um < 10
    for piece in shapes.pieces:
        check_mesh(piece)
    whole = union_of_hulls(shapes.pieces)
    assert whole.volume() == pytest.approx(mesh.volume + 1e-9 * (report.excess_mm3 - report.missing_mm3), rel=1e-4)


def test_the_loop_says_which_limit_it_hit():
    mesh = channel()
    assert find_collision_shapes(mesh, CollisionConfig(thresholds=(0.1,))).report.limit == "target"
    ring_mesh = ring()
    assert find_collision_shapes(ring_mesh, COARSE).report.limit == "threshold"
    few = replace(COARSE, thresholds=(0.05, 0.02), max_pieces=3)
    assert find_collision_shapes(ring_mesh, few).report.limit == "pieces"
    hasty = replace(COARSE, thresholds=(0.2, 0.1), max_cpu_seconds=1e-3)
    assert find_collision_shapes(ring_mesh, hasty).report.limit == "time"


def test_a_fine_mesh_is_simplified_within_its_stated_error():
    shapes = find_collision_shapes(ring(120), replace(COARSE, triangles=100))
    assert 0 < shapes.report.simplified_um < 15
    assert shapes.report.hull_um < 1.1


def test_pieces_are_cut_to_the_hull_and_grown_to_its_corners():
    part = block(4, 3, 2)
    proud, short = block(2.2, 3, 2.2, at=(-1.1, 0, 0)), block(1.9, 2.8, 2, at=(0.95, 0, 0))
    pieces = fitted([proud, short], part)
    assert hulls_apart(part, pieces) < 1e-9
    assert measure(part, pieces, method="coacd").excess_max_um < 1e-3


def test_shapes_are_stored_read_and_made_anew_for_another_mesh(tmp_path):
    mesh = channel()
    write_mesh(mesh, tmp_path / "mesh.ply")
    assert read_collision(tmp_path) is None
    shapes = find_collision_shapes(mesh, COARSE)
    write_collision(tmp_path, shapes)
    stored = find_collision_shapes(mesh, COARSE, cache=tmp_path)
    assert replace(stored.report, mesh_hash="") == shapes.report
    for ours, theirs in zip(shapes.pieces, stored.pieces, strict=True):
        np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-9)
    write_mesh(block(4, 3, 2), tmp_path / "mesh.ply")
    assert read_collision(tmp_path) is None
    assert find_collision_shapes(block(4, 3, 2), cache=tmp_path).report.method == "hull"
    write_collision(tmp_path, find_collision_shapes(block(4, 3, 2)))
    assert [p.name for p in (tmp_path / "hulls").iterdir()] == ["000.ply"]


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_parts_state_the_error_of_their_pieces(name):
    part = load_part(name)
    stored = read_collision(part.folder)
    assert stored is not None
    assert stored.report.method == "cut"
    assert stored.report.hull_um < 0.6
    again = asdict(replace(cut_shapes(part.mesh, part.hulls).report, mesh_hash=part.mesh_hash))
    written = json.loads((part.folder / "collision.json").read_text())
    assert {k: v for k, v in written.items() if not isinstance(v, float)} == {
        k: v for k, v in again.items() if not isinstance(v, float)
    }
    for key, value in written.items():
        if isinstance(value, float):
            assert again[key] == pytest.approx(value, rel=0.05, abs=0.6), key


@pytest.mark.parametrize("purpose", ["rest", "grasp"])
def test_contact_pieces_rest_as_the_part_does(purpose):
    part = load_part("top")
    assert hulls_apart(part.mesh, contact_pieces(part, purpose)) < 1e-6


def test_wrong_settings_and_purposes_are_refused():
    with pytest.raises(ValueError, match="purpose 'look'"):
        contact_pieces(load_part("top"), "look")
    with pytest.raises(ValueError, match="thresholds"):
        CollisionConfig(thresholds=(0.02, 0.1))
    with pytest.raises(ValueError, match="max_excess_m -1"):
        CollisionConfig(max_excess_m=-1)
    with pytest.raises(ValueError, match="max_pieces 0"):
        CollisionConfig(max_pieces=0)
