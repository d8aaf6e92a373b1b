"""``tagcell train``: render what is missing, train every network for its share of the time, fit the choice."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from perception.estimates import PerceptionError
from perception.train import trainer
from perception.weight_files import trained_with
from scenes.dataset_config import DatasetConfig
from scenes.generate import generate
from scenes.recipes import load_recipe
from twin.render_progress import image_progress
from twin.robot import TwinError
from twin.training_lanes import run_lanes

FULL_DATA_MINUTES = 60.0
"""Training time that asks for all of the data that the recipes make; shorter runs get by with a share of it."""
LEAST_DATA = 0.25

TRAINING_DATA = (
    "train_windows",
    "train_windows_filament",
    "train_windows_hard",
    "train_crops",
    "train_crops_filament",
    "train_crops_hard",
    "train_crops_none",
    "train_crops_none_filament",
)
VALIDATION_DATA = (
    "val_windows",
    "val_windows_filament",
    "val_crops",
    "val_crops_filament",
    "val_frames",
    "val_frames_filament",
    "val_frames_hard",
)
"""Recipes of the data; ``seed`` shifts their seeds."""

WITH_PARTS = ("train_crops", "train_crops_filament", "train_crops_hard")
ALL_CROPS = (*WITH_PARTS, "train_crops_none", "train_crops_none_filament")
VAL_CROPS = ("val_crops", "val_crops_filament")
VAL_FRAMES = ("val_frames", "val_frames_filament", "val_frames_hard")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A network, the data sets that it learns from and is validated on, and its share of its lane's time."""

    network: str
    data: tuple[str, ...]
    val: tuple[str, ...]
    share: float


LANES: tuple[tuple[Job, ...], ...] = (
    (
        Job(
            network="segmentation",
            data=("train_windows", "train_windows_filament", "train_windows_hard"),
            val=("val_windows", "val_windows_filament"),
            share=1.0,
        ),
    ),
    (
        Job(network="classifier", data=ALL_CROPS, val=VAL_CROPS, share=0.52),
        Job(network="verifier", data=ALL_CROPS, val=VAL_CROPS, share=0.30),
        Job(network="keypoints", data=WITH_PARTS, val=VAL_CROPS, share=0.18),
    ),
)
"""What is trained one after the other; two lanes on a thread each learn more than one on two."""


@dataclass(frozen=True, kw_only=True)
class TrainPlan:
    """``minutes`` is the time that the networks learn for; rendering and fitting the choice come on top.

    ``parts`` are those to learn, the built-in ones by default, looked for in ``parts_dir`` first. ``threads`` of the
    processor are used. ``seed`` is that of data and training.
    """

    data: Path
    out: Path
    minutes: float
    seed: int = 0
    threads: int = os.cpu_count() or 1
    parts: tuple[str, ...] = ()
    parts_dir: Path | None = None

    def __post_init__(self) -> None:
        if not self.minutes > 0:
            raise TwinError(f"minutes is {self.minutes}; it must be positive")
        if self.seed < 0:
            raise TwinError(f"seed is {self.seed}; it must not be negative")
        if self.threads < 1:
            raise TwinError(f"threads is {self.threads}; it must be at least 1")

    @property
    def weights(self) -> Path:
        """Where the weights go."""
        return self.out / "weights"

    def dataset(self, name: str) -> DatasetConfig:
        """The config of a data set; those for training are smaller in a short run."""
        config = load_recipe(name)
        share = min(1.0, max(LEAST_DATA, self.minutes / FULL_DATA_MINUTES)) if name in TRAINING_DATA else 1.0
        assert config.count is not None
        return replace(
            config,
            count=max(1, round(config.count * share)),
            seed=config.seed + 1000 * self.seed,
            parts=self.parts,
            parts_dir=self.parts_dir,
        )


def train_all(plan: TrainPlan) -> list[Path]:
    """Weights of every network, and the choice fitted on them, in ``plan.weights``; returns their paths.

    Raises SceneError or PerceptionError when a folder holds other data or cannot be written. What is there already,
    data, checkpoints and networks that finished, is kept.
    """
    for name in (*TRAINING_DATA, *VALIDATION_DATA):
        with image_progress(name) as report:
            generate(plan.dataset(name), plan.data / name, jobs=plan.threads, report=report)
    lanes = [[(job.network, settings(plan, job)) for job in lane] for lane in LANES]
    run_lanes(lanes, at_once=plan.threads)
    choice = trainer("choice")
    choice(
        get_type_hints(choice)["config"](
            data=tuple(plan.data / name for name in VAL_FRAMES),
            out=plan.weights,
            parts_dir=plan.parts_dir,
            jobs=plan.threads,
        )
    )
    networks = [plan.weights / f"{job.network}.safetensors" for lane in LANES for job in lane]
    return [*networks, plan.weights / "choice.json"]


def settings(plan: TrainPlan, job: Job) -> dict[str, Any]:
    """What a network's config is made of."""
    lanes_at_once = min(plan.threads, len(LANES))
    return {
        "data": tuple(plan.data / name for name in job.data),
        "val": tuple(plan.data / name for name in job.val),
        "out": plan.weights,
        "parts": plan.parts,
        "parts_dir": plan.parts_dir,
        "minutes": plan.minutes * job.share * lanes_at_once / len(LANES),
        "threads": max(1, plan.threads // len(LANES)),
        "seed": plan.seed,
    }


def train_network(network: str, said: dict[str, Any]) -> None:
    """Train one network as ``settings`` says, unless its weights are there already."""
    train = trainer(network)
    config = get_type_hints(train)["config"](**said)
    path = config.out / f"{network}.safetensors"
    if path.exists() and trained_with(path, config):
        print(f"{network}: {path} is there already", flush=True)
        return
    try:
        train(config)
    except (PerceptionError, OSError) as error:
        raise TwinError(f"training {network}: {error}") from error
