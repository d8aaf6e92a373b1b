import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.collision import cut_shapes
from cad.equivalence import Symmetries
from cad.folders import PartFacts, write_part_folder
from cad.parts import ViewEquivalent, load_part
from cad.spatial import rotation_angle
from scenes.errors import SceneError
from scenes.part_preview import TILE_PX, contact_sheet, look_at
from scenes.resting_faces import RestingFace, resting_faces, roll_axis, ways_to_rest
from scenes.stable_poses import StablePoseConfig, canonical_rotation, find_stable_poses, write_stable_poses

NAMES = ["inserted", "main", "top"]
QUICK = StablePoseConfig(drops=60, threads=2)


def make_part(root, name, mesh):
    facts = PartFacts(
        name=name,
        obj_id=9,
        density_kg_m3=1500.0,
        material="abs",
        rgba=(0.5, 0.5, 0.5, 1.0),
        metallic=0.0,
        roughness=0.5,
    )
    write_part_folder(root / name, mesh, cut_shapes(mesh, [mesh.convex_hull]), facts)
    return load_part(name, root)


@pytest.fixture(scope="module")
def brick(tmp_path_factory):
    return make_part(tmp_path_factory.mktemp("parts"), "brick", trimesh.creation.box((8e-3, 6e-3, 3e-3)))


@pytest.fixture(scope="module")
def brick_result(brick):
    return find_stable_poses(brick, QUICK)


def test_a_brick_rests_on_its_large_faces_most_and_faces_alike_count_once(brick_result):
    poses = brick_result.poses
    assert poses[0].height_m == pytest.approx(1.5e-3, abs=5e-6)
    assert len(poses) <= 3
    assert poses[0].probability > 0.5
    assert [p.probability for p in poses] == sorted((p.probability for p in poses), reverse=True)
    assert sum(p.probability for p in poses) + brick_result.unassigned == pytest.approx(1.0)
    assert max(brick_result.hull_deg) < 0.13
    assert brick_result.unsettled == 0


def test_the_same_seed_gives_the_same_poses_whatever_the_threads(brick, brick_result):
    again = find_stable_poses(brick, replace(QUICK, threads=1))
    for a, b in zip(brick_result.poses, again.poses, strict=True):
        np.testing.assert_array_equal(a.T_table_part, b.T_table_part)
        assert a.probability == b.probability


def knurled_pin():
    """A pin along x whose hull is round, with a slot across one end: the mesh is not round, nor turned onto itself."""
    pin = trimesh.creation.cylinder(radius=2e-3, height=9e-3, sections=96)
    pin.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    cuts = [trimesh.creation.box((2e-3, 1e-3, 2e-3)), trimesh.creation.box((1.5e-3, 0.8e-3, 0.8e-3))]
    cuts[0].apply_translation([4e-3, 0, 0])
    cuts[1].apply_translation([-4e-3, 0, 0])
    for cut in cuts:
        pin = trimesh.boolean.difference([pin, cut], engine="manifold")
    return pin


def test_a_round_part_lying_down_is_one_pose(tmp_path):
    part = make_part(tmp_path, "pin", trimesh.creation.cylinder(radius=2e-3, height=8e-3, sections=32))
    result = find_stable_poses(part, replace(QUICK, drops=50))
    lying = [p for p in result.poses if abs(p.R_table_part[2, 2]) < 0.1]
    assert len(lying) == 1 and lying[0].roll is None
    assert lying[0].height_m == pytest.approx(2e-3, abs=2e-5)


def test_a_part_with_a_round_hull_rests_at_any_roll(tmp_path):
    part = make_part(tmp_path, "pin", knurled_pin())
    assert not part.symmetries.continuous
    result = find_stable_poses(part, QUICK)
    lying = [p for p in result.poses if p.roll is not None]
    assert len(lying) == 1 and lying[0].probability > 0.5
    assert abs(lying[0].roll.direction[0]) == pytest.approx(1.0, abs=1e-6)
    assert all(abs(p.R_table_part[2, 0]) > 0.99 for p in result.poses if p.roll is None)
    assert result.spread_deg[lying[0].index] < 0.3
    assert result.unassigned == 0
    ups = result.settled_up[result.owner == lying[0].index]
    rolls = np.degrees(np.arctan2(ups[:, 1], ups[:, 2]))
    assert np.ptp(rolls) > 180


def test_a_roll_axis_passes_through_the_centre_of_mass_or_is_none():
    mesh = knurled_pin()
    axis = roll_axis(mesh, Symmetries())
    assert axis is not None
    np.testing.assert_allclose(axis.point, mesh.center_mass)
    off = trimesh.boolean.difference(
        [
            mesh,
            trimesh.creation.box(
                (6e-3, 1e-3, 1e-3), transform=trimesh.transformations.translation_matrix([0, 1e-3, 0])
            ),
        ],
        engine="manifold",
    )
    assert roll_axis(off, Symmetries()) is None


def test_quasi_static_probabilities_of_a_brick_are_solid_angles_and_sum_to_one():
    faces = ways_to_rest(trimesh.creation.box((8e-3, 6e-3, 3e-3)), Symmetries(), np.radians(2))
    assert len(faces) == 6
    assert sum(f.probability for f in faces) == pytest.approx(1.0)
    a, b, h = 4.0, 3.0, 1.5  # solid angle of a face seen from the middle
    angle = 4 * np.arctan(a * b / (h * np.sqrt(a * a + b * b + h * h)))
    assert faces[0].probability == pytest.approx(angle / (4 * np.pi), rel=0.1)


def test_the_angle_to_a_face_is_taken_modulo_roll_and_symmetries(brick):
    flat = RestingFace(up=np.array([0.0, 0.0, 1.0]))
    ups = np.array([[0.0, 0.0, -1.0], [0.0, np.sin(0.1), np.cos(0.1)]])
    np.testing.assert_allclose(flat.angles(ups, Symmetries()), [np.pi, 0.1], atol=1e-9)
    np.testing.assert_allclose(flat.angles(ups, brick.symmetries), [0.0, 0.1], atol=1e-9)
    axis = roll_axis(knurled_pin(), Symmetries())
    np.testing.assert_allclose(replace(flat, roll=axis).angles(ups, Symmetries()), 0.0, atol=1e-4)


def test_total_variation_is_half_the_sum_of_the_differences(brick_result):
    drops = [p.probability for p in brick_result.poses] + [brick_result.unassigned]
    quasi_static = [*brick_result.quasi_static, 1 - sum(brick_result.quasi_static)]
    expected = np.abs(np.subtract(drops, quasi_static)).sum() / 2
    assert brick_result.total_variation == pytest.approx(expected)
    assert 0 < expected < 0.3


def test_poses_found_again_keep_their_numbers(brick, brick_result):
    turned = replace(brick, stable_poses=brick_result.poses[::-1])
    again = find_stable_poses(turned, QUICK)
    for old, new in zip(brick_result.poses[::-1], again.poses, strict=True):
        np.testing.assert_allclose(new.R_table_part, old.R_table_part)
    assert [p.index for p in again.poses] == list(range(len(again.poses)))


def test_written_poses_read_back(tmp_path, brick_result):
    part = make_part(tmp_path, "brick", trimesh.creation.box((8e-3, 6e-3, 3e-3)))
    write_stable_poses(part.folder, brick_result)
    stored = load_part("brick", tmp_path)
    assert [p.view_equivalents for p in stored.stable_poses] == [None] * len(brick_result.poses)
    for a, b in zip(stored.stable_poses, brick_result.poses, strict=True):
        np.testing.assert_allclose(a.T_table_part, b.T_table_part, atol=1e-9)
    document = json.loads((part.folder / "stable_poses.json").read_text())
    assert document["made_for"] == part.mesh_hash
    assert {"drops", "unsettled", "unassigned", "total_variation"} <= set(document)


def test_poses_that_look_alike_share_a_view_class(tmp_path):
    part = make_part(tmp_path, "pin", knurled_pin())
    result = find_stable_poses(part, QUICK)
    last = len(result.poses) - 1
    assert last >= 1
    equivalents = [[] for _ in result.poses]
    equivalents[0] = [ViewEquivalent(stable_pose=last, yaw=0.5, shift_m=(1e-3, 0.0))]
    write_stable_poses(part.folder, result, equivalents)
    stored = load_part("pin", tmp_path).stable_poses
    assert stored[0].view_class == stored[last].view_class == 0
    assert stored[0].view_equivalents == tuple(equivalents[0])
    assert stored[last].view_equivalents == ()
    np.testing.assert_allclose(stored[0].roll.point, result.poses[0].roll.point, atol=1e-9)


def test_a_demand_no_pose_meets_is_an_error(brick):
    with pytest.raises(SceneError, match=r"brick.*min_probability"):
        find_stable_poses(brick, replace(QUICK, drops=10, duration_s=0.05))


@pytest.mark.parametrize("bad", [{"drops": 0}, {"min_probability": 1.0}, {"max_unassigned": -0.1}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(SceneError, match=r"drops|min_probability|max_unassigned"):
        StablePoseConfig(**bad)


@pytest.mark.parametrize("name", NAMES)
def test_the_canonical_rotation_is_proper_and_points_the_parts_x_along_the_tables(name):
    for up in (p.R_table_part[2] for p in load_part(name).stable_poses):
        R = canonical_rotation(up / np.linalg.norm(up))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-8)
        assert np.linalg.det(R) == pytest.approx(1.0)
        axis = R[:, 0] if abs(up[0]) < 0.9 else R[:, 1]
        assert axis[0] > 0
        assert axis[1] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_stored_poses_are_canonical_and_touch_the_table(name):
    part = load_part(name)
    assert sum(p.probability for p in part.stable_poses) > 0.99
    assert min(p.probability for p in part.stable_poses) >= 0.005
    for pose in part.stable_poses:
        v = part.mesh.vertices @ pose.R_table_part.T + pose.t_table_part
        np.testing.assert_allclose(v[:, :2].min(axis=0) + v[:, :2].max(axis=0), 0, atol=1e-8)
        assert -6e-6 < v[:, 2].min() < 2e-9
        assert rotation_angle(pose.R_table_part, canonical_rotation(pose.R_table_part[2])) < 1e-6
        ups = resting_faces(part.mesh)[0] @ pose.R_table_part[2]
        assert np.degrees(np.arccos(np.clip(ups.max(), -1, 1))) < 0.13
    corner = np.array([p.R_table_part[2] for p in part.stable_poses])
    apart = np.degrees(np.arccos(np.clip(corner @ corner.T, -1, 1)))[~np.eye(len(corner), dtype=bool)]
    assert apart.min() > 10


def test_a_camera_looks_at_its_target_from_the_asked_side():
    direction = Rotation.random(rng=np.random.default_rng(0)).as_matrix()[2]
    for d in (direction, np.array([0.0, 0.0, 1.0])):
        T = look_at(np.array([1.0, 2.0, 3.0]), d, 0.5)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(T @ [0, 0, 0.5, 1], [1, 2, 3, 1], atol=1e-12)


def test_the_contact_sheet_shows_the_part_in_every_pose():
    part = load_part("top")
    sheet = contact_sheet(part)
    assert sheet.shape == (2 * TILE_PX, len(part.stable_poses) * TILE_PX, 3)
    tiles = sheet.reshape(2, TILE_PX, -1, TILE_PX, 3).swapaxes(1, 2)
    assert all(tile.std() > 10 for row in tiles for tile in row)
