"""The paper's choice of segmenter: Mask R-CNN (He et al. 2017) out of torchvision, at a size that two cores can train.

torchvision's detector with a feature pyramid (Lin et al. 2017) at strides 4, 8 and 16 and anchors for parts of 10 to 60
pixels. Its backbone is the encoder of our own segmenter and starts from that one's weights, as networks trained on
photographs are too large; frames are reduced and normalised in the same way. So the two differ in what they make of the
same features. torchvision wants a torch of its own build: ``make maskrcnn`` makes an environment for it, and what it
finds goes to a file that the evaluation reads (:mod:`perception.stored_detections`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cad.spatial import Array
from perception.estimates import Frame, PerceptionError
from perception.layers import default_device
from perception.segmentation import REDUCTION, Detection, SegmentationNet, normalise, reduced_autocast
from perception.standard_view import reduced
from perception.weight_files import load_weights

WEIGHTS = "maskrcnn.safetensors"
STRIDES = (4, 8, 16)
PYRAMID = 48
"""Channels of the feature pyramid and of the mask head."""
REPRESENTATION = 192
ANCHORS_PX = ((12, 18), (26, 36), (48, 64))
"""Sides of the anchors at each stride, each at three aspect ratios."""
SIZE_DIVISOR = 32
"""Images are padded to whole multiples of this."""
MIN_SCORE = 0.05
"""torchvision's own default: what is below is not reported at all."""
DUPLICATE_IOU = 0.5
"""Boxes of different classes that overlap more are one part; the best class is kept."""


def torchvision_module(name: str = "torchvision") -> ModuleType:
    """A module of torchvision; raises PerceptionError that says how to install it where it cannot be imported."""
    try:
        return import_module(name)
    except (ImportError, RuntimeError) as error:  # RuntimeError: it was built for another torch
        raise PerceptionError(
            f"{name} cannot be imported ({error}); Mask R-CNN runs in an environment of its own: make it with `make "
            "maskrcnn` and use .venv-maskrcnn/bin/python"
        ) from error


class _Backbone(nn.Module):
    """The encoder of a segmenter under a feature pyramid."""

    def __init__(self, segmenter: SegmentationNet) -> None:
        super().__init__()
        self.stem = segmenter.stage2
        self.stages = nn.ModuleList([segmenter.stage4, segmenter.stage8, segmenter.stage16])
        widths = list(segmenter.shape["widths"])[1:]
        self.pyramid = torchvision_module("torchvision.ops").FeaturePyramidNetwork(widths, PYRAMID)
        self.out_channels = PYRAMID

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        """Features by level, "0" the finest, of normalised images (B, 3, H, W).

        Only what is here is computed in bfloat16: it has too few digits for the coordinates of boxes.
        """
        levels: OrderedDict[str, Tensor] = OrderedDict()
        with reduced_autocast(images.device):
            x = self.stem(images.contiguous(memory_format=torch.channels_last))
            for i, stage in enumerate(self.stages):
                levels[str(i)] = x = stage(x)
        return self.pyramid(OrderedDict((key, value.float()) for key, value in levels.items()))


def build_net(n_parts: int, segmenter: SegmentationNet) -> nn.Module:
    """A Mask R-CNN for ``n_parts`` classes on the encoder of ``segmenter``, untrained otherwise.

    It takes lists of normalised images, as torchvision's detectors do. Raises PerceptionError where there is no
    torchvision.
    """
    ops, detection = (torchvision_module(f"torchvision.{name}") for name in ("ops", "models.detection"))
    faster, mask = (torchvision_module(f"{detection.__name__}.{name}") for name in ("faster_rcnn", "mask_rcnn"))
    anchors = torchvision_module(f"{detection.__name__}.anchor_utils")
    levels = [str(i) for i in range(len(STRIDES))]
    return detection.MaskRCNN(
        _Backbone(segmenter),
        rpn_anchor_generator=anchors.AnchorGenerator(ANCHORS_PX, ((0.5, 1.0, 2.0),) * len(ANCHORS_PX)),
        rpn_pre_nms_top_n_train=600,
        rpn_post_nms_top_n_train=200,
        rpn_pre_nms_top_n_test=600,
        rpn_post_nms_top_n_test=300,
        rpn_batch_size_per_image=128,
        box_roi_pool=ops.MultiScaleRoIAlign(levels, 7, 2),
        box_head=faster.TwoMLPHead(PYRAMID * 7 * 7, REPRESENTATION),
        box_predictor=faster.FastRCNNPredictor(REPRESENTATION, n_parts + 1),
        box_batch_size_per_image=64,
        box_score_thresh=MIN_SCORE,
        mask_roi_pool=ops.MultiScaleRoIAlign(levels, 14, 2),
        mask_head=mask.MaskRCNNHeads(PYRAMID, (PYRAMID,) * 3, 1),
        mask_predictor=mask.MaskRCNNPredictor(PYRAMID, PYRAMID, n_parts + 1),
        image_mean=[0.0] * 3,
        image_std=[1.0] * 3,
        _skip_resize=True,
    )


def paste(soft: NDArray[np.float32], box: Array, scale: Array) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """A soft mask (M, M) that spans ``box`` as pixels, and the first of them (u, v), in an image ``scale`` times finer.

    ``box`` (u0, v0, u1, v1) is where the outline of the mask lies in the coarse image, integers at pixel centres.
    ``scale`` (2,) is along u and v.
    """
    low, high = ((box.reshape(2, 2) + 0.5) * scale - 0.5).astype(np.float64)
    first = np.maximum(np.ceil(low), 0).astype(int)
    width, height = np.maximum(np.floor(high).astype(int) - first + 1, 1)
    cell = (high - low) / soft.shape[0]  # pixels of the finer image that a cell of the mask is wide
    offset = (first - low) / cell - 0.5
    A = np.array([[1 / cell[0], 0, offset[0]], [0, 1 / cell[1], offset[1]]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    fine = cv2.warpAffine(soft, A, (int(width), int(height)), flags=how, borderMode=cv2.BORDER_REPLICATE)
    return fine > 0.5, (int(first[0]), int(first[1]))


class MaskRCNNSegmenter:
    """A trained Mask R-CNN with its score threshold; used like ``perception.segmentation.Segmenter``."""

    def __init__(self, net: Any, part_names: Sequence[str], min_score: float = MIN_SCORE) -> None:
        self.device = default_device()
        self.net = net.to(self.device).eval()
        self.part_names = tuple(part_names)
        self.min_score = min_score

    @classmethod
    def load(cls, weights_dir: Path, parts_dir: Path | None = None) -> MaskRCNNSegmenter:
        """The network kept in ``weights_dir``; raises PerceptionError when there is none or a mesh has changed."""
        path = weights_dir / WEIGHTS
        state, metadata = load_weights(path, parts_dir)
        names = list(metadata["parts"])
        try:
            net = build_net(len(names), SegmentationNet(len(names), **metadata["net"]))
            net.load_state_dict(state)
        except (KeyError, RuntimeError, TypeError) as error:
            raise PerceptionError(f"{path} holds another network than this version's; train again") from error
        return cls(net, names, metadata["min_score"])

    def detect(self, frame: Frame, scale: float = 1.0, min_score: float | None = None) -> list[Detection]:
        """The parts in a frame, best first, with masks in the frame's own pixels.

        ``scale`` is the frame's (see :func:`perception.standard_view.frame_scale`).
        """
        image, reduction = reduced(frame, REDUCTION / scale)
        return self.detect_reduced(image, reduction, np.array(reduction), min_score)

    def detect_reduced(
        self,
        image: NDArray[np.uint8],
        reduction: tuple[float, float] = (REDUCTION, REDUCTION),
        finer: Array | float = 1.0,
        min_score: float | None = None,
    ) -> list[Detection]:
        """The parts in an RGB image (H, W, 3) that is already reduced, their masks ``finer`` times as fine as it is.

        Detections below ``min_score`` (by default the segmenter's own) are left out. Centres are in frame pixels.
        """
        ops, lists = (torchvision_module(f"torchvision.{name}") for name in ("ops", "models.detection.image_list"))
        size = image.shape[:2]
        bottom, right = (-side % SIZE_DIVISOR for side in size)
        padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REFLECT_101)
        x = torch.from_numpy(normalise(np.asarray(padded, np.uint8))).permute(2, 0, 1)[None].to(self.device)
        with torch.inference_mode():  # without torchvision's own transform, which would resize the image
            images, features = lists.ImageList(x, [size]), self.net.backbone(x)
            proposals, _ = self.net.rpn(images, features)
            (found,), _ = self.net.roi_heads(features, proposals, images.image_sizes)
        enough = found["scores"] >= (self.min_score if min_score is None else min_score)
        kept = ops.nms(found["boxes"], found["scores"], DUPLICATE_IOU)
        kept = kept[enough[kept]].cpu().numpy()  # best first
        boxes, labels, masks, score = (found[key].cpu().numpy() for key in ("boxes", "labels", "masks", "scores"))
        finer, out = np.broadcast_to(np.asarray(finer, np.float64), (2,)), []
        for k in kept:
            mask, origin = paste(masks[k, 0], boxes[k].astype(np.float64), finer)
            mask, origin = _trimmed(mask, origin, np.array(image.shape[1::-1]) * finer)
            if mask.any():
                middle = (boxes[k, :2].astype(np.float64) + boxes[k, 2:]) / 2
                out.append(
                    Detection(
                        centre_px=(middle + 0.5) * reduction - 0.5,
                        score=float(score[k]),
                        class_probabilities=np.eye(len(self.part_names))[labels[k] - 1],
                        mask=mask,
                        mask_origin=origin,
                    )
                )
        return out


def _trimmed(
    mask: NDArray[np.bool_], origin: tuple[int, int], size: Array
) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """A mask without what is outside of an image of ``size`` (width, height)."""
    width, height = np.round(size).astype(int) - origin
    return np.ascontiguousarray(mask[: max(height, 0), : max(width, 0)]), origin
