from pathlib import Path

import numpy as np
import pytest
import trimesh

from cad.equivalence import Symmetries
from cad.parts import Part, StablePose
from cad.spatial import rotation_x, rotation_y, rotation_z, wrap_angle
from perception.estimates import PerceptionError
from perception.faces import FaceTable, top_view, view_difference_mm2


def part_of(mesh: trimesh.Trimesh, rotations, name: str = "block", obj_id: int = 1) -> Part:
    poses = []
    for i, R in enumerate(rotations):
        v = mesh.vertices @ np.asarray(R).T
        t = -(v.min(axis=0) + v.max(axis=0)) / 2
        t[2] = -v[:, 2].min()
        poses.append(StablePose(index=i, R_table_part=R, t_table_part=t, probability=1 / len(rotations), view_class=i))
    return Part(
        name=name,
        obj_id=obj_id,
        folder=Path(),
        mass_kg=1e-4,
        material="steel",
        rgba=(1.0, 1.0, 1.0, 1.0),
        metallic=0.0,
        roughness=1.0,
        mesh=mesh,
        symmetries=Symmetries(),
        stable_poses=tuple(poses),
        keypoints=np.asarray(mesh.vertices[:8]),
        mesh_hash="",
    )


def brick() -> Part:
    flat = rotation_z(0.7)  # canonical yaws are arbitrary, so give each pose another
    on_side, upside_down = rotation_z(-0.4) @ rotation_x(np.pi / 2), rotation_x(np.pi)
    return part_of(trimesh.creation.box([8e-3, 5e-3, 2e-3]), [flat, on_side, upside_down])


def ell() -> Part:
    long, short = trimesh.creation.box([8e-3, 3e-3, 2e-3]), trimesh.creation.box([2e-3, 6e-3, 2e-3])
    short.apply_translation([-3e-3, 3e-3, 0.0])
    return part_of(trimesh.util.concatenate([long, short]), [np.eye(3), rotation_x(np.pi)], "ell", 2)


def test_a_brick_looks_the_same_turned_round_and_upside_down() -> None:
    equivalents = FaceTable([brick()]).equivalents
    expected = [(0, 0.0), (0, np.pi), (2, 0.7), (2, 0.7 + np.pi)]
    assert len(equivalents[0]) == len(expected)
    for face, yaw in expected:
        assert any(e.face == face and abs(wrap_angle(e.yaw - yaw)) < np.radians(1.0) for e in equivalents[0])
    assert {e.face for e in equivalents[1]} == {1}


def test_an_ell_is_told_apart_from_its_mirror_image() -> None:
    equivalents = FaceTable([ell()]).equivalents
    assert [[(e.face, e.yaw) for e in found] for found in equivalents] == [[(0, 0.0)], [(1, 0.0)]]


def test_equivalence_goes_both_ways() -> None:
    table = FaceTable([brick()])
    for face, found in enumerate(table.equivalents):
        for e in found:
            assert table.same_view(e.face, e.yaw, face, 0.0, 0.03)


def test_faces_of_the_second_part_come_after_those_of_the_first() -> None:
    table = FaceTable([brick(), ell()])
    assert len(table) == 5 and table.index_of("ell", 1) == 4
    assert table.part_of_face.tolist() == [0, 0, 0, 1, 1]
    assert {e.face for e in table.equivalents[3]} == {3}
    assert table[1].middle_m == pytest.approx(2.5e-3)
    with pytest.raises(PerceptionError, match=r"faces there are: block 0\.\.2, ell 0\.\.1"):
        table.index_of("ell", 2)


def test_a_view_turned_by_its_own_yaw_is_the_view_of_the_turned_part() -> None:
    part = ell()
    turned = part_of(part.mesh, [rotation_z(0.9)])
    a, b = top_view(part, part.stable_poses[0], 120), top_view(turned, turned.stable_poses[0], 120)
    assert view_difference_mm2(b, a, 0.9) < 0.1
    assert view_difference_mm2(b, a, -0.9) > 3.0


def test_other_stable_poses_than_trained_for_are_refused() -> None:
    table = FaceTable([brick()])
    table.check(table.describe(), "weights")
    tipped = part_of(brick().mesh, [rotation_z(0.7), rotation_y(np.pi / 2), rotation_x(np.pi)])
    with pytest.raises(PerceptionError, match="train again"):
        FaceTable([tipped]).check(table.describe(), "weights")
    with pytest.raises(PerceptionError, match="no stable poses"):
        FaceTable([part_of(brick().mesh, [])])
