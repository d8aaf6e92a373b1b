"""Trains Mask R-CNN on the windows that our segmenter is trained on, varied likewise, and measures it on others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from cad.parts import BUILT_IN, Part, hash_file, load_part
from perception.bop_files import manifest_hash, read_entries
from perception.dataset import windows_of
from perception.layers import default_device
from perception.maskrcnn import MIN_SCORE, WEIGHTS, MaskRCNNSegmenter, build_net, torchvision_module
from perception.segmentation import WEIGHTS as ENCODER_WEIGHTS
from perception.segmentation import Segmenter, normalise
from perception.train_segmentation import Examined, SegmentationTraining, examine, example, figures_of
from perception.training import Losses, evenly_chosen, seeded, train
from perception.weight_files import load_weights, save_weights, weights_metadata
from perception.windows import MIN_VISIBLE_PX, Window, Windows

THRESHOLDS = tuple(np.arange(0.05, 0.96, 0.05).round(2).tolist())


@dataclass(frozen=True, kw_only=True)
class MaskRCNNTraining(SegmentationTraining):
    """As for our segmenter, with what suits this network: ``size`` a multiple of 32.

    Of each data set the first ``windows`` are kept in memory, and of these ``images`` learned from. ``encoder`` is the
    folder of our segmenter's weights, whose encoder the training starts with.
    """

    encoder: Path = Path("perception/weights")

    minutes: float = 35.0
    batch: int = 4
    size: int = 224
    learning_rate: float = 1e-3
    validate_windows: int = 60
    windows: int = 4000
    validate_s: float = 420.0


def visible_windows(path: Path, parts: Sequence[Part], most: int | None = None) -> Windows:
    """The windows of a data set, or the first so many, with holes left open: the pixels that the evaluation counts."""
    return Windows(windows_of(read_entries(path)[:most]), parts=parts, holes=True)


def target_of(window: Window) -> dict[str, Tensor]:
    """Torchvision's target: boxes (I, 4) round the outer edges of the pixels, labels from 1 on and masks (I, H, W).

    Integers are pixel centres, as torchvision's RoIAlign has them. Slivers are left out.
    """
    boxes, labels, masks = [], [], []
    for k, part in enumerate(window.classes):
        mask = window.instances == k + 1
        if np.count_nonzero(mask) < MIN_VISIBLE_PX:
            continue
        u, v, width, height = cv2.boundingRect(mask.astype(np.uint8))
        boxes.append([u - 0.5, v - 0.5, u + width - 0.5, v + height - 0.5])
        labels.append(int(part) + 1)
        masks.append(mask)
    stack = np.stack(masks) if masks else np.zeros((0, *window.instances.shape), bool)
    return {
        "boxes": torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        "labels": torch.tensor(labels, dtype=torch.int64),
        "masks": torch.from_numpy(stack.astype(np.uint8)),
    }


def train_maskrcnn(config: MaskRCNNTraining) -> None:
    """Train, pick the score threshold on the validation windows, and keep the weights with their figures."""
    torchvision_module()  # where it is missing, say so before anything takes time
    cv2.setNumThreads(config.threads)
    names = config.parts or BUILT_IN
    parts = [load_part(name, config.parts_dir) for name in names]
    training = [visible_windows(path, parts, config.windows) for path in config.data]
    validation = [w[i] for w in (visible_windows(path, parts) for path in config.val) for i in range(len(w))]
    learned = [evenly_chosen(len(windows), config.images) for windows in training]
    share = np.array([len(windows) for windows in training]) / sum(len(windows) for windows in training)
    device = default_device()
    encoder = Segmenter.load(config.encoder, config.parts_dir).net
    with seeded(config.seed):
        net = build_net(len(names), encoder).to(device)
    minutes_before = 0.0
    if config.start is not None:
        state, earlier = load_weights(config.start / WEIGHTS, config.parts_dir)
        net.load_state_dict(state)
        minutes_before = earlier["minutes"] + earlier.get("minutes_before_start", 0.0)

    def step(rng: np.random.Generator) -> Losses:
        chosen = rng.choice(len(training), config.batch, p=share)
        examples = [example(training[i], learned[i], rng, config) for i in chosen]
        images = [torch.from_numpy(normalise(e.image)).permute(2, 0, 1).to(device) for e in examples]
        targets = [{key: value.to(device) for key, value in target_of(e).items()} for e in examples]
        return net(images, targets)

    def validate(model: nn.Module) -> dict[str, float]:
        few = validation[:: max(1, len(validation) // config.validate_windows)]
        _, figures = best_threshold(examine(MaskRCNNSegmenter(model, names), few))
        return {key: figures[key] for key in ("ap50", "miou", "precision50", "recall50", "class_accuracy")}

    result = train("maskrcnn", net, step, config, config.out, validate=validate)
    net.load_state_dict(result.state_dict)
    min_score, figures = best_threshold(examine(MaskRCNNSegmenter(net, names), validation))
    data = {path.name: manifest_hash(path) for path in (*config.data, *config.val)}
    metadata = weights_metadata(names, config, result, data, figures, config.parts_dir)
    metadata |= {
        "min_score": min_score,
        "minutes_before_start": minutes_before,
        "net": encoder.shape,
        "encoder": hash_file(config.encoder / ENCODER_WEIGHTS),
    }
    save_weights(config.out / WEIGHTS, result.state_dict, metadata)
    print("  ".join(f"{key} {value:.4f}" for key, value in figures.items()))


def best_threshold(examined: Sequence[Examined]) -> tuple[float, dict[str, float]]:
    """The score threshold with the best F1 at overlap 0.5, and the figures there; AP is over all detections.

    Nothing looks again at what this network finds, so that false detections weigh as much as missed parts.
    """
    tried = {score: figures_of(examined, score) for score in THRESHOLDS}

    def f1(figures: dict[str, float]) -> float:
        precision, recall = figures["precision50"], figures["recall50"]
        return 0.0 if not precision + recall > 0 else 2 * precision * recall / (precision + recall)

    best = max(tried, key=lambda score: f1(tried[score]))
    every = tried[MIN_SCORE]
    return best, tried[best] | {key: every[key] for key in ("ap", "ap50", "ap75")}
