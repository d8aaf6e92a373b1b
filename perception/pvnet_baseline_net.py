"""The networks of the published baseline: PVNet (Peng et al., CVPR 2019), one decoder a part over all its poses.

Every pixel says whether it is the part's and gives a vector to every keypoint; the pixels of the mask vote by RANSAC.
Encoder and decoder are built like those of our own votes (``perception.pvnet``), so that methods are compared and not
backbones: nothing here knows of faces, and a part has one head for all its poses. The parts share the encoder, which
can start from the weights of our own votes, as the published one starts from ImageNet's.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.spatial import Array
from perception.augment import network_input
from perception.estimates import PerceptionError
from perception.layers import Residual, conv_block
from perception.posenets import CropKeypoints
from perception.pvnet import CHANNELS, at_cells, grid_pixels
from perception.voting import ransac_vote
from perception.weight_files import StateDict

GLOBAL = 112
FEWEST_VOTERS = 16
MOST_VOTERS = 300


class Encoder(nn.Module):
    """Crops (B, 5, 128, 128) to feature maps at strides 2 to 32 and one global vector (B, 112)."""

    def __init__(self) -> None:
        super().__init__()
        self.down1 = conv_block(5, 16, 2, kernel=5)  # 64
        self.down2 = nn.Sequential(conv_block(16, 40, 2), conv_block(40, 40))  # 32
        self.down3 = nn.Sequential(conv_block(40, 64, 2), Residual(64))  # 16
        self.down4 = nn.Sequential(conv_block(64, 96, 2), Residual(96))  # 8
        self.down5 = nn.Sequential(conv_block(96, 128, 2), conv_block(128, 128))  # 4
        self.vector = nn.Sequential(nn.Linear(16 * 128, GLOBAL), nn.ReLU(inplace=True))

    def forward(self, x: Tensor) -> list[Tensor]:
        """The five maps, finest first, then the vector."""
        out = []
        for stage in (self.down1, self.down2, self.down3, self.down4, self.down5):
            x = stage(x)
            out.append(x)
        return [*out, self.vector(x.flatten(1))]


class PartDecoder(nn.Module):
    """One part's decoder: the encoder's maps to features (B, 40, 64, 64) and mask logits (B, 64, 64); ``vectors`` to
    each keypoint from features.
    """

    def __init__(self, n_keypoints: int) -> None:
        super().__init__()
        self.n_keypoints = n_keypoints
        self.up4, self.tell4 = conv_block(128 + 96, 96), nn.Linear(GLOBAL, 96)
        self.up3, self.tell3 = conv_block(96 + 64, 64), nn.Linear(GLOBAL, 64)
        self.up2, self.tell2 = conv_block(64 + 40, 40), nn.Linear(GLOBAL, 40)
        self.up1, self.tell1 = conv_block(40 + 16, CHANNELS, kernel=1), nn.Linear(GLOBAL, CHANNELS)
        self.mask = nn.Conv2d(CHANNELS, 1, 1)
        self.head = nn.Linear(CHANNELS, 2 * n_keypoints)

    def forward(self, maps: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Features and mask logits from what the encoder gives."""
        *skips, y, g = maps
        ups = ((self.up4, self.tell4), (self.up3, self.tell3), (self.up2, self.tell2), (self.up1, self.tell1))
        for skip, (up, tell) in zip(reversed(skips), ups, strict=True):
            y = functional.interpolate(y, scale_factor=2, mode="nearest")
            y = up(torch.cat([y, skip], dim=1)) + tell(g)[:, :, None, None]
        return y, self.mask(y)[:, 0].float()

    def vectors(self, features: Tensor) -> Tensor:
        """Vectors (B, S, K, 2), near unit length, to the keypoints from features (B, S, 40) of S cells each."""
        return self.head(features.float()).unflatten(-1, (self.n_keypoints, 2))


class Pvnets(nn.Module):
    """The networks of several parts: one encoder, a decoder for each part by its name."""

    def __init__(self, n_keypoints: Mapping[str, int]) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.decoders = nn.ModuleDict({name: PartDecoder(count) for name, count in n_keypoints.items()})

    def decoder(self, part: str) -> PartDecoder:
        """The decoder of one part."""
        decoder = self.decoders[part]
        assert isinstance(decoder, PartDecoder)
        return decoder

    def start_from(self, state: StateDict) -> None:
        """Take over all weights from a training of these networks, or encoder and decoders, but not their heads, from
        one of our own votes.

        Raises PerceptionError when they are another network's.
        """
        if set(state) == set(self.state_dict()):
            self.load_state_dict(state)
            return
        for module in (self.encoder, *(self.decoder(part) for part in self.decoders)):
            wanted = {key for key in module.state_dict() if not key.startswith("head.")}
            if missing := sorted(wanted - set(state)):
                raise PerceptionError(
                    f"the weights to start from have no {', '.join(missing[:3])}; give keypoints.safetensors, "
                    "pvnet.safetensors or none"
                )
            module.load_state_dict({key: state[key] for key in wanted}, strict=False)


def unit_vectors(keypoints: Tensor, cells: Tensor) -> Tensor:
    """Targets (B, S, K, 2): unit vectors to the keypoints (B, K, 2), crop pixels, from flat grid cells (B, S)."""
    return functional.normalize(keypoints[:, None] - grid_pixels(cells)[:, :, None], dim=-1)


def baseline_loss(
    nets: Pvnets, parts: Mapping[str, slice], x: Tensor, mask: Tensor, keypoints: Tensor, cells: Tensor
) -> dict[str, Tensor]:
    """Cross-entropy of the masks (B, 64, 64) and smooth L1 of the vectors at sampled cells (B, S) of the masks, as
    published, the mean over parts. ``parts`` says which crops of the batch are whose; ``keypoints`` (B, K, 2) are those
    of the labelled pose in crop pixels.
    """
    with torch.autocast("cpu", torch.bfloat16):
        maps = nets.encoder(x)
        found = {part: nets.decoder(part)([m[mine] for m in maps]) for part, mine in parts.items()}
    losses = {"mask": torch.zeros(()), "vector": torch.zeros(())}
    for part, mine in parts.items():
        features, logits = found[part]
        vectors = nets.decoder(part).vectors(at_cells(features, cells[mine]))
        target = unit_vectors(keypoints[mine], cells[mine])
        losses["mask"] = losses["mask"] + functional.binary_cross_entropy_with_logits(logits, mask[mine]) / len(parts)
        losses["vector"] = losses["vector"] + functional.smooth_l1_loss(vectors, target) / len(parts)
    return losses


def vote_keypoints(
    nets: Pvnets, part: str, images: NDArray[np.uint8], rays: Array, rng: np.random.Generator
) -> list[CropKeypoints]:
    """Keypoints with covariances of crops (N, 128, 128, 3) of a part by RANSAC over the vectors inside its mask.

    At most ``MOST_VOTERS`` cells vote, evenly spread over the mask; where few are likely to be of the part, the
    ``FEWEST_VOTERS`` likeliest do, so that there always is an answer.
    """
    if not len(images):
        return []
    decoder, out = nets.decoder(part), []
    with torch.inference_mode():
        with torch.autocast("cpu", torch.bfloat16):
            features, logits = decoder(nets.encoder(network_input(images, rays)))
        for i in range(len(images)):
            flat = torch.sigmoid(logits[i]).flatten()
            cells = torch.nonzero(flat > 0.5)[:, 0]
            if len(cells) < FEWEST_VOTERS:
                cells = flat.topk(FEWEST_VOTERS).indices
            cells = cells[torch.linspace(0, len(cells) - 1, min(len(cells), MOST_VOTERS)).long()]
            directions = decoder.vectors(at_cells(features[i : i + 1], cells[None]))[0]
            pixels, covariances = ransac_vote(grid_pixels(cells).numpy(), directions.numpy(), rng)
            mask = flat.reshape(logits.shape[1:]).numpy().astype(np.float64)
            out.append(CropKeypoints(pixels=pixels, covariances=covariances, mask=mask))
    return out
