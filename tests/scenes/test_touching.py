from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from drawn_shots import footprint, frames, shots

from cad.collision import contact_pieces
from cad.parts import planar
from cad.spatial import inverse, transform
from scenes.cell_config import CellConfig
from scenes.distractors import distractors
from scenes.gl import mujoco
from scenes.shots import TEST_SHOTS, TRAIN_SHOTS, ShotSampler
from scenes.touching import TOUCH_M, Slider
from scenes.workcell import build_board_scene, part_body, set_parts

CELL = CellConfig()
TOUCHING = replace(
    TEST_SHOTS, touching=1.0, close=0.0, neighbours=(0.0, 1.0), crop_distractors=(1.0,), crop_crumbs=(0, 0)
)


@pytest.fixture(scope="module")
def slider(parts):
    return Slider(
        {name: contact_pieces(part, "grasp") for name, part in parts.items()}
        | {name: thing.pieces for name, thing in distractors().items()}
    )


def gaps(shot, slider, within=0.02):
    """Distance in m of every pair of things that are near each other."""
    things = [*shot.parts, *shot.distractors]
    for a, b in combinations(things, 2):
        if np.linalg.norm((a.T_board_object - b.T_board_object)[:2, 3]) < within:
            yield a, b, slider.distance((a.name, a.T_board_object), (b.name, b.T_board_object))


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
