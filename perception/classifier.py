"""J: one network that says which face a crop shows, at which yaw, and where its footprint's centre is.

Face and yaw are one discrete choice (face x 36 yaw bins, and "not a part"), because an error in either is a flipped
pose. Labels are spread over the two or three nearest bins and over the placements that look the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.spatial import Array, wrap_angle
from perception.augment import CROP_CENTRE, image_turn, network_input
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.layers import Residual, conv_block

YAW_BINS = 36
BIN_RAD = 2 * np.pi / YAW_BINS
BIN_CENTRES = np.asarray((np.arange(YAW_BINS) + 0.5) * BIN_RAD, dtype=np.float64)
LABEL_SIGMA = np.radians(5.0)
CENTRE_SCALE_PX = 8.0


class JointClassifier(nn.Module):
    """Crops to logits over face x yaw and "not a part", and the footprint's centre."""

    def __init__(self, n_faces: int, widths: tuple[int, int, int, int] = (16, 32, 80, 144), hidden: int = 288) -> None:
        super().__init__()
        a, b, c, d = widths
        self.n_faces = n_faces
        self.features = nn.Sequential(
            conv_block(5, a, 2, kernel=5),  # 64
            conv_block(a, b, 2),  # 32
            conv_block(b, b),
            conv_block(b, c, 2),  # 16
            Residual(c),
            conv_block(c, d, 2),  # 8
            Residual(d),
            conv_block(d, d, 2),  # 4
            conv_block(d, 96, kernel=1),
        )
        self.hidden = nn.Sequential(nn.Linear(16 * 96, hidden), nn.ReLU(inplace=True), nn.Dropout(0.1))
        self.out = nn.Linear(hidden, n_faces * YAW_BINS + 1 + 2)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, F * 36 + 1), "not a part" last, and centres (B, 2) in pixels, from input (B, 5, 128, 128)."""
        y = self.out(self.hidden(self.features(x).flatten(1))).float()
        return y[:, :-2], CENTRE_SCALE_PX * y[:, -2:] + CROP_CENTRE


class SoftLabels:
    """Turns faces and yaws into target distributions over face x yaw and "not a part"."""

    def __init__(self, table: FaceTable) -> None:
        self.n_faces = len(table)
        self.part_of_face = table.part_of_face
        self.equivalents = [[(e.face, e.yaw) for e in found] for found in table.equivalents]

    def __call__(self, labels: CropLabels) -> NDArray[np.float32]:
        """Targets (N, F * 36 + 1), each row summing to one."""
        out = np.zeros((len(labels), self.n_faces, YAW_BINS), dtype=np.float32)
        nothing = (~labels.has_part).astype(np.float32)
        for i in np.flatnonzero(labels.has_part):
            same = self.equivalents[labels.face[i]]
            for face, turn in same:
                off = wrap_angle(BIN_CENTRES - labels.yaw[i] - turn)
                weight = np.exp(-0.5 * (off / LABEL_SIGMA) ** 2)
                out[i, face] += weight / weight.sum() / len(same)
        return np.concatenate([out.reshape(len(out), -1), nothing[:, None]], axis=1)

    def within_part(self, labels: CropLabels) -> NDArray[np.bool_]:
        """(N, F * 36 + 1) which entries belong to the part that the crop shows."""
        part = np.append(self.part_of_face, -1)[labels.face]  # -1 where there is no part
        inside = np.repeat(self.part_of_face[None, :] == part[:, None], YAW_BINS, axis=1)
        return np.concatenate([inside, ~labels.has_part[:, None]], axis=1)


def classifier_loss(
    logits: Tensor, centres: Tensor, target: Tensor, inside: Tensor, true_centres: Tensor
) -> dict[str, Tensor]:
    """Weighted terms: divergence over all choices, over those of the right part, and the centre's distance."""
    entropy = -(target * torch.log(target + 1e-9)).sum(1)
    joint = -(target * functional.log_softmax(logits, 1)).sum(1) - entropy
    of_part = functional.log_softmax(logits.masked_fill(~inside, -1e4), 1).clamp(min=-50.0)
    conditional = -(target * of_part).sum(1) - entropy
    has_part = 1.0 - target[:, -1]
    distance = functional.smooth_l1_loss(centres, true_centres, reduction="none").sum(1)
    return {
        "joint": 0.5 * joint.mean(),
        "conditional": conditional.mean(),
        "centre": 0.05 * (distance * has_part).mean(),
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class JointAnswer:
    """Log-probabilities (N, F, 36) and (N,) of "not a part", and centres (N, 2) in crop pixels."""

    log_probability: Array
    log_not_a_part: Array
    centre: Array


def classify(model: JointClassifier, images: NDArray[np.uint8], rays: Array, quarter_turns: int = 4) -> JointAnswer:
    """Run J on crops (N, 128, 128, 3) with the rays (N, 2) through their centres, averaged over ``quarter_turns``
    (1, 2 or 4) turns of the picture; a quarter turn is nine yaw bins.
    """
    if quarter_turns not in (1, 2, 4):
        raise ValueError(f"quarter_turns = {quarter_turns}: must be 1, 2 or 4")
    n = len(images)
    logs, centres = [], np.zeros((n, 2))
    for k in range(0, 4, 4 // quarter_turns):
        turn = image_turn(k * np.pi / 2)
        x = network_input(np.ascontiguousarray(np.rot90(images, k, axes=(1, 2))), rays @ turn.T)
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
            logits, centre = model(x)
        log = functional.log_softmax(logits, 1)
        grid = log[:, :-1].reshape(n, model.n_faces, YAW_BINS).roll(-k * YAW_BINS // 4, dims=2)
        logs.append(torch.cat([grid.flatten(1), log[:, -1:]], dim=1))
        centres += ((centre.numpy() - CROP_CENTRE) @ turn + CROP_CENTRE) / quarter_turns  # turned back
    mean = functional.log_softmax(torch.stack(logs).mean(0), 1).numpy().astype(np.float64)
    return JointAnswer(
        log_probability=mean[:, :-1].reshape(n, model.n_faces, YAW_BINS), log_not_a_part=mean[:, -1], centre=centres
    )


def modes(log_probability: Array, count: int) -> list[tuple[int, float, float]]:
    """The ``count`` likeliest (face, yaw, log-probability) of one crop's log-probabilities (F, 36).

    A mode is a bin at least as likely as its two neighbours; it has the mass of the three, its yaw is their mean.
    """
    p = np.exp(log_probability)
    before, after = np.roll(p, 1, axis=1), np.roll(p, -1, axis=1)
    mass = before + p + after
    face, column = np.nonzero((p >= before) & (p > after))
    order = np.argsort(-mass[face, column])[:count]
    out: list[tuple[int, float, float]] = []
    for f, b in zip(face[order], column[order], strict=True):
        lean = (after[f, b] - before[f, b]) / mass[f, b]
        yaw = float(wrap_angle(BIN_CENTRES[b] + lean * BIN_RAD))
        out.append((int(f), yaw, float(np.log(max(mass[f, b], 1e-30)))))
    return out
