"""Data sets by name."""

from dataclasses import replace

import pytest

from scenes.dataset_config import DatasetConfig
from scenes.domains import DOMAINS
from scenes.errors import SceneError
from scenes.ranges import LOOKS
from scenes.recipes import load_recipe, recipe, recipe_names


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_is_a_config_and_says_what_it_is_for(name):
    assert isinstance(load_recipe(name), DatasetConfig)
    assert len(recipe(name)["about"]) > 20


@pytest.mark.parametrize("domain", DOMAINS)
def test_each_domain_has_its_test_sets(domain):
    crops, frames = load_recipe(f"test_crops_{domain}"), load_recipe(f"test_frames_{domain}")
    assert (crops.kind, crops.count, crops.pixels) == ("crop", 2000, (256, 256))
    assert (frames.kind, frames.count) == ("scene", 200)
    assert {crops.domain, frames.domain} == {domain}
    assert {crops.split, frames.split} == {"test"}


def test_recipes_of_one_split_and_kind_do_not_share_images_within_a_domain():
    keys = [(c.split, c.seed, c.domain, c.kind) for c in map(load_recipe, recipe_names())]
    assert len(set(keys)) == len(keys)


def test_an_unknown_recipe_is_named_with_the_known_ones():
    with pytest.raises(SceneError, match=r"'cake' is not one of .*train_crops"):
        load_recipe("cake")


def test_a_file_of_ones_own_changes_ranges_and_leaves_the_others_as_the_split_has_them(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(
        '{"kind": "crop", "split": "test", "seed": 3, "lens": {"k1": [-0.1, 0.0]}, "look": {"lamps": [1, 1]}}'
    )
    config = load_recipe(str(path))
    assert config.lens.k1 == (-0.1, 0.0)
    assert config.look_ranges == replace(LOOKS["test"], lamps=(1, 1))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "cannot be read"),
        ("[1]", "must be a JSON object"),
        ('{"colour": 3}', "'colour' in recipe"),
        ('{"look": {"colour": 3}}', "'colour' in look of recipe .* is not one of default_look, "),
        ('{"lens": 3}', "lens of recipe .* must be a JSON object of ranges"),
        ('{"lens": {"k1": [0.2, 0.1]}}', "k1"),
        ('{"count": "many"}', "wrong type"),
        ('{"kind": "movie"}', "kind 'movie' is not one of"),
    ],
)
def test_a_file_that_makes_no_data_set_is_refused_with_what_is_wrong(content, says, tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(content)
    with pytest.raises(SceneError, match=says):
        load_recipe(str(path))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"none\.json cannot be read"):
        load_recipe(str(tmp_path / "none.json"))
