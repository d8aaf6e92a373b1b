"""Finds the parts in a whole frame: instance masks, centres and classes at a quarter of the camera's resolution.

An encoder-decoder with three outputs, after Panoptic-DeepLab (Cheng et al. 2020) and CenterNet (Zhou et al. 2019): a
foreground mask, for each foreground pixel the offset to its instance's centre, and a heatmap of centres with class
logits. Foreground pixels whose vote falls near a peak of the heatmap form an instance. The input is normalised by its
local mean and contrast, so that exposure and shading matter little.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from cad.spatial import Array
from perception.encoding import encoded
from perception.estimates import Frame, PerceptionError
from perception.layers import default_device
from perception.standard_view import reduced
from perception.weight_files import load_weights

REDUCTION = 4
"""Frame pixels along each side of a pixel that the network sees."""
HEAT_STRIDE = 4
OFFSET_STRIDE = 2
NETWORK_STRIDE = 16
"""Input sizes must be whole multiples of this; frames are padded."""
OFFSET_SCALE_PX = 8.0
NORMALISATION_WINDOW_PX = 97
"""Side of the square, about 26 mm, over which brightness and contrast are normalised."""
CONTRAST_FLOOR = 8.0
"""Added to the local standard deviation in encoded levels, so that noise on flat areas is not blown up."""
WEIGHTS = "segmentation.safetensors"


@dataclass(frozen=True, kw_only=True)
class Detection:
    """One part found in a frame.

    ``centre_px`` (2,) is in pixels of the frame, the point above the footprint's centre at half the part's height.
    ``class_probabilities`` (P,) is in the order of the segmenter's ``part_names``. ``mask`` (h, w) bool covers the
    pixels of the reduced frame from ``mask_origin`` (u, v) on; one of them is ``reduction`` (u, v) pixels of the frame.
    """

    centre_px: Array
    score: float
    class_probabilities: Array
    mask: NDArray[np.bool_]
    mask_origin: tuple[int, int]
    reduction: tuple[float, float] = (REDUCTION, REDUCTION)


@dataclass(frozen=True, kw_only=True)
class DecodeConfig:
    """Thresholds that turn the network's outputs into instances; lengths in reduced pixels.

    They are low: what is found is looked at again by the crop networks, which know "not a part"; what is missed is
    lost. On validation frames ``score`` 0.15 finds 98.8 % of the parts and 1.2 of something else a frame, 0.3 finds
    97.4 % and 0.7.
    """

    peak: float = 0.1
    mask: float = 0.5
    score: float = 0.15
    vote_radius_px: float = 12.0
    min_area_px: int = 20
    max_peaks: int = 100

    def __post_init__(self) -> None:
        for name in ("peak", "mask", "score"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be between 0 and 1")


def normalise(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """An RGB image (H, W, 3), encoded, minus its local mean brightness, over its local contrast."""
    rgb = encoded(image)
    gray = rgb.mean(axis=2)
    side = (NORMALISATION_WINDOW_PX, NORMALISATION_WINDOW_PX)
    mean = cv2.blur(gray, side, borderType=cv2.BORDER_REFLECT_101)
    variance = cv2.blur(gray * gray, side, borderType=cv2.BORDER_REFLECT_101) - mean * mean
    scale = 1.0 / (np.sqrt(np.maximum(variance, 0.0)) + CONTRAST_FLOOR)
    return (rgb - mean[..., None]) * scale[..., None]


def _convolution(inputs: int, outputs: int, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


@dataclass(frozen=True)
class Outputs:
    """What the network says about a batch of (H, W) images, as float32 logits and pixels."""

    mask: Tensor  # (B, H, W)
    offset_px: Tensor  # (B, 2, H / 2, W / 2), reduced pixels
    heat: Tensor  # (B, H / 4, W / 4)
    classes: Tensor  # (B, P, H / 4, W / 4)


class SegmentationNet(nn.Module):
    """Encoder to stride 16, decoder back to stride 2 with a skip at each stage; ``shape`` tells how to build it again.

    ``widths`` are the channels at the four strides, ``residuals`` the blocks at the last; 1.1 M parameters.
    """

    def __init__(self, n_parts: int, widths: Sequence[int] = (16, 32, 64, 128), residuals: int = 3) -> None:
        super().__init__()
        a, b, c, d = widths
        self.shape = {"widths": list(widths), "residuals": residuals}
        self.stage2 = _convolution(3, a, stride=2, kernel=5)
        self.stage4 = nn.Sequential(_convolution(a, b, stride=2), _convolution(b, b))
        self.stage8 = nn.Sequential(_convolution(b, c, stride=2), _Residual(c))
        self.stage16 = nn.Sequential(_convolution(c, d, stride=2), *(_Residual(d) for _ in range(residuals)))
        self.to8 = _convolution(d, c, kernel=1)
        self.at8 = _convolution(c, c)
        self.to4 = _convolution(c, b, kernel=1)
        self.at4 = _convolution(b, b)
        self.to2 = _convolution(b, a, kernel=1)
        self.at2 = _convolution(a, 24)
        self.pixel_head = nn.Conv2d(24, 4 + 2, 1)
        self.centre_head = nn.Sequential(_convolution(b, b), nn.Conv2d(b, 1 + n_parts, 1))
        # Parts are rare: masks and centres start from a small probability.
        final = self.centre_head[1]
        assert isinstance(final, nn.Conv2d) and final.bias is not None and self.pixel_head.bias is not None
        nn.init.constant_(final.bias[:1], -4.0)
        nn.init.constant_(self.pixel_head.bias[:4], -2.0)

    def forward(self, images: Tensor) -> Outputs:
        """Outputs for normalised images (B, 3, H, W), H and W whole multiples of 16."""
        x2 = self.stage2(images)
        x4 = self.stage4(x2)
        x8 = self.stage8(x4)
        x16 = self.stage16(x8)
        y8 = self.at8(_double(self.to8(x16)) + x8)
        y4 = self.at4(_double(self.to4(y8)) + x4)
        y2 = self.at2(_double(self.to2(y4)) + x2)
        pixels, centres = self.pixel_head(y2).float(), self.centre_head(y4).float()
        return Outputs(
            mask=functional.pixel_shuffle(pixels[:, :4], 2)[:, 0],
            offset_px=pixels[:, 4:] * OFFSET_SCALE_PX,
            heat=centres[:, 0],
            classes=centres[:, 1:],
        )


def _double(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


def reduced_autocast(device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """bfloat16 where the device computes it natively."""
    return torch.autocast(device.type, torch.bfloat16)


def decode(
    outputs: Outputs,
    index: int,
    config: DecodeConfig,
    reduction: tuple[float, float] = (REDUCTION, REDUCTION),
) -> list[Detection]:
    """Instances of image ``index`` of a batch, best first."""
    heat = outputs.heat[index].sigmoid()
    # Peaks are local maxima over 5 x 5 heat cells, 5 mm: parts at rest beside each other have centres further apart.
    maxima = functional.max_pool2d(heat[None, None], 5, 1, 2)[0, 0] == heat
    rows, columns = (axis.cpu().numpy() for axis in torch.nonzero(maxima & (heat > config.peak), as_tuple=True))
    heat = heat.cpu().numpy()
    order = np.argsort(-heat[rows, columns], kind="stable")[: config.max_peaks]
    order = [q for i, q in enumerate(order) if not _near(rows, columns, q, order[:i])]
    rows, columns = rows[order], columns[order]
    mask = outputs.mask[index].sigmoid().cpu().numpy()
    v, u = np.nonzero(mask > config.mask)
    if not len(rows) or not len(v):
        return []
    offset = outputs.offset_px[index].cpu().numpy()
    cell_v, cell_u = v // OFFSET_STRIDE, u // OFFSET_STRIDE
    half = (OFFSET_STRIDE - 1) / 2
    votes = offset[:, cell_v, cell_u].T + np.stack([cell_u, cell_v], axis=1) * OFFSET_STRIDE + half  # (F, 2)
    peaks = np.stack([columns, rows], axis=1) * HEAT_STRIDE + (HEAT_STRIDE - 1) / 2  # (Q, 2)
    squared = ((votes[:, None] - peaks[None]) ** 2).sum(axis=-1)  # (F, Q)
    owner = np.where(squared.min(axis=1) < config.vote_radius_px**2, squared.argmin(axis=1), -1)
    probabilities = outputs.classes[index].softmax(dim=0).cpu().numpy()
    found = []
    for q in range(len(peaks)):
        mine = owner == q
        if np.count_nonzero(mine) < config.min_area_px:
            continue
        inside = _largest_blob(u[mine], v[mine])
        if np.count_nonzero(inside) < config.min_area_px:
            continue
        ui, vi = u[mine][inside], v[mine][inside]
        score = float(heat[rows[q], columns[q]] * mask[vi, ui].mean())
        if score < config.score:
            continue
        classes = probabilities[:, vi // HEAT_STRIDE, ui // HEAT_STRIDE].mean(axis=1)
        origin = int(ui.min()), int(vi.min())
        blob = np.zeros((vi.max() - origin[1] + 1, ui.max() - origin[0] + 1), bool)
        blob[vi - origin[1], ui - origin[0]] = True
        centre = np.median(votes[mine][inside], axis=0).astype(np.float64)
        found.append(
            Detection(
                centre_px=(centre + 0.5) * np.array(reduction) - 0.5,
                score=score,
                class_probabilities=classes.astype(np.float64),
                mask=blob,
                mask_origin=origin,
                reduction=reduction,
            )
        )
    return sorted(found, key=lambda detection: -detection.score)


def _near(rows: NDArray[np.int64], columns: NDArray[np.int64], peak: int, better: NDArray[np.int64]) -> bool:
    """Whether a peak is within two cells of a better one: neighbouring cells can tie, at bfloat16 often."""
    return bool(np.any((abs(rows[better] - rows[peak]) <= 2) & (abs(columns[better] - columns[peak]) <= 2)))


def _largest_blob(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of the pixels (u, v) are in their largest connected piece."""
    u, v = u - u.min(), v - v.min()
    image = np.zeros((v.max() + 1, u.max() + 1), np.uint8)
    image[v, u] = 1
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(image)
    return np.asarray(labels)[v, u] == 1 + int(statistics[1:, cv2.CC_STAT_AREA].argmax())


class Segmenter:
    """A trained network with its thresholds."""

    def __init__(self, net: SegmentationNet, part_names: Sequence[str], config: DecodeConfig) -> None:
        self.device = default_device()
        self.net = net.to(self.device, memory_format=torch.channels_last).eval()  # pyright: ignore[reportCallIssue]
        self.part_names = tuple(part_names)
        self.config = config

    @classmethod
    def load(cls, weights_dir: Path, parts_dir: Path | None = None) -> Segmenter:
        """The segmenter kept in ``weights_dir``; raises PerceptionError when there is none or a mesh has changed."""
        path = weights_dir / WEIGHTS
        state, metadata = load_weights(path, parts_dir)
        names = list(metadata["parts"])
        try:
            net = SegmentationNet(len(names), **metadata["net"])
            net.load_state_dict(state)
        except (KeyError, RuntimeError, TypeError, ValueError) as error:
            raise PerceptionError(f"{path} holds another network than this version's; train again") from error
        return cls(net, names, DecodeConfig(**metadata.get("decode", {})))

    def detect(self, frame: Frame, scale: float = 1.0) -> list[Detection]:
        """The parts in a frame, best first, those cut by the image's border included.

        ``scale`` is the frame's (see :func:`perception.standard_view.frame_scale`).
        """
        height, width = frame.image.shape[:2]
        least = REDUCTION / scale * NETWORK_STRIDE
        if min(height, width) < least:
            raise PerceptionError(
                f"a frame of {width} x {height} pixels is too small; at least {least:.0f} on each side are needed"
            )
        return self.detect_reduced(*reduced(frame, REDUCTION / scale))

    def detect_reduced(
        self, image: NDArray[np.uint8], reduction: tuple[float, float] = (REDUCTION, REDUCTION)
    ) -> list[Detection]:
        """The parts in an RGB image (H, W, 3) that is already reduced; centres are still in frame pixels."""
        height, width = image.shape[:2]
        bottom, right = -height % NETWORK_STRIDE, -width % NETWORK_STRIDE
        padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REFLECT_101)
        x = torch.from_numpy(normalise(np.asarray(padded, np.uint8))).permute(2, 0, 1)[None].to(self.device)
        with torch.inference_mode(), reduced_autocast(self.device):
            outputs = self.net(x.contiguous(memory_format=torch.channels_last))
        seen = Outputs(
            mask=outputs.mask[:, :height, :width],
            offset_px=outputs.offset_px,
            heat=outputs.heat,
            classes=outputs.classes,
        )
        return decode(seen, 0, self.config, reduction)
