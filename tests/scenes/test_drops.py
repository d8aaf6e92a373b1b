from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cad.equivalence import Symmetries
from cad.parts import Part, load_part
from scenes.drops import DropsConfig, _is_still, drop_part
from scenes.errors import SceneError

QUICK = DropsConfig(drops=60, threads=2)


def part_of(mesh: trimesh.Trimesh) -> Part:
    return Part(
        name="solid",
        obj_id=9,
        folder=Path(),
        mass_kg=1500.0 * float(mesh.volume),
        material="abs",
        rgba=(0.5, 0.5, 0.5, 1.0),
        metallic=0.0,
        roughness=0.5,
        mesh=mesh,
        symmetries=Symmetries(),
        stable_poses=(),
        keypoints=np.zeros((8, 3)),
        mesh_hash="",
    )


def up_angles_deg(R: np.ndarray) -> np.ndarray:
    """Angle of the nearest axis of the part from the vertical."""
    return np.degrees(np.arccos(np.clip(np.abs(R[:, 2]).max(axis=1), -1, 1)))


@pytest.fixture(scope="module")
def brick():
    return trimesh.creation.box((8e-3, 6e-3, 3e-3))


@pytest.fixture(scope="module")
def dropped(brick):
    return drop_part(part_of(brick), [brick], QUICK)


def test_every_dropped_brick_lies_flat_on_a_face(dropped):
    assert dropped.still.all()
    assert up_angles_deg(dropped.R_table_part).max() < 0.05
    sides = np.abs(dropped.R_table_part[:, 2]).argmax(axis=1)
    np.testing.assert_allclose(dropped.height_m, np.array([4e-3, 3e-3, 1.5e-3])[sides], atol=5e-6)


def test_a_drop_that_lies_still_is_taken_out_early(dropped):
    assert dropped.seconds.max() < QUICK.duration_s
    assert np.ptp(dropped.seconds) > 0
    assert dropped.seconds.min() > QUICK.stage_s


def test_drops_depend_on_the_seed_only(brick, dropped):
    one_thread = drop_part(part_of(brick), [brick], replace(QUICK, threads=1))
    np.testing.assert_array_equal(dropped.R_table_part, one_thread.R_table_part)
    other = drop_part(part_of(brick), [brick], replace(QUICK, seed=1))
    assert not np.allclose(dropped.R_table_part, other.R_table_part)


def test_the_share_of_drops_that_are_over_grows_to_all(brick):
    told: list[float] = []
    drop_part(part_of(brick), [brick], QUICK, told.append)
    assert told == sorted(told) and told[0] < 1.0 and told[-1] == 1.0


def test_drops_begin_in_the_orientations_they_are_given(brick):
    tilt = np.radians(2.0)
    R = np.array([[1.0, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    on_end = R @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    drops = drop_part(
        part_of(brick), [brick], replace(QUICK, drops=4, height_m=3e-4), R_start=np.array([on_end, R] * 2)
    )
    assert np.abs(drops.R_table_part[:, 2]).argmax(axis=1).tolist() == [0, 2, 0, 2]


def test_as_many_orientations_as_drops_are_needed(brick):
    with pytest.raises(SceneError, match="60 drops need"):
        drop_part(part_of(brick), [brick], QUICK, R_start=np.eye(3)[None])


def test_drops_that_have_no_time_to_settle_are_not_still(brick):
    drops = drop_part(part_of(brick), [brick], replace(QUICK, duration_s=0.05))
    assert not drops.still.any()


def test_a_round_part_on_its_side_comes_to_rest():
    pin = trimesh.creation.cylinder(radius=1e-3, height=8e-3, sections=64)
    drops = drop_part(part_of(pin), [pin], QUICK)
    assert drops.still.mean() > 0.95
    lying = drops.still & (np.abs(drops.R_table_part[:, 2, 2]) < 0.01)
    assert lying.mean() > 0.8


def test_trembling_is_still_and_tipping_is_not():
    config, steps = DropsConfig(), np.arange(50)

    def still(angles, shift=0.0):
        quats = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
        positions = np.zeros((50, 3))
        positions[:, 0] = shift * steps / 49
        return bool(_is_still(positions[None], quats[None], config)[0])

    assert still(0.0 * steps)
    assert still(4e-4 * np.sin(2 * np.pi * steps / 12.5))
    assert not still(8e-4 * steps / 49)
    assert not still(8e-4 * np.sin(2 * np.pi * steps / 12.5))
    assert not still(0.0 * steps, shift=5e-6)


def test_the_built_in_parts_settle_next_to_their_stored_poses():
    part = load_part("inserted")
    drops = drop_part(part, part.hulls, replace(QUICK, seed=5))
    stored = np.array([pose.R_table_part[2] for pose in part.stable_poses])
    angles = np.degrees(np.arccos(np.clip((drops.R_table_part[:, 2] @ stored.T).max(axis=1), -1, 1)))
    assert drops.still.all()
    assert (angles < 0.13).mean() > 0.95


def test_a_part_without_pieces_is_refused(brick):
    with pytest.raises(SceneError, match="no convex pieces"):
        drop_part(part_of(brick), [], QUICK)


@pytest.mark.parametrize(
    "bad",
    [
        {"drops": 0},
        {"seed": -1},
        {"threads": 0},
        {"height_m": 0.0},
        {"drift_rad": -1.0},
        {"stage_s": 3.0},
        {"stage_s": 1e-3},
    ],
)
def test_impossible_settings_are_refused(bad):
    with pytest.raises(SceneError, match=r"drops|seed|height|drift|stage"):
        DropsConfig(**bad)
