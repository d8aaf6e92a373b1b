from dataclasses import replace

import numpy as np
import pytest

from cad.equivalence import Symmetries
from cad.parts import Part, ViewEquivalent, planar
from cad.spatial import apply, rotation_x, rotation_z, transform
from perception.alternatives import likely_readings, pose_alternatives, reading_probabilities, readings, same_reading
from perception.faces import FaceTable
from tests.perception.conftest import box, make_part

T_CAM_TABLE = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])
TURN = 2 * np.pi / 6


def hexagon() -> Part:
    """A nut without a hole: six yaws look the same, and all are symmetries of the part."""
    part = make_part(box((8, 8, 3)), name="nut")
    middle = part.mesh.bounds.mean(axis=0)
    turns = [rotation_z(k * TURN) for k in range(1, 6)]
    symmetries = Symmetries(discrete=np.array([transform(R, middle - R @ middle) for R in turns]))
    alike = tuple(ViewEquivalent(stable_pose=0, yaw=k * TURN, shift_m=(0.0, 0.0)) for k in range(1, 6))
    return replace(part, symmetries=symmetries, stable_poses=(replace(part.stable_poses[0], view_equivalents=alike),))


def header() -> Part:
    """A bar that looks the same upside down but is not: its other side, turned round and 0.4 mm off."""
    part = make_part(box((8, 3, 2)), (np.eye(3), np.diag([1.0, -1.0, -1.0])), name="header")
    first, second = part.stable_poses
    there, back = (
        ViewEquivalent(stable_pose=1, yaw=np.pi, shift_m=(4e-4, 0.0)),
        ViewEquivalent(stable_pose=0, yaw=np.pi, shift_m=(4e-4, 0.0)),
    )
    poses = (
        replace(first, probability=0.8, view_equivalents=(there,)),
        replace(second, probability=0.2, view_equivalents=(back,)),
    )
    return replace(part, stable_poses=poses)


def plain(part: Part) -> Part:
    return replace(part, stable_poses=tuple(replace(p, view_equivalents=()) for p in part.stable_poses))


def test_symmetric_poses_of_a_nut_are_one() -> None:
    table = FaceTable([hexagon()])
    placements = [(0, 0.01, 0.02, 0.3), (0, 0.01, 0.02, 0.3 + 2 * TURN)]
    assert readings(table, placements) == [0, 0]
    (only,) = pose_alternatives(table, placements, np.array([2.0, 1.9]), T_CAM_TABLE)
    assert only.probability == pytest.approx(1.0)


def test_what_looks_the_same_is_in_the_set_however_sure_the_scores() -> None:
    part = header()
    table = FaceTable([part])
    at = (0, 0.01, 0.02, 0.5)
    found = pose_alternatives(table, [at, (1, 0.03, 0.0, 1.0)], np.array([9.0, -9.0]), T_CAM_TABLE, prior_weight=1.0)
    assert [(a.stable_pose, round(a.probability, 3)) for a in found] == [(0, 0.8), (1, 0.2)]
    # The other one covers the same ground: its middle is where the CAD says that it looks the same.
    rest = planar(0.01, 0.02, 0.5) @ planar(4e-4, 0.0, np.pi) @ part.stable_poses[1].T_table_part
    np.testing.assert_allclose(found[1].T_cam_part, T_CAM_TABLE @ rest, atol=1e-12)
    even = pose_alternatives(table, [at], np.array([0.0]), T_CAM_TABLE, prior_weight=0.0)
    assert [a.probability for a in even] == pytest.approx([0.5, 0.5])


def test_the_estimate_comes_first_even_if_another_rests_more_often() -> None:
    found = pose_alternatives(FaceTable([header()]), [(1, 0.0, 0.0, 0.0)], np.array([0.0]), T_CAM_TABLE)
    assert found[0].stable_pose == 1
    assert found[1].probability > found[0].probability


def test_close_scores_leave_more_readings_open_than_clear_ones() -> None:
    table = FaceTable([plain(header())])
    placements = [(0, 0.0, 0.0, 0.0), (0, 0.0, 0.0, np.pi), (1, 0.0, 0.0, 0.0)]
    clear = pose_alternatives(table, placements, np.array([9.0, 1.0, 0.0]), T_CAM_TABLE, mass=0.99)
    close = pose_alternatives(table, placements, np.array([1.0, 9.0, 8.5]), T_CAM_TABLE, mass=0.99)
    assert len(clear) == 1
    assert len(close) == 2
    assert sum(a.probability for a in close) == pytest.approx(1.0)
    np.testing.assert_allclose(
        apply(close[0].T_cam_part, np.zeros(3)),
        apply(T_CAM_TABLE @ planar(0, 0, np.pi) @ table[0].stable_pose.T_table_part, np.zeros(3)),
    )


def test_readings_do_not_count_places_but_rivals_do() -> None:
    table = FaceTable([plain(header())])
    a, b = (0, 0.0, 0.0, 3.12), (0, 3e-4, 0.0, -3.12)
    assert readings(table, [a, b, (1, 0.0, 0.0, 3.12)]) == [0, 0, 1]
    assert same_reading(table, a, b)
    assert not same_reading(table, a, b, 1.5e-4)


def test_sets_have_the_wanted_mass() -> None:
    p = reading_probabilities(np.array([3.0, 2.0, -50.0, 2.5]), [0, 1, 2, 1], temperature=1.0)
    assert p == pytest.approx([1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(0.5)), 0.0], abs=1e-9)
    assert likely_readings(np.array([0.1, 0.7, 0.2]), 0.6) == [1]
    assert likely_readings(np.array([0.1, 0.7, 0.2]), 0.75) == [1, 2]
    assert likely_readings(np.array([1.0]), 0.9999) == [0]
