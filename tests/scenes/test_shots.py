from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from drawn_shots import SCENE, footprint, frames, shots
from scipy.stats import binom

from cad.resting import nearest_rest
from cad.spatial import BASLER, Intrinsics, apply, inverse, transform
from scenes.cell_config import CellConfig
from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.ranges import TEST_VIEW, TRAIN_VIEW
from scenes.shots import SHOTS, TEST_SHOTS, TRAIN_SHOTS, ShotRanges, ShotSampler, board_point

CELL = CellConfig()


@pytest.fixture(scope="module")
def sampler(pool):
    return ShotSampler(pool)


@pytest.mark.parametrize("faces", ["physics", "uniform"])
def test_targets_lie_on_faces_as_often_as_they_should(pool, parts, faces):
    drawn = Counter()
    for shot in shots(ShotSampler(pool, faces=faces, others={}).crop, 2000):
        if shot.parts:
            drawn[shot.parts[0].name, shot.parts[0].stable_pose] += 1
    total = drawn.total()
    assert binom.interval(0.9999, 2000, TRAIN_SHOTS.target_share)[0] <= total
    assert total <= binom.interval(0.9999, 2000, TRAIN_SHOTS.target_share)[1]
    for part in parts.values():
        listed = sum(pose.probability for pose in part.stable_poses)
        for pose in part.stable_poses:
            on_face = pose.probability / listed if faces == "physics" else 1 / len(part.stable_poses)
            low, high = binom.interval(0.9999, total, on_face / len(parts))
            assert low <= drawn[part.name, pose.index] <= high


def test_the_stable_pose_of_a_part_is_the_one_it_lies_in(sampler, parts):
    for shot in frames(sampler, 10):
        for placed in shot.parts:
            pose, leaning = nearest_rest(parts[placed.name], placed.T_board_object[:3, :3])
            assert pose.index == placed.stable_pose
            assert leaning < np.radians(1.0 + TRAIN_SHOTS.dust_lean_deg[1])


def test_parts_lie_on_the_board(sampler, pool, parts):
    for ranges, deepest in ((TRAIN_SHOTS, 5e-6), (TEST_SHOTS, 5e-6)):
        for shot in frames(ShotSampler(pool, ranges), 10):
            for placed in shot.parts:
                lowest = apply(placed.T_board_object, parts[placed.name].mesh.vertices)[:, 2].min()
                assert -deepest < lowest < 1e-6


def test_dust_tilts_parts_a_little_and_never_in_the_test_split(pool, parts):
    def leans(ranges):
        return [
            min(np.linalg.norm(placed.T_board_object[2, :3] - T[2, :3]) for T in pool.rests[placed.name].T_table_part)
            for shot in frames(ShotSampler(pool, ranges), 5)
            for placed in shot.parts
        ]

    assert max(leans(TEST_SHOTS)) < 1e-12
    high = np.radians(TRAIN_SHOTS.dust_lean_deg[1])
    assert high / 2 < max(leans(TRAIN_SHOTS)) <= high + 1e-12


def test_the_target_of_a_crop_is_the_first_part_and_near_the_middle(sampler, parts):
    for size, downscale in (((256, 256), 1), ((128, 128), 2), ((96, 64), 3)):
        for shot in shots(lambda rng, size=size, downscale=downscale: sampler.crop(rng, size, downscale), 60):
            assert (shot.intrinsics.width, shot.intrinsics.height) == size
            assert shot.downscale == downscale
            if not shot.parts:
                continue
            x, y = footprint(shot.parts[0], parts)[0]
            np.testing.assert_allclose(shot.focus_board, (x, y), atol=2e-5)
            off = (
                shot.intrinsics.project(apply(inverse(shot.T_board_cam), [*shot.focus_board, 0.0])) - np.array(size) / 2
            )
            assert np.abs(off).max() <= (TRAIN_SHOTS.centre_jitter_px + 1) / downscale + 1


def test_windows_lie_in_the_frame(sampler):
    quarter = BASLER.downscaled(4)
    for shot in shots(sampler.window, 50):
        x0, y0 = quarter.cx - shot.intrinsics.cx, quarter.cy - shot.intrinsics.cy
        assert 0 <= x0 <= quarter.width - 320
        assert 0 <= y0 <= quarter.height - 320
        p_cam = apply(inverse(shot.T_board_cam), [*shot.focus_board, 0.0])
        np.testing.assert_allclose(shot.intrinsics.project(p_cam), 160.0, atol=1e-6)


def test_the_border_of_a_window_cuts_some_parts(sampler, parts):
    cut = whole = 0
    for shot in shots(sampler.window, 60):
        for placed in shot.parts:
            corners = apply(placed.T_board_object, parts[placed.name].mesh.vertices)
            uv = shot.intrinsics.project(apply(inverse(shot.T_board_cam), corners))
            inside = ((uv > -0.5) & (uv < 319.5)).all(axis=1)
            cut, whole = cut + (inside.any() and not inside.all()), whole + inside.all()
    assert whole > 3 * cut > 0


@pytest.mark.parametrize("size", [(2208, 1242), (5472, 3648), (640, 640), (400, 120)])
def test_frames_of_any_size_show_every_part(pool, parts, size):
    config = replace(SCENE, size=size)
    few = size == (400, 120)
    for shot in frames(ShotSampler(pool, TEST_SHOTS, TEST_VIEW), 12, config=config):
        assert (shot.intrinsics.width, shot.intrinsics.height) == size
        low, high = TEST_SHOTS.scene_parts
        assert (0 if few else low) <= len(shot.parts) <= high
        for placed in shot.parts:
            centre = apply(inverse(shot.T_board_cam), [*footprint(placed, parts)[0], 0.0])
            u, v = shot.intrinsics.project(centre)
            assert -1 <= u <= size[0] and -1 <= v <= size[1]


@pytest.mark.parametrize("ranges", [TRAIN_SHOTS, TEST_SHOTS, replace(TRAIN_SHOTS, area_half_m=(0.02, 0.02))])
def test_parts_lie_in_their_area_and_distractors_on_the_plate(pool, parts, ranges):
    sampler = ShotSampler(pool, ranges)
    half = np.array([CELL.tagboard.width_m, CELL.tagboard.height_m]) / 2
    for shot in [*frames(sampler, 10), *shots(sampler.crop, 100), *shots(sampler.window, 30)]:
        for placed in shot.parts:
            assert (np.abs(footprint(placed, parts)[0]) <= np.array(ranges.area_half_m) + 2e-5).all()
        for placed in shot.distractors:
            centre, radius = footprint(placed, parts)
            assert (np.abs(centre) + radius <= half + 1e-12).all()


@pytest.mark.parametrize("kind", ["crop", "window", "frame"])
def test_the_same_seed_gives_the_same_shots(pool, kind):
    def drawn(seed):
        sampler = ShotSampler(pool, TEST_SHOTS)
        return frames(sampler, 3, seed) if kind == "frame" else shots(getattr(sampler, kind), 20, seed)

    one = drawn(7)
    for a, b in zip(one, drawn(7), strict=True):
        np.testing.assert_array_equal(a.T_board_cam, b.T_board_cam)
        assert a.intrinsics == b.intrinsics
        for p, q in zip((*a.parts, *a.distractors), (*b.parts, *b.distractors), strict=True):
            assert (p.name, p.stable_pose) == (q.name, q.stable_pose)
            np.testing.assert_array_equal(p.T_board_object, q.T_board_object)
    assert any((a.T_board_cam != b.T_board_cam).any() for a, b in zip(one, drawn(8), strict=True))


def test_the_splits_differ_in_more_than_the_seed(pool):
    assert SHOTS["train"] is SHOTS["val"] is TRAIN_SHOTS
    assert TEST_VIEW.height_m[0] > TRAIN_VIEW.height_m[1]
    test = DatasetConfig(split="test")
    assert (test.shot_ranges, test.view_ranges) == (TEST_SHOTS, TEST_VIEW)
    heights = [shot.T_board_cam[2, 3] for shot in shots(ShotSampler(pool, TEST_SHOTS, TEST_VIEW).crop, 20)]
    assert min(heights) > TRAIN_VIEW.height_m[1]
    assert max(TEST_SHOTS.dust_lean_deg) == 0 < max(TRAIN_SHOTS.dust_lean_deg)


def test_no_image_holds_more_parts_than_announced_nor_a_distractor_twice(pool):
    sampler = ShotSampler(pool, TEST_SHOTS)
    drawn = (
        (shots(sampler.crop, 200), TEST_SHOTS.most_parts("crop")),
        (shots(sampler.window, 50), TEST_SHOTS.most_parts("window")),
        (frames(sampler, 20), TEST_SHOTS.most_parts("scene")),
    )
    for those, most in drawn:
        assert max(len(shot.parts) for shot in those) <= most
        for shot in those:
            names = [placed.name for placed in shot.distractors]
            assert len(names) == len(set(names))


@pytest.mark.parametrize("touching", [0.0, 0.6])
def test_round_an_empty_middle_parts_keep_their_distance_from_it(pool, parts, touching):
    """Those that are pushed against something may end up farther away, never nearer."""
    low, high = 40, 130
    ranges = replace(
        TRAIN_SHOTS,
        target_share=0.0,
        neighbours=(0.0, 0.5, 0.5),
        touching=touching,
        close=0.0,
        empty_beside_px=(low, high),
    )
    sampler = ShotSampler(pool, ranges)
    distances = []
    for shot in shots(lambda rng: sampler.crop(rng, (128, 128), 2), 60):
        for placed in shot.parts:
            centre = apply(inverse(shot.T_board_cam), [*footprint(placed, parts)[0], 0.0])
            distances.append(2 * np.linalg.norm(shot.intrinsics.project(centre) - 63.5))
    assert len(distances) > 10
    assert low - 1 < min(distances) and (touching or max(distances) < high + 1)


def test_crops_without_parts_beside_their_middle_are_what_they_were(pool):
    """The range draws nothing where it is not given, so data sets may still grow."""
    empty = replace(TRAIN_SHOTS, target_share=0.0)
    beside = replace(empty, empty_beside_px=(40, 130))
    samplers = [ShotSampler(pool, ranges) for ranges in (empty, beside)]
    for seed in range(20):
        one, two = (sampler.crop(np.random.default_rng(seed), (128, 128), 2) for sampler in samplers)
        assert one.parts == () and one.intrinsics == two.intrinsics
        assert [d.name for d in one.distractors] == [d.name for d in two.distractors]


def test_without_distractors_there_are_none(pool):
    sampler = ShotSampler(pool, others={})
    assert not any(shot.distractors for shot in [*shots(sampler.crop, 30), *frames(sampler, 3)])


def test_a_point_of_the_board_is_where_its_pixel_shows_it():
    T_board_cam = transform(np.diag([1.0, -1, -1]), [0.01, 0.02, 0.7])
    camera = Intrinsics(width=100, height=80, fx=500.0, fy=500.0, cx=49.5, cy=39.5)
    x, y = board_point(camera, T_board_cam, (10.0, 70.0))
    np.testing.assert_allclose(camera.project(apply(inverse(T_board_cam), [x, y, 0.0])), [10.0, 70.0])


def test_an_area_beyond_the_boards_middle_is_refused(pool):
    with pytest.raises(SceneError, match="exceeds the board's free middle"):
        ShotSampler(pool, replace(TRAIN_SHOTS, area_half_m=(0.15, 0.05)))


@pytest.mark.parametrize(
    "bad",
    [
        {"area_half_m": (0.0, 0.1)},
        {"gap_m": (0.01, 0.002)},
        {"touching": 0.7, "close": 0.5},
        {"dust_lean_deg": (-0.1, 0.1)},
        {"neighbours": (0.5, 0.4)},
        {"crop_distractors": ()},
        {"target_share": 1.5},
        {"window_parts": (5, 3)},
        {"scene_crumbs": (-1, 3)},
        {"centre_jitter_px": -1},
        {"empty_beside_px": (40, 130)},
        {"empty_beside_px": (0, 10), "target_share": 0.0},
        {"empty_beside_px": (50, 10), "target_share": 0.0},
    ],
)
def test_impossible_settings_are_refused(bad):
    with pytest.raises(SceneError, match=next(iter(bad))):
        ShotRanges(**bad)
