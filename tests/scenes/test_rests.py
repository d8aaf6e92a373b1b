from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.stats import binom

from cad.equivalence import Axis, Symmetries
from cad.parts import StablePose, load_part, part_names, planar
from cad.resting import nearest_rest
from cad.spatial import apply, transform
from scenes.cell_config import CellConfig
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.rests import FILE, RestConfig, RestPool, _as_listed
from scenes.workcell import build_board_scene, part_body, set_parts

CELL = CellConfig()
QUICK = RestConfig(drops=24, each=3)


@pytest.fixture(scope="module")
def parts():
    return [load_part(name) for name in part_names()]


@pytest.fixture(scope="module")
def pool(parts):
    return RestPool.make(parts)


def in_bounds(count, draws, probability):
    """Whether a count is one that 99.99 % of binomial draws would give."""
    low, high = binom.interval(0.9999, draws, probability)
    return low <= count <= high


def simulated(names, T_board_part, seconds):
    """(T, N, 4, 4) of resting parts on the cell's board, every 10 ms."""
    model = build_board_scene(CELL, names).compile()
    data = mujoco.MjData(model)
    set_parts(model, data, CELL.T_world_board @ T_board_part)
    bodies = [model.body(part_body(i)).id for i in range(len(names))]
    seen = []
    for _ in range(round(seconds / 0.01)):
        mujoco.mj_step(model, data, round(0.01 / model.opt.timestep))
        seen.append([transform(data.xmat[b].reshape(3, 3), data.xpos[b]) for b in bodies])
    return np.linalg.inv(CELL.T_world_board) @ np.array(seen)


def test_every_face_has_rests_and_each_rest_is_of_the_face_it_says(parts, pool):
    for part in parts:
        rests = pool.rests[part.name]
        assert np.bincount(rests.stable_pose, minlength=len(part.stable_poses)).min() >= RestConfig().each
        for T, face in zip(rests.T_table_part, rests.stable_pose, strict=True):
            pose, leaning = nearest_rest(part, T[:3, :3])
            assert pose.index == face
            assert leaning <= RestConfig().leaning_rad
            corners = apply(T, part.mesh.vertices)
            np.testing.assert_allclose(corners[:, :2].min(axis=0) + corners[:, :2].max(axis=0), 0.0, atol=1e-12)
            assert -5e-6 < corners[:, 2].min() < 1e-6


def test_rests_keep_the_tilt_that_physics_gave_them(parts, pool):
    tilts = [nearest_rest(p, T[:3, :3])[1] for p in parts for T in pool.rests[p.name].T_table_part]
    assert max(tilts) > 1e-5


def test_drops_of_the_pool_agree_with_the_stored_probabilities(parts, pool):
    for part in parts:
        rests = pool.rests[part.name]
        assert rests.dropped.sum() + rests.elsewhere + rests.moving == RestConfig().drops
        for pose in part.stable_poses:
            assert in_bounds(rests.dropped[pose.index], RestConfig().drops, pose.probability)


@pytest.mark.parametrize("faces", ["physics", "uniform"])
def test_faces_are_drawn_as_often_as_they_should(parts, pool, faces):
    rng, draws = np.random.default_rng(8), 4000
    for part in parts:
        drawn = np.bincount([pool.draw(part, faces, rng).stable_pose for _ in range(draws)])
        total = sum(pose.probability for pose in part.stable_poses)
        for pose in part.stable_poses:
            share = pose.probability / total if faces == "physics" else 1 / len(part.stable_poses)
            assert in_bounds(drawn[pose.index], draws, share)


def test_a_rest_moved_about_in_the_plane_stays_where_it_is(parts, pool):
    rng = np.random.default_rng(4)
    names, placed = [], []
    for part in parts:
        for face in range(len(part.stable_poses)):
            rests = pool.rests[part.name]
            T = rests.T_table_part[rng.choice(np.flatnonzero(rests.stable_pose == face))]
            x, y = 0.02 * (len(names) % 4) - 0.03, 0.02 * (len(names) // 4) - 0.02
            names.append(part.name)
            placed.append(planar(x, y, rng.uniform(-np.pi, np.pi)) @ T)
    placed = np.array(placed)
    for T in simulated(names, placed, 0.3):
        assert np.linalg.norm(T[:, :3, 3] - placed[:, :3, 3], axis=1).max() < 5e-6
        turned = np.einsum("nij,nik->njk", T[:, :3, :3], placed[:, :3, :3])
        assert np.linalg.norm(turned - np.eye(3), axis=(1, 2)).max() / np.sqrt(2) < np.radians(0.02)


def test_a_radius_holds_the_footprint(parts, pool):
    rng = np.random.default_rng(1)
    for part in parts:
        rest = pool.draw(part, "uniform", rng)
        reach = np.linalg.norm(apply(rest.T_table_part, part.mesh.vertices)[:, :2], axis=1).max()
        assert rest.radius_m == pytest.approx(reach, abs=1e-12)


def test_the_pool_depends_on_the_seed_and_not_on_the_cores(parts, monkeypatch):
    part = replace(parts[0], name="same")  # another object: not what was made before
    one = RestPool.make([part], QUICK).rests["same"]
    monkeypatch.setattr("scenes.drops.os.cpu_count", lambda: 1)
    again = RestPool.make([replace(part)], QUICK).rests["same"]
    np.testing.assert_array_equal(one.T_table_part, again.T_table_part)
    np.testing.assert_array_equal(one.stable_pose, again.stable_pose)
    other = RestPool.make([part], replace(QUICK, seed=1)).rests["same"]
    assert one.T_table_part.shape != other.T_table_part.shape or (one.T_table_part != other.T_table_part).any()


def test_a_stored_pool_is_read_and_one_of_other_parts_is_not(parts, tmp_path, monkeypatch):
    made = RestPool.load_or_make(parts[:1], tmp_path, QUICK)
    first = (tmp_path / FILE).read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    with monkeypatch.context() as patch:
        patch.setattr("scenes.rests._part_rests", lambda *_: pytest.fail("made again"))
        read = RestPool.load_or_make(parts[:1], tmp_path, QUICK)
    np.testing.assert_array_equal(made.rests["inserted"].T_table_part, read.rests["inserted"].T_table_part)
    np.testing.assert_array_equal(made.rests["inserted"].dropped, read.rests["inserted"].dropped)
    poses = (*parts[0].stable_poses[1:], parts[0].stable_poses[0])
    turned = replace(parts[0], stable_poses=tuple(replace(pose, index=k) for k, pose in enumerate(poses)))
    changed = RestPool.load_or_make([turned], tmp_path, QUICK)
    assert changed.rests["inserted"].dropped.tolist() != made.rests["inserted"].dropped.tolist()
    RestPool.load_or_make(parts[:1], tmp_path, QUICK)
    assert (tmp_path / FILE).read_bytes() == first


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut off", b"\x93NUMPY"])
def test_a_damaged_file_is_made_again(parts, tmp_path, damage):
    (tmp_path / FILE).write_bytes(damage)
    RestPool.load_or_make(parts[:1], tmp_path, QUICK)
    with np.load(tmp_path / FILE) as stored:
        assert "inserted/T_table_part" in stored


def test_a_pool_that_cannot_be_stored_is_an_error(parts, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SceneError, match=r"cannot write rests\.npz"):
        RestPool.load_or_make(parts[:1], tmp_path / "file", QUICK)


def test_a_face_that_keeps_no_part_is_named(parts):
    edge = StablePose(
        index=4,
        R_table_part=transform()[:3, :3] @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]),
        t_table_part=np.zeros(3),
        probability=0.1,
        view_class=4,
    )
    part = replace(parts[0], stable_poses=(*parts[0].stable_poses, edge))
    with pytest.raises(SceneError, match="does not stay on stable pose 4"):
        RestPool.make([part], replace(QUICK, rounds=1))


def test_parts_without_stable_poses_are_refused(parts):
    with pytest.raises(SceneError, match="has no stable poses"):
        RestPool.make([replace(parts[0], stable_poses=())])


def brick(**changes):
    """A box with the symmetries of one, and only one of two faces like it among its stable poses."""
    turns = [np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1]), np.diag([-1.0, -1, 1, 1])]
    pose = StablePose(
        index=0, R_table_part=np.eye(3), t_table_part=np.array([0, 0, 1.5e-3]), probability=1.0, view_class=0
    )
    fields = {
        "mesh": trimesh.creation.box((8e-3, 6e-3, 3e-3)),
        "symmetries": Symmetries(discrete=np.array(turns)),
        "stable_poses": (pose,),
    }
    return replace(load_part("main"), name="brick", **(fields | changes))


def test_a_symmetric_part_on_its_other_face_comes_as_its_stable_pose_describes_it():
    part = brick()
    over = planar(0, 0, 0.3) @ np.diag([1.0, -1, -1, 1])
    over[2, 3] = 1.5e-3
    listed = _as_listed(part, part.stable_poses[0], over)
    assert listed[2, 2] == pytest.approx(1.0)
    np.testing.assert_allclose(
        np.sort(apply(listed, part.mesh.vertices), axis=0), np.sort(apply(over, part.mesh.vertices), axis=0), atol=1e-12
    )


def test_a_part_that_rolls_keeps_its_roll():
    roll = Axis(direction=np.array([1.0, 0, 0]), point=np.zeros(3))
    pose = replace(brick().stable_poses[0], roll=roll)
    part = brick(symmetries=Symmetries(), stable_poses=(pose,))
    rolled = planar(0, 0, 1.0) @ roll.turn(0.7)
    np.testing.assert_array_equal(_as_listed(part, pose, rolled), rolled)


@pytest.mark.parametrize("bad", [{"drops": 0}, {"each": 0}, {"seed": -1}, {"near_rad": 0.0}, {"leaning_rad": -1.0}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(SceneError, match=next(iter(bad))):
        RestConfig(**bad)
