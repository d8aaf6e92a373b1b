"""Trains the whole-frame segmenter on rendered windows and measures it on windows it has not seen."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.parts import BUILT_IN, load_part
from cad.spatial import Array
from perception.bop_files import manifest_hash
from perception.dataset import load_windows
from perception.layers import default_device
from perception.metrics import DetectionScores, mask_iou, summary
from perception.segmentation import (
    HEAT_STRIDE,
    OFFSET_STRIDE,
    REDUCTION,
    WEIGHTS,
    DecodeConfig,
    Detection,
    Outputs,
    SegmentationNet,
    Segmenter,
    normalise,
    reduced_autocast,
)
from perception.training import Losses, TrainingConfig, evenly_chosen, seeded, train
from perception.training_pictures import save_picture, segmentation_sheet
from perception.weight_files import load_weights, save_weights, weights_metadata
from perception.windows import MIN_VISIBLE_PX, Window, Windows, cut, flip, paste, recolour, warp

NO_CLASS = -100
HEAT_SIGMA_CELLS = 1.1
PICTURED = 6


@dataclass(frozen=True, kw_only=True)
class SegmentationTraining(TrainingConfig):
    """Where the windows are and how they are varied; the rest as in ``TrainingConfig``.

    ``parts`` are those that the windows show, the built-in ones by default. ``start`` names a folder with earlier
    weights to go on from. Of ``data`` no more than ``images`` are learned from, evenly chosen. ``size`` is the side of
    the squares cut from the windows, a multiple of 16, ``warp`` the share of windows that are turned and scaled,
    ``paste`` the mean number of parts of other windows that are tried in free places of one.
    """

    data: tuple[Path, ...]
    val: tuple[Path, ...]
    out: Path = Path("perception/weights")
    parts: tuple[str, ...] = ()
    parts_dir: Path | None = None
    start: Path | None = None
    images: int | None = None
    minutes: float = 16.0
    batch: int = 12
    size: int = 208
    learning_rate: float = 3e-3
    warp: float = 0.4
    paste: float = 2.5
    validate_windows: int = 120


@dataclass(frozen=True)
class Targets:
    """What ``Outputs`` should be."""

    mask: Tensor  # (B, H, W)
    offset_px: Tensor  # (B, 2, H / 2, W / 2)
    foreground: Tensor  # (B, H / 2, W / 2), where offsets count
    heat: Tensor  # (B, H / 4, W / 4)
    classes: Tensor  # (B, H / 4, W / 4), NO_CLASS where there is none


def targets_of(window: Window) -> dict[str, NDArray]:
    """Arrays of one example under the names of ``Targets``. A centre outside the window counts at its border."""
    height, width = window.instances.shape
    area = np.bincount(window.instances.ravel(), minlength=len(window.centres) + 1)
    centres = np.clip(window.centres, 2.0, [width - 3.0, height - 3.0]).reshape(-1, 2)
    offset = np.zeros((2, height // OFFSET_STRIDE, width // OFFSET_STRIDE), np.float32)
    # (H, W) -> blocks (H / 2, 2, W / 2, 2): a block that holds any foreground has an owner
    owner = window.instances.reshape(offset.shape[1], OFFSET_STRIDE, offset.shape[2], OFFSET_STRIDE).max(axis=(1, 3))
    v, u = np.nonzero(owner)
    half = (OFFSET_STRIDE - 1) / 2
    offset[:, v, u] = (centres[owner[v, u] - 1] - np.stack([u, v], axis=1) * OFFSET_STRIDE - half).T
    at = HEAT_STRIDE // 2 - 1
    class_of = np.concatenate([[NO_CLASS], window.classes])
    classes = class_of[window.instances[at::HEAT_STRIDE, at::HEAT_STRIDE]]
    heat = np.zeros((height // HEAT_STRIDE, width // HEAT_STRIDE), np.float32)
    columns, rows = np.arange(heat.shape[1]), np.arange(heat.shape[0])
    for k, (cu, cv) in enumerate(centres):
        if area[k + 1] < MIN_VISIBLE_PX:
            continue
        i, j = (round((c - (HEAT_STRIDE - 1) / 2) / HEAT_STRIDE) for c in (cu, cv))
        i, j = min(max(i, 0), heat.shape[1] - 1), min(max(j, 0), heat.shape[0] - 1)
        squared = (columns[None] - i) ** 2 + (rows[:, None] - j) ** 2
        heat = np.maximum(heat, np.exp(-squared / (2 * HEAT_SIGMA_CELLS**2)).astype(np.float32))
        classes[j, i] = window.classes[k]
    return {
        "mask": (window.instances > 0).astype(np.float32),
        "offset_px": offset,
        "foreground": (owner > 0).astype(np.float32),
        "heat": heat,
        "classes": classes,
    }


def example(
    windows: Windows, chosen: NDArray[np.int64], rng: np.random.Generator, config: SegmentationTraining
) -> Window:
    """A randomly drawn and varied window of those ``chosen`` (M,)."""
    window = windows[int(rng.choice(chosen))]
    for _ in range(rng.poisson(config.paste)):
        window = paste(window, windows[int(rng.choice(chosen))], rng)
    if rng.random() < config.warp:
        window = warp(window, rng)
    window = flip(cut(window, config.size, rng), rng)
    return Window(recolour(window.image, rng), window.instances, window.centres, window.classes)


def batch_of(examples: Sequence[Window], device: torch.device) -> tuple[Tensor, Targets]:
    """Normalised images (B, 3, H, W) and their targets."""
    images = torch.from_numpy(np.stack([normalise(e.image) for e in examples])).permute(0, 3, 1, 2)
    arrays = [targets_of(e) for e in examples]
    targets = Targets(**{key: torch.from_numpy(np.stack([a[key] for a in arrays])).to(device) for key in arrays[0]})
    return images.to(device).contiguous(memory_format=torch.channels_last), targets


def losses(outputs: Outputs, targets: Targets) -> Losses:
    """Weighted loss terms: mask BCE and Dice, offsets on the foreground, penalty-reduced focal heat, classes."""
    mask = targets.mask
    cross_entropy = functional.binary_cross_entropy_with_logits(outputs.mask, mask, reduction="none")
    probability = outputs.mask.sigmoid()
    overlap = (probability * mask).sum((1, 2))
    dice = 1 - (2 * overlap + 20) / (probability.sum((1, 2)) + mask.sum((1, 2)) + 20)
    distance = functional.smooth_l1_loss(outputs.offset_px, targets.offset_px, reduction="none").sum(1)
    return {
        "mask": 3.0 * (cross_entropy * (1 + mask)).mean(),
        "dice": dice.mean(),
        "offset": 0.15 * (distance * targets.foreground).sum() / (targets.foreground.sum() + 50),
        "heat": focal(outputs.heat, targets.heat),
        "class": 0.3 * functional.cross_entropy(outputs.classes, targets.classes, ignore_index=NO_CLASS)
        if bool((targets.classes != NO_CLASS).any())
        else 0.0 * outputs.classes.sum(),
    }


def focal(logits: Tensor, heat: Tensor) -> Tensor:
    """CenterNet's penalty-reduced focal loss (Zhou et al. 2019, eq. 1), per centre."""
    p = logits.sigmoid().clamp(1e-4, 1 - 1e-4)
    centre = (heat > 0.999).float()
    terms = centre * (1 - p) ** 2 * p.log() + (1 - centre) * (1 - heat) ** 4 * p**2 * (1 - p).log()
    return -terms.sum() / (centre.sum() + 1)


@dataclass(frozen=True)
class Examined:
    """A window's detections beside its truth: overlaps (D, I) and the visible area of each instance (I,)."""

    window: Window
    found: list[Detection]
    iou: Array
    area_px: NDArray[np.int64]
    seconds: float


class FindsParts(Protocol):
    """What can be examined on windows."""

    def detect_reduced(self, image: NDArray[np.uint8]) -> list[Detection]:
        """The parts in an RGB image (H, W, 3) of a window."""
        ...


def examine(segmenter: FindsParts, windows: Iterable[Window]) -> list[Examined]:
    """Run the segmenter on windows and compare."""
    out = []
    for window in windows:
        start = time.perf_counter()
        found = segmenter.detect_reduced(window.image)
        seconds = time.perf_counter() - start
        truth = [window.instances == k + 1 for k in range(len(window.centres))]
        iou = np.array([[mask_iou(d.mask, t, d.mask_origin) for t in truth] for d in found], np.float64)
        area = np.array([np.count_nonzero(t) for t in truth], np.int64)
        out.append(Examined(window, found, iou.reshape(len(found), len(truth)), area, seconds))
    return out


def figures_of(examined: Sequence[Examined], min_score: float = 0.0) -> dict[str, float]:
    """``DetectionScores.report`` with class accuracy, centre error (frame pixels) and ms an image."""
    scores, centre_px, right = DetectionScores(), [], []
    for seen in examined:
        kept = [d for d, detection in enumerate(seen.found) if detection.score >= min_score]
        window, iou = seen.window, seen.iou[kept]
        scores.add(iou, [seen.found[d].score for d in kept], seen.area_px < MIN_VISIBLE_PX)
        inner = np.array(window.instances.shape[::-1]) - 3
        for row, d in enumerate(kept):
            if not iou.shape[1] or iou[row].max() < 0.5:
                continue
            k = int(iou[row].argmax())
            right.append(int(seen.found[d].class_probabilities.argmax()) == window.classes[k])
            if np.all((window.centres[k] > 2) & (window.centres[k] < inner)):
                true_px = (window.centres[k] + 0.5) * REDUCTION - 0.5
                centre_px.append(float(np.linalg.norm(seen.found[d].centre_px - true_px)))
    centre = summary(centre_px)
    return scores.report() | {
        "class_accuracy": float(np.mean(right)) if right else float("nan"),
        "centre_median_px": centre["median"],
        "centre_p95_px": centre["p95"],
        "image_ms": 1e3 * float(np.median([seen.seconds for seen in examined])),
    }


def train_segmentation(config: SegmentationTraining) -> None:
    """Train, measure on all validation windows, and keep the weights with their figures."""
    cv2.setNumThreads(config.threads)
    names = config.parts or BUILT_IN
    parts = [load_part(name, config.parts_dir) for name in names]
    training, validation = (Windows(*map(load_windows, paths), parts=parts) for paths in (config.data, config.val))
    chosen = evenly_chosen(len(training), config.images)
    device = default_device()
    with seeded(config.seed):
        net = SegmentationNet(len(parts)).to(device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    minutes_before = 0.0
    if config.start is not None:
        state, earlier = load_weights(config.start / WEIGHTS, config.parts_dir)
        net.load_state_dict(state)
        minutes_before = earlier["minutes"] + earlier.get("minutes_before_start", 0.0)

    def step(rng: np.random.Generator) -> Losses:
        images, targets = batch_of([example(training, chosen, rng, config) for _ in range(config.batch)], device)
        with reduced_autocast(device):
            outputs = net(images)
        return losses(outputs, targets)

    def validate(model: nn.Module) -> dict[str, float]:
        assert isinstance(model, SegmentationNet)
        few = [validation[i] for i in range(min(config.validate_windows, len(validation)))]
        segmenter = Segmenter(model, names, DecodeConfig())
        shown = [window for window in few if len(window.centres)][:PICTURED]
        save_picture(config.out / "segmentation_predictions.png", segmentation_sheet(segmenter, shown))
        figures = figures_of(examine(segmenter, few))
        return {key: figures[key] for key in ("ap50", "precision50", "recall50", "centre_median_px")}

    result = train("segmentation", net, step, config, config.out, validate=validate)
    net.load_state_dict(result.state_dict)
    segmenter = Segmenter(net, names, DecodeConfig())
    figures = figures_of(examine(segmenter, (validation[i] for i in range(len(validation)))))
    data = {path.name: manifest_hash(path) for path in (*config.data, *config.val)}
    metadata = weights_metadata(names, config, result, data, figures, config.parts_dir) | {
        "decode": asdict(segmenter.config),
        "net": net.shape,
    }
    metadata["minutes_before_start"] = minutes_before
    save_weights(config.out / WEIGHTS, result.state_dict, metadata)
    print("  ".join(f"{key} {value:.4f}" for key, value in figures.items()))
