import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.folders import PartFacts, write_part_folder
from cad.parts import load_part
from cad.spatial import rotation_angle
from cad.symmetry import find_symmetries
from scenes.errors import SceneError
from scenes.part_preview import TILE_PX, contact_sheet, look_at
from scenes.stable_poses import (
    StablePoseConfig,
    canonical_rotation,
    closest_equivalent,
    drop,
    find_stable_poses,
    resting_faces,
    write_stable_poses,
)

NAMES = ["inserted", "main", "top"]
QUICK = StablePoseConfig(drops=100, threads=2, duration_s=0.6)


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
    write_part_folder(root / name, mesh, [mesh.convex_hull], facts)
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
    assert max(brick_result.refined_deg) < 0.13


def test_the_same_seed_gives_the_same_poses_whatever_the_threads(brick, brick_result):
    again = find_stable_poses(brick, replace(QUICK, threads=1))
    for a, b in zip(brick_result.poses, again.poses, strict=True):
        np.testing.assert_array_equal(a.T_table_part, b.T_table_part)
        assert a.probability == b.probability


def test_a_round_part_lying_down_is_one_pose(tmp_path):
    mesh = trimesh.creation.cylinder(radius=2e-3, height=8e-3, sections=32)
    part = make_part(tmp_path, "pin", mesh)
    poses = find_stable_poses(part, replace(QUICK, drops=50, still_rate=20.0, still_speed=0.05)).poses
    lying = [p for p in poses if abs(p.R_table_part[2, 2]) < 0.1]
    assert len(lying) == 1
    assert lying[0].height_m == pytest.approx(2e-3, abs=2e-5)


def test_written_poses_read_back(tmp_path, brick_result):
    part = make_part(tmp_path, "brick", trimesh.creation.box((8e-3, 6e-3, 3e-3)))
    write_stable_poses(part.folder, brick_result)
    document = json.loads((part.folder / "stable_poses.json").read_text())
    assert len(document["stable_poses"]) == len(brick_result.poses)
    for stored, pose in zip(document["stable_poses"], brick_result.poses, strict=True):
        np.testing.assert_allclose(stored["R_table_part"], pose.R_table_part, atol=1e-9)


def test_a_demand_no_pose_meets_is_an_error(brick):
    with pytest.raises(SceneError, match=r"brick.*min_probability"):
        find_stable_poses(brick, replace(QUICK, drops=10, duration_s=0.002))


@pytest.mark.parametrize("bad", [{"drops": 0}, {"threads": 0}, {"height_m": 0.0}, {"min_probability": 1.0}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(ValueError, match=r"drops|height|min_probability"):
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


def test_equivalent_directions_are_brought_together(brick):
    symmetries = find_symmetries(brick.mesh)
    target = np.array([0.1, 0.2, 0.97])
    np.testing.assert_allclose(closest_equivalent(target * [-1, 1, -1], target, symmetries), target, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_stored_poses_are_canonical_and_touch_the_table(name):
    part = load_part(name)
    assert sum(p.probability for p in part.stable_poses) > 0.99
    assert min(p.probability for p in part.stable_poses) >= 0.005
    for pose in part.stable_poses:
        v = part.mesh.vertices @ pose.R_table_part.T + pose.t_table_part
        np.testing.assert_allclose(v[:, :2].min(axis=0) + v[:, :2].max(axis=0), 0, atol=1e-8)
        assert -6e-6 < v[:, 2].min() <= 0
        assert rotation_angle(pose.R_table_part, canonical_rotation(pose.R_table_part[2])) < 1e-6
        ups = resting_faces(part.mesh) @ pose.R_table_part[2]
        assert np.degrees(np.arccos(np.clip(ups.max(), -1, 1))) < 0.13
    corner = np.array([p.R_table_part[2] for p in part.stable_poses])
    apart = np.degrees(np.arccos(np.clip(corner @ corner.T, -1, 1)))[~np.eye(len(corner), dtype=bool)]
    assert apart.min() > 10


@pytest.mark.parametrize("name", NAMES)
def test_drops_come_to_rest_in_the_stored_poses(name):
    part = load_part(name)
    drops = drop(part, replace(QUICK, drops=30, seed=5))
    stored = np.array([p.R_table_part[2] for p in part.stable_poses])
    angle = np.degrees(np.arccos(np.clip((drops.R_table_part[:, 2] @ stored.T).max(axis=1), -1, 1)))
    assert (drops.still & (angle < 0.13)).mean() >= 0.9


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
