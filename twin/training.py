"""``tagcell train``: render what is missing, train every network for its share of the time, fit the choice."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

from perception.fit_choice import ChoiceFitConfig, fit_choice
from perception.train import trainer
from scenes.generate import DatasetConfig, generate
from twin.robot import TwinError

DATASETS: dict[str, DatasetConfig] = {
    "crops_train": DatasetConfig(kind="crop", split="train", count=20_000, seed=1),
    "crops_val": DatasetConfig(kind="crop", split="val", count=1_500, seed=2),
    "windows_train": DatasetConfig(kind="scene", split="train", count=4_000, seed=3, chunk=250),
    "windows_val": DatasetConfig(kind="scene", split="val", count=200, seed=4, chunk=250),
    "fine_val": DatasetConfig(kind="fine", split="val", count=1_200, seed=5, chunk=300),
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
        generate(_for_run(config, seed, jobs or os.cpu_count() or 1), data / name)
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


def _for_run(config: DatasetConfig, seed: int, jobs: int) -> DatasetConfig:
    return replace(config, seed=config.seed + 1000 * seed, jobs=jobs)
