"""train, val and test share nothing: no stream of random numbers, no background, and test no light or distance."""

from itertools import combinations, product
from typing import get_args

import pytest
from drawn_shots import SCENE

from scenes.environments import make_environments
from scenes.image_maker import ENVIRONMENTS, STREAMS, TEXTURES, WORN_TAGS, backgrounds, image_streams
from scenes.randomize import draw_look
from scenes.ranges import LOOKS, VIEWS, Split
from scenes.recipes import load_recipe, recipe_names
from scenes.shots import SHOTS, ShotSampler
from scenes.textures import make_textures, make_wear

SPLITS = get_args(Split)
PAIRS = list(combinations(SPLITS, 2))
APART = {
    "look": ("lamp_elevation_deg", "ambient", "texture_repeat", "surroundings_level"),
    "view": ("height_m",),
}
"""Ranges of test that do not meet those of train and val."""


def apart(one, two):
    """Whether two ranges have no value in common."""
    return one[1] < two[0] or two[1] < one[0]


def words(rng):
    """What a stream begins with: two streams that share it are one."""
    return tuple(rng.integers(0, 2**63, 4).tolist())


def test_every_split_has_its_own_streams():
    assert set(STREAMS) == set(SPLITS)
    assert len(set(STREAMS.values())) == len(SPLITS)
    seeds = {load_recipe(name).seed for name in recipe_names()}
    begun = [
        words(stream)
        for split, seed, index in product(SPLITS, sorted(seeds | {0}), range(40))
        for stream in image_streams(split, seed, index)
    ]
    begun += [words(stream) for split in SPLITS for stream in backgrounds(split)]
    assert len(set(begun)) == len(begun)


@pytest.mark.parametrize(
    ("stream", "make", "count"),
    [(0, make_textures, 9), (1, make_environments, 6), (2, make_wear, WORN_TAGS)],
)
def test_no_background_of_one_split_is_one_of_another(stream, make, count):
    made = {split: [image.tobytes() for image in make(backgrounds(split)[stream], count)] for split in SPLITS}
    for split in SPLITS:
        assert len(made[split]) == count
    for one, two in PAIRS:
        assert not set(made[one]) & set(made[two])


@pytest.mark.parametrize("other", ["train", "val"])
def test_ranges_of_test_do_not_meet_the_others(other):
    for group, ranges in (("look", LOOKS), ("view", VIEWS)):
        for name in APART[group]:
            assert apart(getattr(ranges["test"], name), getattr(ranges[other], name)), name


@pytest.mark.parametrize("name", recipe_names())
def test_recipes_keep_the_ranges_of_their_split_apart(name):
    config = load_recipe(name)
    others = [split for split in SPLITS if (split == "test") != (config.split == "test")]
    for split in others:
        for field in APART["look"]:
            assert apart(getattr(config.look_ranges, field), getattr(LOOKS[split], field)), field
        for field in APART["view"]:
            assert apart(getattr(config.view_ranges, field), getattr(VIEWS[split], field)), field


def test_lights_and_distances_that_are_drawn_for_test_are_never_drawn_for_the_others():
    drawn = {}
    for split in SPLITS:
        looks = [
            draw_look(LOOKS[split], TEXTURES, image_streams(split, 3, index)[1], environments=ENVIRONMENTS)
            for index in range(200)
        ]
        elevations = [lamp.towards[2] for look in looks for lamp in look.lamps]
        ambients = [look.ambient for look in looks]
        drawn[split] = (min(elevations), max(elevations)), (min(ambients), max(ambients))
    for other in ("train", "val"):
        assert all(apart(one, two) for one, two in zip(drawn["test"], drawn[other], strict=True))


def test_no_pose_of_a_camera_or_part_comes_twice(pool):
    """The same seed and number in each split; train and val draw from the same ranges."""
    seen = {}
    for split in SPLITS:
        sampler = ShotSampler(pool, SHOTS[split], VIEWS[split])
        shots = [sampler.frame(image_streams(split, 7, index)[0], SCENE.frame, SCENE.scale_down) for index in range(25)]
        cameras = {shot.T_board_cam.tobytes() for shot in shots}
        parts = {placed.T_board_object.tobytes() for shot in shots for placed in shot.parts}
        assert len(cameras) == 25 and len(parts) == sum(len(shot.parts) for shot in shots)
        seen[split] = cameras | parts
    for one, two in PAIRS:
        assert not seen[one] & seen[two]
