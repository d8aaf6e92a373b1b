import re
import shutil

import numpy as np
import pytest
import trimesh

from cad import gripper
from cad.parts import BUILT_IN, load_part
from cad.spatial import apply, inverse, rotation_x, rotation_z, transform
from twin.grasp_config import GraspConfig, GraspError
from twin.grasp_geometry import (
    ContactRules,
    Miss,
    Missed,
    PadContact,
    PadStrip,
    pad_contact,
    sample_surface,
    topples,
    view_along,
)
from twin.grasp_search import find_grasps
from twin.grasps import describe_grasps, plan_grasps, read_grasps, write_grasps

SIZE = np.array([8e-3, 6e-3, 3e-3])
STRIP = PadStrip(half_width_m=3e-3, z_low_m=0.15e-3, z_high_m=10e-3)


def contact_of(mesh, yaw, b=0.0, rules=None):
    view = view_along(sample_surface(mesh, 0.08e-3), yaw, STRIP)
    return pad_contact(view, b, STRIP, rules or ContactRules())


def test_contact_with_a_box_is_its_faces():
    box = trimesh.creation.box(SIZE, transform=transform(t=[0, 0, SIZE[2] / 2]))
    contact = contact_of(box, 0.0)
    assert isinstance(contact, PadContact)
    assert contact.width_m == pytest.approx(8e-3, abs=1e-6)
    assert contact.length_m == pytest.approx(6e-3, abs=0.1e-3)
    assert contact.height_m == pytest.approx(2.85e-3, abs=0.1e-3)
    assert contact.area_m2 == pytest.approx(6e-3 * 2.85e-3, rel=0.1)
    assert contact.flatness_m < 1e-9


def test_contact_turns_with_the_part():
    rng = np.random.default_rng(0)
    for yaw in rng.uniform(0, np.pi, 5):
        T = transform(rotation_z(yaw), [0, 0, SIZE[2] / 2])
        contact = contact_of(trimesh.creation.box(SIZE, transform=T), yaw)
        assert isinstance(contact, PadContact)
        assert contact.width_m == pytest.approx(8e-3, abs=1e-6)


def miss_of(*args, **options):
    missed = contact_of(*args, **options)
    assert isinstance(missed, Missed), missed
    return missed.miss


def lying_rod(radius, turned=0.0):
    rod = trimesh.creation.cylinder(radius=radius, height=6e-3, sections=96)
    return rod.apply_transform(transform(rotation_z(turned) @ rotation_x(np.pi / 2), [0, 0, radius]))


def test_a_corner_is_no_contact():
    box = trimesh.creation.box(SIZE, transform=transform(t=[0, 0, SIZE[2] / 2]))
    assert miss_of(box, np.deg2rad(40.0)) is Miss.NO_FACE
    assert miss_of(box, 0.0, b=0.02) is Miss.NOTHING


def test_faces_that_do_not_face_each_other_are_no_contact():
    lower = trimesh.creation.box([4e-3, 4e-3, 2e-3], transform=transform(t=[-2e-3, -2.1e-3, 1e-3]))
    upper = trimesh.creation.box([4e-3, 4e-3, 2e-3], transform=transform(t=[2e-3, 2.1e-3, 1e-3]))
    assert miss_of(trimesh.util.concatenate([lower, upper]), 0.0) is Miss.NOT_FACING


@pytest.mark.parametrize("radius", [0.6e-3, 1e-3, 2e-3])
def test_a_rod_is_held_along_lines(radius):
    lying = contact_of(lying_rod(radius), 0.0)
    assert isinstance(lying, PadContact), lying
    assert lying.roll == pytest.approx(1.0, abs=0.2)
    assert lying.length_m == pytest.approx(6e-3, abs=0.2e-3)
    upright = trimesh.creation.cylinder(radius=radius, height=6e-3, sections=96, transform=transform(t=[0, 0, 3e-3]))
    standing = contact_of(upright, 0.7)
    assert isinstance(standing, PadContact), standing
    assert standing.height_m == pytest.approx(6e-3 - 0.15e-3, abs=0.2e-3)


@pytest.mark.parametrize("radius", [1e-3, 2e-3, 5e-3])
def test_a_ball_is_touched_in_points(radius):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    ball.apply_translation([0, 0, radius])
    assert miss_of(ball, 0.3) in (Miss.POINT, Miss.NOT_FACING, Miss.NO_FACE)


def test_round_ends_of_a_long_part_roll():
    lens = trimesh.util.concatenate([lying_rod(1.5e-3).apply_translation([x, 0, 0]) for x in (-3e-3, 3e-3)])
    assert miss_of(lens.convex_hull, 0.0) is Miss.ROLLS


def test_a_high_push_topples_a_narrow_part():
    base = np.array([[-0.2e-3, 0.0], [0.2e-3, 0.0]])
    low, high = (
        PadContact(
            width_m=1e-3,
            a_mid_m=0,
            area_m2=1e-6,
            length_m=1e-3,
            height_m=1e-3,
            b_centre_m=0,
            z_centre_m=0,
            z_touch_m=z,
            flatness_m=0,
            roll=0,
        )
        for z in (0.15e-3, 5e-3)
    )
    com = np.array([0.0, 0.0, 4e-3])
    assert topples(low, 0.0, base, com, 0.4) is None
    missed = topples(high, 0.0, base, com, 0.4)
    assert missed is not None and "0.20 mm, 2.00 needed" in str(missed)


def test_grasps_of_a_brick_close_on_its_faces(brick):
    grasps = find_grasps(brick, brick.stable_poses[0]).grasps
    assert {round(g.width_m * 1e3, 3) for g in grasps} == {8.0, 6.0}
    assert grasps[0].width_m == pytest.approx(6e-3)  # the longer face aligns itself better
    for grasp in grasps:
        T_table_tcp = brick.stable_poses[0].T_table_part @ grasp.T_part_tcp
        np.testing.assert_allclose(T_table_tcp[:3, 2], [0, 0, -1], atol=1e-12)
        assert T_table_tcp[2, 3] == pytest.approx(GraspConfig().tip_clearance_m)
        # in the tool's frame the part is centred across the pads, and the opening leaves 3 mm a side
        across = apply(inverse(grasp.T_part_tcp), brick.mesh.vertices)[:, 0]
        assert across.max() == pytest.approx(-across.min(), abs=1e-6)
        assert grasp.opening_m >= across.max() - across.min() + 2 * 3e-3 - 1e-6
        assert 0 < grasp.quality <= 1
    assert [g.quality for g in grasps] == sorted((g.quality for g in grasps), reverse=True)


def test_flat_faces_rank_above_round_ones(make_part):
    part = make_part(lying_rod(2e-3), "rod")
    assert find_grasps(part, part.stable_poses[0]).grasps[0].contact.flatness_m < 1e-6


def test_faces_between_the_steps_of_the_fan_are_found(make_part):
    part = make_part(trimesh.creation.box(SIZE, transform=transform(rotation_z(np.deg2rad(22.5)))))
    assert find_grasps(part, part.stable_poses[0]).grasps[0].width_m == pytest.approx(6e-3, abs=1e-6)


def test_the_pads_come_down_to_a_ledge(make_part):
    plate = trimesh.creation.cylinder(radius=12e-3, height=1e-3, sections=64)
    stud = trimesh.creation.box([4e-3, 4e-3, 5e-3], transform=transform(t=[0, 0, 3e-3]))
    part = make_part(trimesh.util.concatenate([plate, stud]), "stud")
    coarse = GraspConfig(sample_spacing_m=0.15e-3, yaw_step=np.pi / 6)
    grasp = find_grasps(part, part.stable_poses[0], coarse).grasps[0]
    assert grasp.width_m == pytest.approx(4e-3, abs=1e-6)
    tips = (part.stable_poses[0].T_table_part @ grasp.T_part_tcp)[2, 3]
    assert 1.1e-3 < tips < 1.5e-3


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (trimesh.creation.box([50e-3, 48e-3, 2e-3]), "wider than the gripper opens: 48.0 mm"),
        (trimesh.creation.box([3e-3, 0.2e-3, 1e-3]), "too thin"),
        (trimesh.creation.cone(radius=3e-3, height=6e-3, sections=64), "nothing flat enough"),
        (
            trimesh.creation.icosphere(subdivisions=4, radius=3e-3),
            "flat enough|round both ways|face each other",
        ),
        (
            trimesh.util.concatenate(
                [
                    trimesh.creation.box([4e-3, 4e-3, 14e-3], transform=transform(t=[0, 0, 7e-3])),
                    trimesh.creation.box([16e-3, 16e-3, 2e-3], transform=transform(t=[0, 0, 15e-3])),
                ]
            ),
            "wider above the pads",
        ),
    ],
)
def test_what_cannot_be_gripped_says_why(make_part, mesh, reason):
    part = make_part(mesh, "odd")
    narrow = GraspConfig(yaw_step=np.pi / 6)
    (pose,) = write_grasps(part, narrow)
    assert not pose.grasps and re.search(reason, pose.why_not)
    (stored,) = describe_grasps(load_part("odd", part.folder.parent))
    assert stored.why_not == pose.why_not


def test_stored_grasps_read_back(planned_brick):
    (stored,) = read_grasps(load_part("brick", planned_brick.folder.parent))
    (planned,) = plan_grasps(planned_brick, GraspConfig(sample_spacing_m=0.2e-3, yaw_step=np.pi / 6, enough=6))
    assert len(stored) == len(planned.grasps) > 1 and planned.why_not == ""
    for one, other in zip(stored, planned.grasps, strict=True):
        np.testing.assert_allclose(one.T_part_tcp, other.T_part_tcp, atol=1e-8)
        assert one.width_m == pytest.approx(other.width_m, abs=1e-7)
        assert one.trial and one.trial.held and one.trial.slip_m == pytest.approx(other.trial.slip_m, abs=1e-7)
    assert stored[0].trial is not None and stored[0].trial.margin == 1.0


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_pose_of_the_built_in_parts_has_grasps_that_held(name):
    for pose in describe_grasps(load_part(name)):
        assert pose.grasps, pose.why_not
        assert all(grasp.trial is not None and grasp.trial.held for grasp in pose.grasps)
        assert [g.quality for g in pose.grasps] == sorted((g.quality for g in pose.grasps), reverse=True)


def test_missing_or_stale_grasps_are_named(make_part, planned_brick):
    brick = make_part(trimesh.creation.box(SIZE))
    path = brick.folder / "grasps.json"
    with pytest.raises(GraspError, match="write_grasps"):
        read_grasps(brick)
    shutil.copy(planned_brick.folder / "grasps.json", path)
    path.write_text(path.read_text().replace(brick.mesh_hash, "0" * 16))
    with pytest.raises(GraspError, match="0000"):
        read_grasps(brick)


def test_stable_poses_have_their_own_grasps(make_part):
    lying, standing = np.eye(3), rotation_x(np.pi / 2)
    poses = [
        {"R_table_part": lying.tolist(), "t_table_part_m": [0, 0, 1.5e-3], "probability": 0.6},
        {"R_table_part": standing.tolist(), "t_table_part_m": [0, 0, 3e-3], "probability": 0.4},
    ]
    part = make_part(trimesh.creation.box(SIZE), poses=poses)
    by_pose = [find_grasps(part, pose).grasps for pose in part.stable_poses]
    assert by_pose[1][0].width_m == pytest.approx(3e-3, abs=1e-6)
    assert all(g.stable_pose == k for k, grasps in enumerate(by_pose) for g in grasps)


def test_a_wide_part_is_approached_with_what_room_the_stroke_leaves():
    config = GraspConfig()
    assert config.clearance_at(10e-3) == config.clearance_m
    assert 46e-3 + 2 * config.clearance_at(46e-3) == pytest.approx(gripper.STROKE_M)
    assert config.clearance_at(config.max_width_m) == pytest.approx(config.min_clearance_m)
