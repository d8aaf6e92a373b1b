"""Data sets by name: each a JSON file with the config that differs from the defaults, its seed among it."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError


def recipe_names() -> list[str]:
    """Names of all recipes, sorted."""
    files = resources.files(__name__).iterdir()
    return sorted(file.name.removesuffix(".json") for file in files if file.name.endswith(".json"))


def recipe(name: str) -> dict[str, Any]:
    """What a recipe says, by the names of :class:`DatasetConfig`'s fields; ``about`` says what it is for.

    Raises SceneError for a name that is no recipe.
    """
    if name not in recipe_names():
        raise SceneError(f"recipe {name!r} is not one of {', '.join(recipe_names())}")
    content = json.loads((resources.files(__name__) / f"{name}.json").read_text())
    return {key: tuple(value) if isinstance(value, list) else value for key, value in content.items()}


def load_recipe(name: str) -> DatasetConfig:
    """The config of a recipe; raises SceneError for a name that is no recipe."""
    return DatasetConfig(**{key: value for key, value in recipe(name).items() if key != "about"})
