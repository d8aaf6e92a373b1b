"""Training of the three crop networks: classifier, verifier and keypoints.

``python -m perception.train classifier --data DIR --val DIR --minutes M --out DIR``; likewise ``verifier`` and
``keypoints``. All three see the same crops, each turned by any angle every time it is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from perception.augment import CROP, Photometric, crop_warp, warp_image
from perception.bop_files import manifest_hash
from perception.classifier import JointClassifier, SoftLabels, classifier_loss
from perception.dataset import CropSet, load_crops
from perception.faces import FaceTable
from perception.labels import CropLabels, label_crops, take_crops
from perception.pvnet import GRID, PVNet, pvnet_loss, sample_cells
from perception.score_crops import score_classifier, score_keypoints, score_verifier
from perception.training import Step, TrainingConfig, TrainingResult, evenly_chosen, seeded, train
from perception.training_pictures import classifier_sheet, keypoints_sheet, save_picture
from perception.verifier import PairSampler, Verifier, listwise, verifier_loss
from perception.weight_files import load_weights, save_weights, weights_metadata

SHIFT_PX = 3.0


@dataclass(frozen=True, kw_only=True)
class CropTrainingConfig(TrainingConfig):
    """Folders with the crops, besides how to train. ``validate`` crops of ``val`` are scored now and then.

    ``parts`` are those that the crops show, the built-in ones by default. ``start`` names a folder with earlier weights
    of the same network and faces to go on from. Of ``data`` no more than ``images`` are learned from, evenly chosen.
    """

    data: tuple[Path, ...]
    val: tuple[Path, ...]
    out: Path = Path("perception/weights")
    parts: tuple[str, ...] = ()
    parts_dir: Path | None = None
    start: Path | None = None
    images: int | None = None
    validate: int = 400

    @cached_property
    def table(self) -> FaceTable:
        """The faces of all parts."""
        return FaceTable.load(self.parts, self.parts_dir)


@dataclass(frozen=True, kw_only=True)
class ClassifierConfig(CropTrainingConfig):
    """J. About 250 crops a second and core; 20 minutes give about 0.94."""

    minutes: float = 30.0
    learning_rate: float = 3e-3
    weight_decay: float = 2e-2
    batch: int = 48


@dataclass(frozen=True, kw_only=True)
class VerifierConfig(CropTrainingConfig):
    """V."""

    minutes: float = 10.0
    weight_decay: float = 2e-2
    batch: int = 32
    seed: int = 1


@dataclass(frozen=True, kw_only=True)
class KeypointsConfig(CropTrainingConfig):
    """Keypoint votes; ``samples`` pixels of each mask enter the loss."""

    minutes: float = 20.0
    batch: int = 32
    samples: int = 192
    seed: int = 2


class CropSource:
    """Draws batches of crops, each turned by a random angle and shifted by a few pixels, with their labels."""

    def __init__(self, crops: CropSet, labels: CropLabels, seed: int) -> None:
        self.crops, self.labels = crops, labels
        self.photometric = Photometric(np.random.default_rng(seed))

    def draw(
        self,
        count: int,
        rng: np.random.Generator,
        with_masks: bool = False,
        rows: NDArray[np.int64] | None = None,
    ) -> tuple[NDArray[np.uint8], CropLabels, NDArray[np.bool_]]:
        """Images (B, 128, 128, 3), labels and, when asked for, masks on the voting grid (B, 64, 64).

        ``rows`` (B,) are the crops to take; random ones when it is left out.
        """
        if rows is None:
            rows = rng.integers(len(self.crops), size=count)
        angles = rng.uniform(0.0, 2 * np.pi, count)
        warps = np.stack([crop_warp(a, rng.uniform(-SHIFT_PX, SHIFT_PX, 2)) for a in angles])
        images = np.stack([warp_image(self.crops.images[r], w) for r, w in zip(rows, warps, strict=True)])
        masks = np.zeros((count, GRID, GRID), dtype=bool)
        if with_masks:
            for i, mask in enumerate(self.crops.masks(rows)):
                turned = cv2.warpAffine(mask.astype(np.float32), warps[i], (CROP, CROP))
                masks[i] = cv2.resize(turned, (GRID, GRID), interpolation=cv2.INTER_AREA) > 0.5
        return images, self.labels.take(rows).warped(warps, angles), masks


def classifier_step(model: JointClassifier, source: CropSource, config: ClassifierConfig) -> Step:
    """One step of J."""
    soft = SoftLabels(config.table)

    def step(rng: np.random.Generator) -> dict[str, Tensor]:
        images, labels, _ = source.draw(config.batch, rng)
        with torch.autocast("cpu", torch.bfloat16):
            logits, centres = model(source.photometric(images, labels.ray, rng))
        target, inside = torch.from_numpy(soft(labels)), torch.from_numpy(soft.within_part(labels))
        return classifier_loss(logits, centres, target, inside, torch.from_numpy(labels.centre.astype(np.float32)))

    return step


def verifier_step(model: Verifier, source: CropSource, config: VerifierConfig) -> Step:
    """One step of V. The crops are not turned first: rectifying them does that."""
    sampler = PairSampler(config.table)

    def step(rng: np.random.Generator) -> dict[str, Tensor]:
        rows = rng.integers(len(source.crops), size=config.batch)
        labels = source.labels.take(rows)
        views, rays, target = sampler(source.crops.images[rows], labels, rng)
        with torch.autocast("cpu", torch.bfloat16):
            logits = model(source.photometric(views, rays, rng))
        log = listwise(logits.reshape(config.batch, 2, -1))
        return verifier_loss(log, torch.from_numpy(target), torch.from_numpy(sampler.within_part(labels)))

    return step


def keypoints_step(model: PVNet, source: CropSource, config: KeypointsConfig) -> Step:
    """One step of the keypoint votes."""

    def step(rng: np.random.Generator) -> dict[str, Tensor]:
        images, labels, masks = source.draw(config.batch, rng, with_masks=True)
        return pvnet_loss(
            model,
            source.photometric(images, labels.ray, rng),
            torch.from_numpy(masks.astype(np.float32)),
            torch.from_numpy(labels.face),
            torch.from_numpy(labels.keypoints.astype(np.float32)),
            torch.from_numpy(sample_cells(masks, config.samples, rng)),
        )

    return step


def train_classifier(config: ClassifierConfig) -> TrainingResult:
    """Train J and write ``classifier.safetensors``."""
    return train_on_crops(
        "classifier",
        config,
        lambda table: JointClassifier(len(table)),
        classifier_step,
        score_classifier,
        draw=classifier_sheet,
    )


def train_verifier(config: VerifierConfig) -> TrainingResult:
    """Train V and write ``verifier.safetensors``."""
    return train_on_crops("verifier", config, lambda table: Verifier(len(table)), verifier_step, score_verifier)


def train_keypoints(config: KeypointsConfig) -> TrainingResult:
    """Train the keypoint votes and write ``keypoints.safetensors``."""
    return train_on_crops("keypoints", config, PVNet.for_table, keypoints_step, score_keypoints, draw=keypoints_sheet)


Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config", bound=CropTrainingConfig)


def train_on_crops(
    name: str,
    config: Config,
    build: Callable[[FaceTable], Network],
    make_step: Callable[[Network, CropSource, Config], Step],
    score: Callable[[Any, CropSet, CropLabels, FaceTable], dict[str, float]],
    draw: Callable[[Any, CropSet, CropLabels, FaceTable], NDArray[np.uint8]] | None = None,
) -> TrainingResult:
    """Load the crops, train one network under the budget, score it on all of ``val`` and write its weights.

    Whenever it is validated, what ``draw`` makes of some crops is kept as ``NAME_predictions.png``.
    """
    table = config.table
    crops, val = load_crops(*config.data), load_crops(*config.val)
    if config.images is not None:
        crops = take_crops(crops, evenly_chosen(len(crops), config.images))
    labels, val_labels = label_crops(table, crops), label_crops(table, val)
    some = np.arange(0, len(val), max(1, len(val) // config.validate))
    some_val, some_labels = take_crops(val, some), val_labels.take(some)
    with seeded(config.seed):
        model = build(table).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    minutes_before = 0.0
    if config.start is not None:
        path = config.start / f"{name}.safetensors"
        state, earlier = load_weights(path, config.parts_dir)
        table.check(earlier["faces"], path.name)
        model.load_state_dict(state)
        minutes_before = earlier["minutes"] + earlier.get("minutes_before_start", 0.0)
    step = make_step(model, CropSource(crops, labels, config.seed), config)

    def validate(now: nn.Module) -> dict[str, float]:
        if draw is not None:
            save_picture(config.out / f"{name}_predictions.png", draw(now, some_val, some_labels, table))
        return score(now, some_val, some_labels, table)

    result = train(name, model, step, config, config.out, validate=validate)
    model.load_state_dict(result.state_dict)
    figures = score(model.eval(), val, val_labels, table)
    data = {path.name: manifest_hash(path) for path in (*config.data, *config.val)}
    names = [part.name for part in table.parts]
    metadata = weights_metadata(names, config, result, data, figures, config.parts_dir)
    metadata |= {"faces": table.describe(), "minutes_before_start": minutes_before}
    save_weights(config.out / f"{name}.safetensors", result.state_dict, metadata)
    return result
