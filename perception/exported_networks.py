"""Which networks there are to export, with forward passes that return tensors and words on what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from perception.augment import CROP
from perception.export import Exportable, Inputs
from perception.faces import FaceTable
from perception.posenets import PoseNets
from perception.pvnet import PVNet
from perception.pvnet_baseline import PVNET_WEIGHTS, load_pvnets
from perception.pvnet_baseline_net import Pvnets
from perception.segmentation import NETWORK_STRIDE, SegmentationNet, Segmenter
from perception.verifier import RECTIFIED

SEED = 0
CHANNELS = 5
CROP_TEXT = (
    "(batch, 5, {size}, {size}) float32: RGB less the crop's mean, over (its standard deviation + 8), in levels of "
    "0 to 255, all colours alike; then two constant planes, x / z and y / z of the ray to the crop's middle"
)


class SegmentationTensors(nn.Module):
    """The segmentation network with its outputs as a tuple."""

    def __init__(self, net: SegmentationNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :class:`perception.segmentation.Outputs`."""
        out = self.net(image)
        return out.mask, out.offset_px, out.heat, out.classes


class KeypointVotes(nn.Module):
    """Votes of all cells of a crop for the keypoints of a given face."""

    def __init__(self, net: PVNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, crop: Tensor, face: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mask logits (B, 64, 64), offsets (B, 4096, K, 2) and log scales (B, 4096, K)."""
        features, mask = self.net(crop)
        _, offset, log_scale = self.net.votes(features.flatten(2).transpose(1, 2), face)
        return mask, offset, log_scale


class PartVectors(nn.Module):
    """The baseline's vectors of all cells of a crop to the keypoints of each part."""

    def __init__(self, nets: Pvnets) -> None:
        super().__init__()
        self.nets = nets

    def forward(self, crop: Tensor) -> tuple[Tensor, ...]:
        """Mask logits (B, 64, 64) and vectors (B, 4096, K, 2) of each part, in the order of the parts."""
        maps = self.nets.encoder(crop)
        out: list[Tensor] = []
        for part in self.nets.decoders:
            decoder = self.nets.decoder(part)
            features, mask = decoder(maps)
            out += [mask, decoder.vectors(features.flatten(2).transpose(1, 2))]
        return tuple(out)


def exportable_networks(weights_dir: Path, parts_dir: Path | None = None) -> list[Exportable]:
    """The networks kept in ``weights_dir``, the published baseline's where there are weights of it.

    Raises PerceptionError when one of the others is missing or a part has changed.
    """
    segmenter = Segmenter.load(weights_dir, parts_dir)
    nets = PoseNets.load(weights_dir, parts_dir)
    found = [
        segmentation_network(segmenter.net.cpu(), list(segmenter.part_names), weights_dir),
        *crop_networks(nets, weights_dir),
    ]
    baseline = weights_dir / PVNET_WEIGHTS
    if baseline.exists():
        found.append(baseline_network(load_pvnets(baseline, parts_dir)[0], baseline))
    return found


def segmentation_network(net: SegmentationNet, part_names: list[str], weights_dir: Path) -> Exportable:
    """The segmenter: any batch, any size in steps of 16."""
    batch, rows, columns = (torch.export.Dim(name, min=1) for name in ("batch", "rows", "columns"))
    return Exportable(
        name="segmentation",
        module=SegmentationTensors(net),
        weights=weights_dir / "segmentation.safetensors",
        example=_noise(image=(2, 3, 96, 128)),
        sizes=(_noise(image=(1, 3, 64, 160)), _noise(image=(3, 3, 16, 48))),
        axes={"image": {0: batch, 2: NETWORK_STRIDE * rows, 3: NETWORK_STRIDE * columns}},
        inputs={
            "image": "(batch, 3, height, width) float32, whole multiples of 16: RGB at 269 um a pixel on the table, "
            "less its mean over 97 x 97 pixels and colours, over (the standard deviation of brightness there + 8), in "
            "grey levels of 0 to 255, borders mirrored"
        },
        outputs={
            "mask": "(batch, height, width) logits of foreground",
            "offset_px": "(batch, 2, height / 2, width / 2): from each 2 x 2 cell's middle to its instance's centre",
            "heat": "(batch, height / 4, width / 4) logits of centres",
            "classes": "(batch, parts, height / 4, width / 4) logits of the part",
        },
        about={"parts": part_names},
    )


def crop_networks(nets: PoseNets, weights_dir: Path) -> list[Exportable]:
    """Classifier, verifier and keypoints."""
    batch = torch.export.Dim("batch", min=1)
    crops = [_noise(crop=(n, CHANNELS, CROP, CROP)) for n in (2, 1, 3)]
    views = [_noise(crop=(n, CHANNELS, RECTIFIED, RECTIFIED)) for n in (2, 1, 3)]
    faces = [torch.arange(n) % len(nets.table) for n in (2, 1, 3)]
    voting = [crop | {"face": face} for crop, face in zip(crops, faces, strict=True)]
    crop_text = CROP_TEXT.format(size=CROP)
    about = _faces(nets.table)
    return [
        Exportable(
            name="classifier",
            module=nets.classifier,
            weights=weights_dir / "classifier.safetensors",
            example=crops[0],
            sizes=tuple(crops[1:]),
            axes={"crop": {0: batch}},
            inputs={"crop": crop_text},
            outputs={
                "logits": "(batch, 36 faces + 1): faces by yaw bins of 10 degrees, yaw the fastest; last, not a part",
                "centre_px": "(batch, 2): pixel of the footprint's centre, at half the part's height",
            },
            about=about,
        ),
        Exportable(
            name="verifier",
            module=nets.verifier,
            weights=weights_dir / "verifier.safetensors",
            example=views[0],
            sizes=tuple(views[1:]),
            axes={"crop": {0: batch}},
            inputs={"crop": CROP_TEXT.format(size=RECTIFIED) + "; turned back by the yaw to be checked"},
            outputs={"logits": "(batch, faces + 1): face seen at yaw 0; last, not a part"},
            about=about,
        ),
        Exportable(
            name="keypoints",
            module=KeypointVotes(nets.votes),
            weights=weights_dir / "keypoints.safetensors",
            example=voting[0],
            sizes=tuple(voting[1:]),
            axes={"crop": {0: batch}, "face": {0: batch}},
            inputs={"crop": crop_text, "face": "(batch,) int64: number of the face that each crop shows"},
            outputs={
                "mask": "(batch, 64, 64) logits of the part; a cell is 2 x 2 pixels",
                "offset_px": "(batch, 4096, keypoints, 2): from each cell's middle to each keypoint",
                "log_scale": "(batch, 4096, keypoints): natural log of that vote's spread in pixels",
            },
            about=about,
        ),
    ]


def baseline_network(nets: Pvnets, weights: Path) -> Exportable:
    """The published baseline: one file for all parts."""
    crops = [_noise(crop=(n, CHANNELS, CROP, CROP)) for n in (2, 1, 3)]
    outputs = {}
    for part in nets.decoders:
        outputs[f"{part}_mask"] = "(batch, 64, 64) logits of the part; a cell is 2 x 2 pixels"
        outputs[f"{part}_vectors"] = "(batch, 4096, keypoints, 2): direction from each cell's middle to each keypoint"
    return Exportable(
        name="pvnet",
        module=PartVectors(nets),
        weights=weights,
        example=crops[0],
        sizes=tuple(crops[1:]),
        axes={"crop": {0: torch.export.Dim("batch", min=1)}},
        inputs={"crop": CROP_TEXT.format(size=CROP)},
        outputs=outputs,
        about={"parts": list(nets.decoders)},
    )


def _faces(table: FaceTable) -> dict[str, Any]:
    return {
        "faces": [{"part": face.part.name, "stable_pose": face.stable_pose.index} for face in table.faces],
        "meshes": {part.name: part.mesh_hash for part in table.parts},
    }


def _noise(**shapes: tuple[int, ...]) -> Inputs:
    """Normally distributed inputs by name: of the mean and spread that normalised images have."""
    generator = torch.Generator().manual_seed(SEED)
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
