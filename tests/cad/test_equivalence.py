"""Laws of comparing poses modulo a symmetry group, and of naming the stable pose that a part lies in."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.equivalence import Axis, Symmetries, symmetries_from_json, symmetries_to_json
from cad.parts import Part, StablePose
from cad.resting import as_rest, nearest_rest, settled
from cad.spatial import Array, rotation_angle, rotation_from_rotvec, rotation_x, rotation_z, transform

CENTRE = np.array([1e-3, -2e-3, 3e-3])
Z = np.array([0.0, 0.0, 1.0])


def about(centre: Array, R: Array) -> Array:
    return transform(R, centre - R @ centre)


FLIP = about(CENTRE, rotation_x(np.pi))
GROUPS = {
    "none": Symmetries(),
    "prism": Symmetries(discrete=np.array([about(CENTRE, rotation_z(k * np.pi / 3)) for k in range(1, 6)])),
    "cone": Symmetries(continuous=(Axis(direction=Z, point=CENTRE),)),
    "cylinder": Symmetries(discrete=FLIP[None], continuous=(Axis(direction=Z, point=CENTRE),)),
    "ball": Symmetries(continuous=tuple(Axis(direction=np.eye(3)[i], point=CENTRE) for i in range(3))),
}


def random_pose(rng: np.random.Generator) -> Array:
    return transform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


@pytest.mark.parametrize("name", GROUPS)
def test_a_symmetry_of_a_pose_is_no_difference(name: str) -> None:
    group, rng = GROUPS[name], np.random.default_rng(1)
    for S in group.sampled(7):
        T = random_pose(rng)
        assert group.difference(T, T @ S) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("name", GROUPS)
def test_the_nearest_equivalent_is_no_farther_than_any_sampled_one(name: str) -> None:
    group, rng = GROUPS[name], np.random.default_rng(2)
    for _ in range(20):
        T_reference, T = random_pose(rng), random_pose(rng)
        sampled = min(rotation_angle(T_reference[:3, :3], (T @ S)[:3, :3]) for S in group.sampled(360))
        found = group.difference(T_reference, T)[1]
        assert found <= sampled + 1e-9
        if name != "ball":
            assert found >= sampled - np.radians(1.0)


@pytest.mark.parametrize("name", GROUPS)
def test_the_json_form_keeps_the_group(name: str) -> None:
    group = GROUPS[name]
    again = symmetries_from_json(symmetries_to_json(group))
    np.testing.assert_allclose(again.sampled(5), group.sampled(5), atol=1e-9)


def test_the_json_form_is_in_millimetres() -> None:
    document = symmetries_to_json(GROUPS["cylinder"])
    assert document["symmetries_continuous"][0]["offset"] == pytest.approx(1e3 * CENTRE)
    assert np.reshape(document["symmetries_discrete"][0], (4, 4))[:3, 3] == pytest.approx(1e3 * FLIP[:3, 3])


def pin() -> Part:
    """A pin along z with a flat on one end, so that its hull is round but the pin is not; it lies or stands."""
    lying = rotation_from_rotvec(np.pi / 2 * np.array([0.0, 1.0, 0.0]))
    poses = (
        StablePose(
            index=0,
            R_table_part=lying,
            t_table_part=np.array([0.0, 0.0, 1e-3]),
            probability=0.9,
            view_class=0,
            roll=Axis(direction=Z, point=np.zeros(3)),
        ),
        StablePose(
            index=1, R_table_part=np.eye(3), t_table_part=np.array([0.0, 0.0, 3e-3]), probability=0.1, view_class=1
        ),
    )
    mesh = trimesh.creation.cylinder(1e-3, 6e-3)
    return Part(
        name="pin", obj_id=9, folder=None, mass_kg=1e-4, material="steel", rgba=(1, 1, 1, 1), metallic=1.0,  # type: ignore[arg-type]
        roughness=0.3, mesh=mesh, symmetries=Symmetries(), stable_poses=poses, keypoints=np.zeros((8, 3)), mesh_hash="",
    )  # fmt: skip


def test_a_round_part_lies_in_one_pose_at_any_roll_and_settles_there() -> None:
    part, rng = pin(), np.random.default_rng(3)
    pose = part.stable_poses[0]
    for _ in range(50):
        yaw, roll = rng.uniform(-np.pi, np.pi, 2)
        flat = transform(rotation_z(yaw), [*rng.normal(size=2), 0.0]) @ pose.T_table_part
        T = flat @ part.stable_poses[0].roll.turn(roll)
        found, tilt = nearest_rest(part, T[:3, :3])
        assert (found.index, tilt) == (0, pytest.approx(0.0, abs=1e-9))
        np.testing.assert_allclose(settled(pose, as_rest(part, pose, T)), flat, atol=1e-9)


def test_a_roll_is_a_difference_in_the_view_but_not_at_rest() -> None:
    part = pin()
    T = part.stable_poses[0].T_table_part
    rolled = T @ part.stable_poses[0].roll.turn(1.0)
    assert part.symmetries.difference(T, rolled)[1] == pytest.approx(1.0)
    assert part.rest_symmetries(0).difference(T, rolled)[1] == pytest.approx(0.0, abs=1e-9)
    assert part.rest_symmetries(1) is part.symmetries


def test_a_lean_is_measured_across_the_roll() -> None:
    part = pin()
    leaning = part.stable_poses[1].R_table_part
    found, tilt = nearest_rest(part, rotation_x(0.05) @ leaning)
    assert (found.index, tilt) == (1, pytest.approx(0.05))
