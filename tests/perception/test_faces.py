from dataclasses import replace

import numpy as np
import pytest
import trimesh
from made_parts import part_of

from cad.parts import Part
from cad.spatial import rotation_x, rotation_y, rotation_z
from perception.estimates import PerceptionError
from perception.faces import FaceTable
from perception.view_equivalence import find_view_equivalents


def viewed(part: Part) -> Part:
    """The part with what looks alike stored in its stable poses."""
    pairs = zip(part.stable_poses, find_view_equivalents(part), strict=True)
    return replace(part, stable_poses=tuple(replace(pose, view_equivalents=found) for pose, found in pairs))


def brick() -> Part:
    flat = rotation_z(0.7)  # canonical yaws are arbitrary, so give each pose another
    on_side, upside_down = rotation_z(-0.4) @ rotation_x(np.pi / 2), rotation_x(np.pi)
    return viewed(part_of(trimesh.creation.box([8e-3, 5e-3, 2e-3]), [flat, on_side, upside_down]))


def ell() -> Part:
    long, short = trimesh.creation.box([8e-3, 3e-3, 2e-3]), trimesh.creation.box([2e-3, 6e-3, 2e-3])
    short.apply_translation([-3e-3, 3e-3, 0.0])
    ell = trimesh.util.concatenate([long, short])
    return viewed(part_of(ell, [np.eye(3), rotation_x(np.pi)], name="ell", obj_id=2))


def test_equivalence_goes_both_ways() -> None:
    table = FaceTable([brick()])
    for face, found in enumerate(table.equivalents):
        for e in found:
            assert table.same_view(e.face, e.yaw, face, 0.0, 0.03)


def test_a_face_looks_like_itself_first_and_then_like_what_the_part_says() -> None:
    table = FaceTable([ell(), brick()])
    for face, found in enumerate(table.equivalents):
        part, pose = table[face].part, table[face].stable_pose
        assert (found[0].face, found[0].yaw, found[0].shift_m) == (face, 0.0, (0.0, 0.0))
        offset = table.index_of(part.name, 0)
        stored = [(offset + e.stable_pose, e.yaw, e.shift_m) for e in pose.view_equivalents or ()]
        assert [(e.face, e.yaw, e.shift_m) for e in found[1:]] == stored
    assert len(table.equivalents[2]) == 4


def test_a_part_that_does_not_say_what_looks_alike_is_an_error_with_the_command() -> None:
    unseen = part_of(trimesh.creation.box([8e-3, 5e-3, 2e-3]), [np.eye(3)])
    with pytest.raises(PerceptionError, match="tagcell part stable-poses block --write"):
        _ = FaceTable([unseen]).equivalents


def test_faces_of_the_second_part_come_after_those_of_the_first() -> None:
    table = FaceTable([brick(), ell()])
    assert len(table) == 5 and table.index_of("ell", 1) == 4
    assert table.part_of_face.tolist() == [0, 0, 0, 1, 1]
    assert {e.face for e in table.equivalents[3]} == {3}
    assert table[1].middle_m == pytest.approx(2.5e-3)
    with pytest.raises(PerceptionError, match=r"faces there are: block 0\.\.2, ell 0\.\.1"):
        table.index_of("ell", 2)


def test_other_stable_poses_than_trained_for_are_refused() -> None:
    table = FaceTable([brick()])
    table.check(table.describe(), "weights")
    tipped = part_of(brick().mesh, [rotation_z(0.7), rotation_y(np.pi / 2), rotation_x(np.pi)])
    with pytest.raises(PerceptionError, match="train again"):
        FaceTable([tipped]).check(table.describe(), "weights")
    with pytest.raises(PerceptionError, match="no stable poses"):
        FaceTable([part_of(brick().mesh, [])])
