"""Keypoint voting network after PVNet (Peng et al., CVPR 2019): every pixel of the part votes for every keypoint.

A U-Net down to stride 32 whose bottleneck, as one global vector, is fed to every stage of the decoder; a mask head, and
for each face (part, stable pose) its own 1 x 1 head with, per keypoint, a unit vector towards it (PVNet's vote) and an
offset to it with its confidence. One head for all faces of a part cannot work: the same picture of a flat metal edge
means other keypoints on another face. The votes are on a 64 x 64 grid, so losses are taken on sampled mask pixels only.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.spatial import Array
from perception.augment import network_input
from perception.faces import FaceTable
from perception.layers import Residual, conv_block

GRID = 64
CHANNELS = 40
VOTE = 5  # unit vector (2), offset (2), log scale (1)
OFFSET_SCALE_PX = 32.0


class PVNet(nn.Module):
    """Crops to features (B, 40, 64, 64) and mask logits (B, 64, 64); ``votes`` turns features into votes."""

    def __init__(self, n_faces: int, n_keypoints: int = 8) -> None:
        super().__init__()
        self.n_faces, self.n_keypoints = n_faces, n_keypoints
        self.down1 = conv_block(5, 16, 2, kernel=5)  # 64
        self.down2 = nn.Sequential(conv_block(16, 40, 2), conv_block(40, 40))  # 32
        self.down3 = nn.Sequential(conv_block(40, 64, 2), Residual(64))  # 16
        self.down4 = nn.Sequential(conv_block(64, 96, 2), Residual(96))  # 8
        self.down5 = nn.Sequential(conv_block(96, 128, 2), conv_block(128, 128))  # 4
        self.vector = nn.Sequential(nn.Linear(16 * 128, 112), nn.ReLU(inplace=True))
        self.up4, self.tell4 = conv_block(128 + 96, 96), nn.Linear(112, 96)
        self.up3, self.tell3 = conv_block(96 + 64, 64), nn.Linear(112, 64)
        self.up2, self.tell2 = conv_block(64 + 40, 40), nn.Linear(112, 40)
        self.up1, self.tell1 = conv_block(40 + 16, CHANNELS, kernel=1), nn.Linear(112, CHANNELS)
        self.mask = nn.Conv2d(CHANNELS, 1, 1)
        self.head = nn.Parameter(0.05 * torch.randn(n_faces, n_keypoints * VOTE, CHANNELS))
        self.head_bias = nn.Parameter(torch.zeros(n_faces, n_keypoints * VOTE))

    @classmethod
    def for_table(cls, table: FaceTable) -> PVNet:
        """A network with a head for each face of ``table``."""
        return cls(len(table), len(table.parts[0].keypoints))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, 40, 64, 64) and mask logits (B, 64, 64) from input (B, 5, 128, 128)."""
        x1 = self.down1(x)
        x2 = self.down2(x1)
        x3 = self.down3(x2)
        x4 = self.down4(x3)
        y = self.down5(x4)
        g = self.vector(y.flatten(1))
        for skip, up, tell in (
            (x4, self.up4, self.tell4),
            (x3, self.up3, self.tell3),
            (x2, self.up2, self.tell2),
            (x1, self.up1, self.tell1),
        ):
            y = functional.interpolate(y, scale_factor=2, mode="nearest")
            y = up(torch.cat([y, skip], dim=1)) + tell(g)[:, :, None, None]
        return y, self.mask(y)[:, 0].float()

    def votes(self, features: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit vectors (B, S, K, 2), offsets in crop pixels (B, S, K, 2) and their log scales in pixels (B, S, K) for
        ``features`` (B, S, 40) of S pixels each and the face (B,) that each crop shows.
        """
        flat = torch.baddbmm(self.head_bias[faces][:, None], features.float(), self.head[faces].float().transpose(1, 2))
        v = flat.reshape(*features.shape[:2], self.n_keypoints, VOTE)
        unit = v[..., :2] / v[..., :2].norm(dim=-1, keepdim=True).clamp(min=1e-3)
        return unit, OFFSET_SCALE_PX * v[..., 2:4], v[..., 4].clamp(-3.0, 5.0)


def grid_pixels(cells: Tensor) -> Tensor:
    """Crop pixels (..., 2) of the centres of flat grid cells (...): a cell is two by two pixels."""
    return 2.0 * torch.stack([cells % GRID, cells // GRID], dim=-1).float() + 0.5


def at_cells(features: Tensor, cells: Tensor) -> Tensor:
    """Features (B, S, C) of the flat grid cells (B, S)."""
    flat = features.flatten(2)  # (B, C, 4096)
    return flat.gather(2, cells[:, None].expand(-1, flat.shape[1], -1)).transpose(1, 2)


def pvnet_loss(
    model: PVNet, x: Tensor, mask: Tensor, face: Tensor, keypoints: Tensor, cells: Tensor
) -> dict[str, Tensor]:
    """Weighted terms: mask (BCE and Dice), unit vectors, offsets with confidence.

    ``mask`` (B, 64, 64) float, ``face`` (B,) with -1 for no part, ``keypoints`` (B, A, K, 2) alternatives in crop
    pixels of which the one that fits better counts, ``cells`` (B, S) sampled flat grid cells of the mask.
    """
    with torch.autocast("cpu", torch.bfloat16):
        features, logits = model(x)
    p = torch.sigmoid(logits)
    overlap = (p * mask).sum((1, 2))
    dice = 1.0 - (2.0 * overlap + 1.0) / (p.sum((1, 2)) + mask.sum((1, 2)) + 1.0)
    has = face >= 0
    losses = {"mask": functional.binary_cross_entropy_with_logits(logits, mask) + 0.3 * dice[has].mean()}
    unit, offset, log_scale = model.votes(at_cells(features, cells)[has], face[has])
    wanted = keypoints[has][:, :, None] - grid_pixels(cells[has])[:, None, :, None]  # (B, A, S, K, 2)
    distance = wanted.norm(dim=-1)
    # a unit vector is undefined at its keypoint: votes nearer than two pixels count less
    angle = (1.0 - (unit[:, None] * wanted).sum(-1) / distance.clamp(min=1e-3)) * (distance / 2.0).clamp(max=1.0)
    miss = (offset[:, None] - wanted).norm(dim=-1)
    s = log_scale[:, None]
    likelihood = miss * torch.exp(-s) + 2.0 * s  # of an isotropic Laplace density in the plane
    per_alternative = (2.0 * angle + 0.5 * miss / OFFSET_SCALE_PX + 0.25 * likelihood).mean((2, 3))  # (B, A)
    chosen = per_alternative.argmin(dim=1)
    rows = torch.arange(len(chosen))
    losses["vector"] = 2.0 * angle.mean((2, 3))[rows, chosen].mean()
    losses["offset"] = (0.5 * miss / OFFSET_SCALE_PX + 0.25 * likelihood).mean((2, 3))[rows, chosen].mean()
    return losses


def sample_cells(masks: NDArray[np.bool_], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` random flat cells (N, count) of each mask (N, 64, 64), of any cells where a mask is empty."""
    out = np.empty((len(masks), count), dtype=np.int64)
    for i, mask in enumerate(masks):
        inside = np.flatnonzero(mask)
        out[i] = rng.choice(inside, count) if len(inside) else rng.integers(GRID * GRID, size=count)
    return out


def infer_votes(
    model: PVNet, images: NDArray[np.uint8], rays: Array, faces: NDArray[np.int64], most_pixels: int = 400
) -> list[dict[str, Array]]:
    """Votes of crops (N, 128, 128, 3) for the given face of each: per crop ``pixels`` (P, 2), ``unit`` (P, K, 2),
    ``offset`` (P, K, 2), ``log_scale`` (P, K) and ``mask`` (64, 64) probability. At most ``most_pixels`` vote, evenly
    spread over the mask; where under 16 pixels are likely to be of the part, the 16 likeliest vote.
    """
    x = network_input(images, rays)
    out: list[dict[str, Array]] = []
    with torch.inference_mode():
        with torch.autocast("cpu", torch.bfloat16):
            features, logits = model(x)
        probability = torch.sigmoid(logits)
        for i in range(len(images)):
            flat = probability[i].flatten()
            cells = torch.nonzero(flat > 0.5)[:, 0] if int((flat > 0.5).sum()) >= 16 else flat.topk(16).indices
            if len(cells) > most_pixels:
                cells = cells[torch.linspace(0, len(cells) - 1, most_pixels).long()]
            votes = model.votes(at_cells(features[i : i + 1], cells[None]), torch.tensor([int(faces[i])]))
            unit, offset, log_scale = (v[0].numpy().astype(np.float64) for v in votes)
            out.append(
                {
                    "pixels": grid_pixels(cells).numpy().astype(np.float64),
                    "unit": unit,
                    "offset": offset,
                    "log_scale": log_scale,
                    "mask": probability[i].numpy().astype(np.float64),
                }
            )
    return out
