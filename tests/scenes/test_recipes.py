"""Data sets by name."""

import pytest

from scenes.dataset_config import DatasetConfig
from scenes.domains import DOMAINS
from scenes.errors import SceneError
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
