"""One crop of a frame and all that is known of it before its pose."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics
from perception.choice import CropContext
from perception.faces import Face
from perception.planar import on_plane
from perception.posenets import CropReading, Hypothesis
from perception.sighting import Sighting

CROP_PX = 256
HALF = 2
"""The networks see crops at half the camera's resolution."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CropView:
    """A crop (256, 256, 3) and its half (128, 128, 3) with their camera, the ray through the centre, the table, what
    the networks and the segmenter say of it, and the reprojection error of the frame's tags in pixels.
    """

    crop: NDArray[np.uint8]
    half: NDArray[np.uint8]
    ray: Array
    intrinsics: Intrinsics
    T_cam_table: Array
    reading: CropReading
    sighting: Sighting
    tag_rms_px: float

    @property
    def small(self) -> Intrinsics:
        """The camera of the half-size crop."""
        return self.intrinsics.downscaled(HALF)

    @property
    def context(self) -> CropContext:
        """What is known beside the hypotheses."""
        return CropContext(
            not_a_part=self.reading.not_a_part,
            entropy=_entropy(self.reading),
            segmenter_score=self.sighting.score,
            cut=self.sighting.cut,
            tag_rms_px=self.tag_rms_px,
        )

    def place(self, h: Hypothesis, face: Face) -> tuple[float, float]:
        """Where the hypothesis has the footprint's centre on the table, metres."""
        x, y = on_plane(h.centre_px, face.middle_m, self.small, self.T_cam_table)[:2]
        return float(x), float(y)


def _entropy(reading: CropReading) -> float:
    """Entropy in nats of J's hypotheses, given that there is a part; what is not listed counts as one more."""
    p = np.exp([h.classifier for h in reading.hypotheses])
    p = np.append(p, max(1.0 - p.sum() - reading.not_a_part, 1e-6))
    p = p[p > 0] / p.sum()
    return float(-(p * np.log(p)).sum())


def half_size(crop: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A crop (256, 256, 3) as the networks see it, (128, 128, 3)."""
    if crop.shape[:2] != (CROP_PX, CROP_PX):
        raise ValueError(f"a crop of {crop.shape[1]} x {crop.shape[0]} pixels; expected {CROP_PX} x {CROP_PX}")
    side = CROP_PX // HALF
    return np.asarray(cv2.resize(crop, (side, side), interpolation=cv2.INTER_AREA), np.uint8)
