"""``tagcell train``: render what is missing, train every network for its share of the time, fit the choice."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

from perception.fit_choice import ChoiceFitConfig, fit_choice
from perception.train import trainer
from scenes.dataset_config import DatasetConfig
from scenes.generate import generate
from twin.robot import TwinError

HALF_CROPS: dict[str, Any] = {"kind": "crop", "size": (128, 128), "downscale": 2, "faces": "uniform"}
"""What the crop networks see: 128 x 128 pixels at half the camera's resolution, every face as often."""

DATASETS: dict[str, DatasetConfig] = {
    "crops_train": DatasetConfig(**HALF_CROPS, split="train", count=20_000, seed=1),
    "crops_val": DatasetConfig(**HALF_CROPS, split="val", count=1_500, seed=2),
    "windows_train": DatasetConfig(kind="window", faces="uniform", split="train", count=4_000, seed=3),
    "windows_val": DatasetConfig(kind="window", faces="uniform", split="val", count=200, seed=4),
    "fine_val": DatasetConfig(kind="crop", faces="uniform", split="val", count=1_200, seed=5),
}
"""What the committed weights were trained on; ``tagcell train --seed`` shifts the seeds."""

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
    for name, config in DATASETS.items():
        generate(replace(config, seed=config.seed + 1000 * seed), data / name, jobs=jobs or os.cpu_count() or 1)
    written = []
    for name, (kind, share) in SHARES.items():
        train = trainer(name)
        train(
            get_type_hints(train)["config"](
                data=data / f"{kind}_train",
                val=data / f"{kind}_val",
                out=out / "weights",
                minutes=minutes * share,
                threads=threads,
                seed=seed,
            )
        )
        written.append(out / "weights" / f"{name}.safetensors")
    fit_choice(ChoiceFitConfig(data=data / "fine_val", out=out / "weights"))
    return [*written, out / "weights" / "choice.json"]
