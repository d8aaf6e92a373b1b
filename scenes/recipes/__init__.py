"""Data sets by name: each a JSON file with the config that differs from the defaults, its seed among it.

A user's own file may do the same, ranges included: ``{"kind": "crop", "seed": 3, "lens": {"k1": [-0.1, 0.0]}}``. What a
group of ranges does not name stays as the split has it.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.ranges import LOOKS, VIEWS, LensRanges, SensorRanges
from scenes.shots import SHOTS

ABOUT = "about"


def recipe_names() -> list[str]:
    """Names of all recipes, sorted."""
    files = resources.files(__name__).iterdir()
    return sorted(file.name.removesuffix(".json") for file in files if file.name.endswith(".json"))


def recipe(name: str) -> dict[str, Any]:
    """What a recipe says, by the names of :class:`DatasetConfig`'s fields; ``about`` says what it is for.

    ``name`` is one of the recipes', or a path that ends in ``.json``. Raises SceneError when there is no such recipe or
    it cannot be read.
    """
    if name not in recipe_names() and not name.endswith(".json"):
        raise SceneError(f"recipe {name!r} is not one of {', '.join(recipe_names())}, nor a file that ends in .json")
    file = Path(name) if name.endswith(".json") else resources.files(__name__) / f"{name}.json"
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise SceneError(f"recipe {name} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise SceneError(f"recipe {name} must be a JSON object of settings")
    return {key: _tuple(value) for key, value in content.items()}


def load_recipe(name: str) -> DatasetConfig:
    """The config of a recipe; raises SceneError where there is none or it does not make one."""
    said = {key: value for key, value in recipe(name).items() if key != ABOUT}
    _refuse_unknown(f"recipe {name}", said, DatasetConfig)
    split = said.get("split", DatasetConfig.split)
    bases = {
        "look": LOOKS,
        "shots": SHOTS,
        "view": VIEWS,
        "sensor": {split: SensorRanges()},
        "lens": {split: LensRanges()},
    }
    for key, base in bases.items():
        if key in said and split in base:
            if not isinstance(said[key], dict):
                raise SceneError(f"{key} of recipe {name} must be a JSON object of ranges")
            _refuse_unknown(f"{key} of recipe {name}", said[key], type(base[split]))
            said[key] = replace(base[split], **{field: _tuple(value) for field, value in said[key].items()})
    try:
        return DatasetConfig(**said)
    except TypeError as error:
        raise SceneError(f"recipe {name} holds a value of the wrong type: {error}") from error


def _refuse_unknown(where: str, said: dict[str, Any], kind: type) -> None:
    valid = [field.name for field in fields(kind)]
    for key in said:
        if key not in valid:
            raise SceneError(f"{key!r} in {where} is not one of {', '.join(valid)}")


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
