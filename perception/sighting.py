"""What the segmenter says of one crop, in the crop's own pixels: evidence that the crop networks do not have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Intrinsics
from perception.segmentation import Detection


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """A detection as a crop shows it.

    ``mask`` (h, w) bool is on the pixels of the crop's reduced camera; ``cut`` says whether the mask touches the border
    of the frame.
    """

    score: float
    class_probabilities: dict[str, float]
    mask: NDArray[np.bool_]
    cut: bool

    def overlap(self, silhouette: NDArray[np.bool_]) -> float:
        """Intersection over union of the mask with a silhouette (h, w) in the same pixels."""
        union = np.count_nonzero(self.mask | silhouette)
        return np.count_nonzero(self.mask & silhouette) / union if union else 0.0


def sighting_of(
    detection: Detection, part_names: Sequence[str], frame_camera: Intrinsics, crop_camera: Intrinsics
) -> Sighting:
    """A detection in a frame of ``frame_camera`` as a crop of ``crop_camera``, both of one pinhole, shows it.

    ``part_names`` are the segmenter's, in the order of its class probabilities.
    """
    f, c = frame_camera, crop_camera
    height, width = detection.mask.shape
    inside, at = [], []
    for size, focal, centre, frame_focal, frame_centre, reduction, first, length in (
        (c.width, c.fx, c.cx, f.fx, f.cx, detection.reduction[0], detection.mask_origin[0], width),
        (c.height, c.fy, c.cy, f.fy, f.cy, detection.reduction[1], detection.mask_origin[1], height),
    ):
        pixel = (np.arange(size) - centre) / focal * frame_focal + frame_centre
        cell = np.floor((pixel + 0.5) / reduction).astype(int) - first
        inside.append((cell >= 0) & (cell < length))
        at.append(np.clip(cell, 0, length - 1))
    mask = detection.mask[np.ix_(at[1], at[0])] & inside[1][:, None] & inside[0][None, :]
    last = np.add(detection.mask_origin, (width, height))
    size = np.floor_divide((f.width, f.height), detection.reduction)
    return Sighting(
        score=detection.score,
        class_probabilities={name: float(p) for name, p in zip(part_names, detection.class_probabilities, strict=True)},
        mask=mask,
        cut=bool(min(detection.mask_origin) <= 0 or (last >= size).any()),
    )
