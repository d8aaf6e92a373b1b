"""V: checks hypotheses on rectified crops, turned back by the hypothesised yaw, so that yaw is out of the problem.

Two views of one crop, at a yaw and at that yaw + 180 degrees, share one softmax over 2 x faces and "not a part": the
network has to say which of the two views shows which face upright.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.spatial import Array, wrap_angle
from perception.augment import image_turn, network_input, rectify_warp, warp_image
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.layers import Residual, conv_block

RECTIFIED = 96
SAME_YAW = np.radians(3.0)
"""A view shows an equivalent upright when its yaw is within this of the equivalent's."""


class Verifier(nn.Module):
    """Rectified crops to logits over faces and "not a part"."""

    def __init__(self, n_faces: int, widths: tuple[int, int, int, int] = (20, 40, 72, 112)) -> None:
        super().__init__()
        a, b, c, d = widths
        self.n_faces = n_faces
        self.features = nn.Sequential(
            conv_block(5, a, 2, kernel=5),  # 48
            conv_block(a, b, 2),  # 24
            conv_block(b, b),
            conv_block(b, c, 2),  # 12
            Residual(c),
            conv_block(c, d, 2),  # 6
            conv_block(d, d),
        )
        self.head = nn.Sequential(
            nn.Linear(36 * d, 192), nn.ReLU(inplace=True), nn.Dropout(0.1), nn.Linear(192, n_faces + 1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Logits (B, F + 1), "not a part" last, from input (B, 5, 96, 96)."""
        return self.head(self.features(x).flatten(1)).float()


def rectify(
    image: NDArray[np.uint8], centre: ArrayLike, yaw: float, ray: Array, scale: float = 1.0
) -> tuple[NDArray[np.uint8], Array]:
    """The crop (128, 128, 3) turned back by ``yaw`` about ``centre`` (96, 96, 3), and its ray (2,) turned likewise."""
    warp = rectify_warp(centre, yaw, RECTIFIED, scale)
    return warp_image(image, warp, RECTIFIED), image_turn(-yaw) @ ray


def listwise(logits: Tensor) -> Tensor:
    """Log-probabilities (N, V * F + 1) of "view v shows face f upright" and "not a part" from logits (N, V, F + 1)."""
    upright = logits[..., :-1].flatten(1)
    return functional.log_softmax(torch.cat([upright, logits[..., -1].mean(1, keepdim=True)], dim=1), dim=1)


class PairSampler:
    """Draws the two views of each crop and their target distribution."""

    def __init__(self, table: FaceTable) -> None:
        self.n_faces = len(table)
        self.part_of_face = table.part_of_face
        self.equivalents = [[(e.face, e.yaw) for e in found] for found in table.equivalents]

    def __call__(
        self, images: NDArray[np.uint8], labels: CropLabels, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
        """Views (2N, 96, 96, 3), their rays (2N, 2) and targets (N, 2 F + 1).

        One view is at the true yaw, the other half a turn away (sometimes any other angle). Both are off by what J is
        off by: 2 degrees, and a centre whose error has a median of 1.6 crop pixels and a long tail.
        """
        n = len(images)
        views = np.empty((2 * n, RECTIFIED, RECTIFIED, 3), np.uint8)
        rays = np.empty((2 * n, 2), np.float32)
        target = np.zeros((n, 2 * self.n_faces + 1), np.float32)
        for i in range(n):
            away = np.pi if rng.random() < 0.85 else rng.uniform(0.6, 2 * np.pi - 0.6)
            yaw = labels.yaw[i] if labels.has_part[i] else rng.uniform(-np.pi, np.pi)
            offsets = (0.0, away) if rng.random() < 0.5 else (away, 0.0)
            off_px = rng.normal(0.0, 0.5 + rng.exponential(1.3), 2)
            off_rad = rng.normal(0.0, np.radians(2.0))
            for view, offset in enumerate(offsets):
                views[2 * i + view], rays[2 * i + view] = rectify(
                    images[i],
                    labels.centre[i] + off_px,
                    yaw + offset + off_rad,
                    labels.ray[i],
                    float(np.exp(rng.normal(0.0, 0.01))),
                )
                if labels.has_part[i]:
                    for face, turn in self.equivalents[labels.face[i]]:
                        if abs(float(wrap_angle(turn - offset))) < SAME_YAW:
                            target[i, view * self.n_faces + face] = 1.0
            if not labels.has_part[i]:
                target[i, -1] = 1.0
        return views, rays, target / target.sum(axis=1, keepdims=True)

    def within_part(self, labels: CropLabels) -> NDArray[np.bool_]:
        """(N, 2 F + 1) which entries belong to the part that the crop shows."""
        part = np.append(self.part_of_face, -1)[labels.face]
        inside = self.part_of_face[None, :] == part[:, None]
        return np.concatenate([inside, inside, ~labels.has_part[:, None]], axis=1)


def verifier_loss(log_probability: Tensor, target: Tensor, inside: Tensor) -> dict[str, Tensor]:
    """Weighted divergence over all choices, and over those of the right part (``inside``, (N, 2 F + 1) bool)."""
    entropy = -(target * torch.log(target + 1e-9)).sum(1)
    joint = -(target * log_probability).sum(1) - entropy
    of_part = functional.log_softmax(log_probability.masked_fill(~inside, -1e4), 1).clamp(min=-50.0)
    conditional = -(target * of_part).sum(1) - entropy
    return {"joint": 0.4 * joint.mean(), "conditional": conditional.mean()}


def score_views(
    model: Verifier, views: NDArray[np.uint8], rays: NDArray[np.floating], counts: Sequence[int]
) -> list[tuple[Array, float]]:
    """Per crop the log-probabilities (V, F) that view v shows face f upright, and that of "not a part".

    ``views`` (sum of ``counts``, 96, 96, 3) holds the views of all crops, ``counts`` of each; their rays alike.
    """
    x = network_input(views, rays)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        logits = model(x)
    out: list[tuple[Array, float]] = []
    for part in torch.split(logits, list(counts)):
        log = listwise(part[None])[0].numpy().astype(np.float64)
        out.append((log[:-1].reshape(len(part), model.n_faces), float(log[-1])))
    return out
