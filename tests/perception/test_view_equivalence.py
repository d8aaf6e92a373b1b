from dataclasses import replace

import numpy as np
import pytest
import trimesh
from made_parts import part_of

from cad.equivalence import Symmetries
from cad.parts import Part, planar
from cad.spatial import apply, rotation_x, rotation_y, rotation_z, wrap_angle
from cad.symmetry import find_symmetries
from perception.view_equivalence import find_view_equivalents, top_view, view_difference_mm2


def prism(sides: int, across: float = 4e-3, height: float = 1.6e-3) -> trimesh.Trimesh:
    """A regular prism along z; ``across`` is the diameter of its inscribed circle."""
    solid = trimesh.creation.cylinder(radius=across / 2 / np.cos(np.pi / sides), height=height, sections=sides)
    assert isinstance(solid, trimesh.Trimesh)
    return solid


def brick(symmetries: Symmetries | None = None) -> Part:
    flat = rotation_z(0.7)  # canonical yaws are arbitrary, so give each pose another
    on_side, upside_down = rotation_z(-0.4) @ rotation_x(np.pi / 2), rotation_x(np.pi)
    return part_of(trimesh.creation.box([8e-3, 5e-3, 2e-3]), [flat, on_side, upside_down], symmetries)


def ell() -> Part:
    long, short = trimesh.creation.box([8e-3, 3e-3, 2e-3]), trimesh.creation.box([2e-3, 6e-3, 2e-3])
    short.apply_translation([-3e-3, 3e-3, 0.0])
    return part_of(trimesh.util.concatenate([long, short]), [np.eye(3), rotation_x(np.pi)])


def yaws_deg(found, stable_pose: int) -> list[float]:
    return sorted(round(float(np.degrees(e.yaw)) % 360.0, 6) for e in found if e.stable_pose == stable_pose)


def test_a_brick_looks_the_same_turned_round_and_upside_down() -> None:
    equivalents = find_view_equivalents(brick())
    expected = [(0, np.pi), (2, 0.7), (2, 0.7 + np.pi)]
    assert len(equivalents[0]) == len(expected)
    for pose, yaw in expected:
        assert any(e.stable_pose == pose and abs(wrap_angle(e.yaw - yaw)) < np.radians(1.0) for e in equivalents[0])
    assert {e.stable_pose for e in equivalents[1]} == {1}


def test_where_the_part_is_symmetric_yaw_and_shift_are_exact() -> None:
    part = brick()
    part = replace(part, symmetries=find_symmetries(part.mesh))
    for pose, found in zip(part.stable_poses, find_view_equivalents(part), strict=True):
        for e in found:
            there = planar(*e.shift_m, e.yaw) @ part.stable_poses[e.stable_pose].T_table_part
            corners = apply(there, part.mesh.vertices)
            for corner in apply(pose.T_table_part, part.mesh.vertices):
                assert np.linalg.norm(corners - corner, axis=1).min() < 1e-9


def test_an_ell_is_told_apart_from_its_mirror_image() -> None:
    assert find_view_equivalents(ell()) == ((), ())


def test_a_shift_lays_the_equivalent_over_the_original() -> None:
    part = ell()
    moved = part.mesh.copy()
    turned = replace(part, mesh=moved, stable_poses=(part.stable_poses[0], part.stable_poses[0]))
    other = replace(part.stable_poses[0], index=1, R_table_part=rotation_z(2.0))
    v = moved.vertices @ other.R_table_part.T
    t = -(v.min(axis=0) + v.max(axis=0)) / 2
    other = replace(other, t_table_part=np.array([t[0], t[1], -v[:, 2].min()]))
    found = find_view_equivalents(replace(turned, stable_poses=(part.stable_poses[0], other)))
    (e,) = found[0]
    assert e.stable_pose == 1 and e.yaw == pytest.approx(-2.0, abs=np.radians(0.6))
    there = planar(*e.shift_m, e.yaw) @ other.T_table_part
    np.testing.assert_allclose(there[:2, 3], part.stable_poses[0].T_table_part[:2, 3], atol=1e-4)


def test_equivalence_goes_both_ways() -> None:
    equivalents = find_view_equivalents(brick())
    for i, found in enumerate(equivalents):
        for e in found:
            back = [x for x in equivalents[e.stable_pose] if x.stable_pose == i]
            assert any(abs(wrap_angle(e.yaw + x.yaw)) < 0.03 for x in back)


def test_a_nut_looks_the_same_every_sixty_degrees_and_twice_on_its_side() -> None:
    nut = prism(6)
    lying = part_of(nut, [np.eye(3), rotation_y(np.pi / 2)], find_symmetries(nut))
    flat, side = find_view_equivalents(lying)
    assert yaws_deg(flat, 0) == [60, 120, 180, 240, 300]
    assert {e.stable_pose for e in flat} == {0}
    assert yaws_deg(side, 1) == [180]


def test_a_disc_looks_the_same_at_every_yaw() -> None:
    (found,) = find_view_equivalents(part_of(prism(72), [np.eye(3)]))
    assert yaws_deg(found, 0) == list(range(10, 360, 10))


def test_a_mark_on_a_nut_breaks_the_view_equivalence_only_when_it_can_be_seen() -> None:
    def marked(size: float) -> int:
        mark = trimesh.creation.box([size, size, 1e-3])
        mark.apply_translation([1.2e-3, 0.0, 0.8e-3])
        (found,) = find_view_equivalents(part_of(trimesh.util.concatenate([prism(6), mark]), [np.eye(3)]))
        return len(found)

    assert marked(0.2e-3) == 5
    assert marked(1.0e-3) == 0


def test_a_view_turned_by_its_own_yaw_is_the_view_of_the_turned_part() -> None:
    part = ell()
    turned = part_of(part.mesh, [rotation_z(0.9)])
    a, b = top_view(part, part.stable_poses[0], 120), top_view(turned, turned.stable_poses[0], 120)
    assert view_difference_mm2(b, a, 0.9)[0] < 0.1
    assert view_difference_mm2(b, a, -0.9)[0] > 3.0
    assert view_difference_mm2(b, a, 0.9)[1] < min(view_difference_mm2(b, a, 0.9 + d)[1] for d in (-0.05, 0.05))
