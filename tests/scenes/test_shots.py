from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.stats import binom

from cad.collision import contact_pieces
from cad.parts import load_part, part_names, planar
from cad.resting import nearest_rest
from cad.spatial import BASLER, Intrinsics, apply, inverse, transform
from scenes.cell_config import CellConfig
from scenes.dataset_config import DatasetConfig
from scenes.distractors import CRUMB, distractor_meshes, distractors
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.layout import Shelf
from scenes.ranges import TEST_VIEW, TRAIN_VIEW
from scenes.rests import RestPool
from scenes.shots import SHOTS, TEST_SHOTS, TRAIN_SHOTS, ShotRanges, ShotSampler, board_point
from scenes.touching import TOUCH_M, Slider
from scenes.workcell import build_board_scene, part_body, set_parts

CELL = CellConfig()
TOUCHING = replace(
    TEST_SHOTS, touching=1.0, close=0.0, neighbours=(0.0, 1.0), crop_distractors=(1.0,), crop_crumbs=(0, 0)
)
SCENE = DatasetConfig(kind="scene")


@pytest.fixture(scope="module")
def parts():
    return {name: load_part(name) for name in part_names()}


@pytest.fixture(scope="module")
def pool(parts):
    return RestPool.make(list(parts.values()))


@pytest.fixture(scope="module")
def sampler(pool):
    return ShotSampler(pool)


@pytest.fixture(scope="module")
def slider(parts):
    return Slider(
        {name: contact_pieces(part, "grasp") for name, part in parts.items()}
        | {name: thing.pieces for name, thing in distractors().items()}
    )


def shots(draw, count, seed=0):
    rng = np.random.default_rng(seed)
    return [draw(rng) for _ in range(count)]


def frames(sampler, count, seed=0, config=SCENE):
    return shots(lambda rng: sampler.frame(rng, config.frame, config.scale_down), count, seed)


def footprint(placed, parts):
    """Centre (2,) of a thing's bounding rectangle seen from above, and radius of the circle round it."""
    if placed.stable_pose < 0:
        return placed.T_board_object[:2, 3], distractors()[placed.name].radius_m
    corners = apply(placed.T_board_object, parts[placed.name].mesh.convex_hull.vertices)[:, :2]
    centre = (placed.T_board_object @ inverse(rest_of(placed, parts)))[:2, 3]
    return centre, np.linalg.norm(corners - centre, axis=1).max()


def rest_of(placed, parts):
    """The stable pose that a part lies in; a lean of a tenth of a degree moves its footprint by micrometres."""
    return parts[placed.name].stable_poses[placed.stable_pose].T_table_part


def gaps(shot, slider, within=0.02):
    """Distance in m of every pair of things that are near each other."""
    things = [*shot.parts, *shot.distractors]
    for a, b in combinations(things, 2):
        if np.linalg.norm((a.T_board_object - b.T_board_object)[:2, 3]) < within:
            yield a, b, slider.distance((a.name, a.T_board_object), (b.name, b.T_board_object))


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


def test_things_keep_their_distance_unless_they_are_pushed_together(pool, parts, slider):
    ranges = replace(TRAIN_SHOTS, touching=0.0, close=0.0)
    sampler = ShotSampler(pool, ranges)
    for shot in [*shots(sampler.crop, 150), *shots(sampler.window, 40), *frames(sampler, 10)]:
        circles = [footprint(placed, parts) for placed in (*shot.parts, *shot.distractors)]
        for (a, r), (b, s) in combinations(circles, 2):
            assert np.linalg.norm(a - b) > r + s + ranges.gap_m[0] - 1e-4
    for sampler, ranges in ((ShotSampler(pool), TRAIN_SHOTS), (ShotSampler(pool, TEST_SHOTS), TEST_SHOTS)):
        apart = [gap for shot in shots(sampler.crop, 150) for _, _, gap in gaps(shot, slider)]
        assert min(apart) > 0.9 * TOUCH_M
        kinds = Counter(
            "touching" if gap < 3e-5 else "close" if gap < ranges.close_gap_m[1] else "apart" for gap in apart
        )
        assert kinds["touching"] > 0 and kinds["close"] > 0 and kinds["apart"] > 0
        assert not any(3e-5 < gap < ranges.close_gap_m[0] for gap in apart)


def test_test_shots_hold_more_that_touches_than_training_shots(pool, slider):
    def share(ranges):
        crops = [list(gaps(shot, slider)) for shot in shots(ShotSampler(pool, ranges).crop, 300)]
        return np.mean([any(gap < 3e-5 for *_, gap in crop) for crop in crops])

    assert share(TEST_SHOTS) > 1.5 * share(TRAIN_SHOTS) > 0


def test_what_is_pushed_together_touches_and_overlaps_nothing(pool, slider):
    touched = 0
    for shot in shots(ShotSampler(pool, TOUCHING).crop, 150):
        for _, _, gap in gaps(shot, slider):
            assert -1e-6 < gap <= 3e-5
            touched += 1
    assert touched > 50


def test_touching_parts_stay_where_they_are(pool):
    pairs = [
        shot.parts for shot in shots(ShotSampler(pool, TOUCHING, faces="uniform").crop, 30) if len(shot.parts) == 2
    ]
    for first, second in pairs[:12]:
        names, placed = (first.name, second.name), np.array([first.T_board_object, second.T_board_object])
        model = build_board_scene(CELL, names).compile()
        data = mujoco.MjData(model)
        set_parts(model, data, CELL.T_world_board @ placed)
        mujoco.mj_step(model, data, round(0.3 / model.opt.timestep))
        for i in range(2):
            body = model.body(part_body(i)).id
            T = inverse(CELL.T_world_board) @ transform(data.xmat[body].reshape(3, 3), data.xpos[body])
            assert np.linalg.norm(T[:3, 3] - placed[i, :3, 3]) < 20e-6


@pytest.mark.parametrize("gap_m", [TOUCH_M, 1e-3])
def test_a_slide_ends_at_the_gap_and_passes_what_is_not_in_its_way(slider, pool, parts, gap_m):
    rng = np.random.default_rng(5)
    for _ in range(40):
        a, b = rng.choice(list(parts), 2)
        T_a, T_b = (pool.draw(parts[name], "uniform", rng).T_table_part for name in (a, b))
        T_a, T_b = planar(-0.03, rng.uniform(-4e-3, 4e-3), rng.uniform(-3, 3)) @ T_a, planar(0, 0, 1.0) @ T_b
        travel = slider.travel((a, T_a), (b, T_b), np.array([1.0, 0.0]), gap_m)
        if travel is None:
            continue
        gap = slider.distance((a, planar(travel, 0, 0) @ T_a), (b, T_b))
        assert gap_m - 1e-7 < gap < gap_m + 1.1e-5
    assert slider.travel((a, planar(-0.03, 0.02, 0.0) @ T_a), (b, T_b), np.array([1.0, 0.0])) is None


def test_a_slide_of_boxes_is_exact(slider):
    """Two blocks, 9 x 7 and 5 x 4 mm, with faces parallel; and the second turned by 45 degrees, corner first."""
    far = planar(-0.05, 0, 0)
    direction = np.array([1.0, 0.0])
    flat = slider.travel(("block_1", far), ("block_0", np.eye(4)), direction)
    assert flat == pytest.approx(0.05 - 4.5e-3 - 2.5e-3, abs=1.3e-5)
    corner = slider.travel(("block_1", far @ planar(0, 0, np.pi / 4)), ("block_0", np.eye(4)), direction)
    assert corner == pytest.approx(0.05 - 4.5e-3 - np.sqrt(0.5) * 4.5e-3, abs=1.3e-5)


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


def test_without_distractors_there_are_none(pool):
    sampler = ShotSampler(pool, others={})
    assert not any(shot.distractors for shot in [*shots(sampler.crop, 30), *frames(sampler, 3)])


def test_distractors_stand_steadily_on_the_board():
    for thing in distractors().values():
        low = thing.mesh.bounds[0, 2]
        assert abs(low) < 1e-9
        assert thing.mesh.extents.max() < 0.025
        corners = np.concatenate([piece.vertices for piece in thing.pieces])
        sides = ConvexHull(corners[corners[:, 2] < 1e-6, :2]).equations
        volumes = np.array([piece.volume for piece in thing.pieces])
        centre = volumes @ [piece.center_mass for piece in thing.pieces] / volumes.sum()
        assert (sides[:, :2] @ centre[:2] + sides[:, 2] < -5e-6).all(), thing.name


def test_the_pieces_of_a_distractor_hold_what_is_drawn():
    for thing in distractors().values():
        drawn, pieces = thing.mesh.bounds, np.array([piece.bounds for piece in thing.pieces])
        held = np.array([pieces[:, 0].min(axis=0), pieces[:, 1].max(axis=0)])
        np.testing.assert_allclose(drawn, held, atol=6e-5, err_msg=thing.name)
        assert all(piece.is_convex for piece in thing.pieces), thing.name


def test_distractors_are_of_many_kinds_and_always_the_same():
    kinds = Counter(thing.kind for thing in distractors().values())
    assert len(kinds) >= 20
    assert {"screw", "nut", "washer", "chip", "wire", "coin", "paper", "ring", "channel", CRUMB} <= kinds.keys()
    assert list(distractor_meshes()) == list(distractors())


def test_a_distractor_that_could_be_a_part_is_left_out(parts):
    block = distractors()["block_0"]
    part = replace(parts["main"], name="block", mesh=block.mesh)
    assert block.resembles(part)
    assert not any(thing.resembles(parts[name]) for thing in distractors().values() for name in parts)
    pool = RestPool.make([parts["main"]])
    pool.parts = (part,)
    assert "block_0" not in Shelf(pool, distractors()).distractors


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
    ],
)
def test_impossible_settings_are_refused(bad):
    with pytest.raises(SceneError, match=next(iter(bad))):
        ShotRanges(**bad)
