"""``tagcell train``: render what is missing, train every network for its share of the time, fit the choice."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

from perception.fit_choice import ChoiceFitConfig, fit_choice
from perception.train import trainer
from scenes.generate import generate
from scenes.recipes import load_recipe
from twin.render_progress import image_progress
from twin.robot import TwinError

DATASETS = ("train_crops", "val_crops", "train_windows", "val_windows", "val_fine")
"""Recipes of the data; ``tagcell train --seed`` shifts their seeds."""

SHARES: dict[str, tuple[str, float]] = {
    "segmentation": ("windows", 0.25),
    "classifier": ("crops", 0.40),
    "verifier": ("crops", 0.13),
    "keypoints": ("crops", 0.22),
}
"""Network -> (data, share of the training time)."""


def train_all(*, data: Path, out: Path, minutes: float, seed: int, threads: int, jobs: int | None = None) -> list[Path]:
    """Weights of every network, and the choice fitted on them, in ``out/weights``; returns their paths.

    Raises SceneError or PerceptionError when a folder holds other data or cannot be written, TwinError for a budget
    that is not positive or a negative seed. What is there already, data and checkpoints, is kept.
    """
    if not minutes > 0:
        raise TwinError(f"minutes is {minutes}; it must be positive")
    if seed < 0:
        raise TwinError(f"seed is {seed}; it must not be negative")
    for name in DATASETS:
        config = load_recipe(name)
        config = replace(config, seed=config.seed + 1000 * seed)
        with image_progress(name) as report:
            generate(config, data / name, jobs=jobs or os.cpu_count() or 1, report=report)
    written = []
    for name, (kind, share) in SHARES.items():
        train = trainer(name)
        train(
            get_type_hints(train)["config"](
                data=data / f"train_{kind}",
                val=data / f"val_{kind}",
                out=out / "weights",
                minutes=minutes * share,
                threads=threads,
                seed=seed,
            )
        )
        written.append(out / "weights" / f"{name}.safetensors")
    fit_choice(ChoiceFitConfig(data=data / "val_fine", out=out / "weights"))
    return [*written, out / "weights" / "choice.json"]
