"""What perception says about a frame: plain data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics

ACCEPTED = "accepted"
NOT_A_PART, OTHER_PART = "not a part", "unexpected part"
"""Verdicts on what is not to be picked, however well it is seen."""
AMBIGUOUS, POOR_CONTOUR = "ambiguous", "poor contour match"
"""Verdicts on what another look may tell."""


class PerceptionError(Exception):
    """Root of the errors that ``perception`` raises."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One camera image: ``image`` (H, W, 3) uint8 RGB, its intrinsics and the time it was exposed, in seconds."""

    image: NDArray[np.uint8]
    intrinsics: Intrinsics
    time_s: float

    @cached_property
    def half(self) -> NDArray[np.uint8]:
        """The image with every two by two pixels made one; an odd last row or column is left out."""
        return halved(self.image)

    @cached_property
    def quarter(self) -> NDArray[np.uint8]:
        """The half image halved again."""
        return halved(self.half)


def halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (H, W, 3) half as large by area averaging, (H // 2, W // 2, 3)."""
    height, width = (size // 2 for size in image.shape[:2])
    even = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


@dataclass(frozen=True, kw_only=True)
class PoseAlternative:
    """A pose that a view leaves open: part, stable pose, ``T_cam_part`` (4, 4), and its probability among them all."""

    part: str
    stable_pose: int
    T_cam_part: Array
    probability: float


@dataclass(frozen=True, kw_only=True)
class PartEstimate:
    """One part seen in a frame.

    ``score`` is the probability that the pose is right and good enough to act on. ``covariance`` (6, 6) is of
    (translation m, rotation vector rad), both in ``cam``. ``verdict`` is "accepted" or the reason why not.
    ``raw_T_cam_part`` is the pose before stable-pose, plane and contour refinement. ``mask`` (h, w) bool covers the
    frame's pixels from ``mask_origin`` (u, v) on. ``alternatives`` are the poses that the view leaves open, this one
    first; more than one says that the view cannot tell.
    """

    part: str
    T_cam_part: Array
    stable_pose: int
    score: float
    verdict: str = ACCEPTED
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    raw_T_cam_part: Array | None = None
    mask: NDArray[np.bool_] | None = None
    mask_origin: tuple[int, int] = (0, 0)
    details: dict[str, float] = field(default_factory=dict)
    alternatives: tuple[PoseAlternative, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the estimate may be acted on."""
        return self.verdict == ACCEPTED


@dataclass(frozen=True, kw_only=True)
class FrameEstimate:
    """All parts seen in a frame and the camera pose read from the tags in it."""

    T_cam_board: Array
    parts: tuple[PartEstimate, ...]
    tags_seen: int
    tag_rms_px: float
    seconds: dict[str, float] = field(default_factory=dict)


class PoseEstimator(Protocol):
    """Turns a frame into poses."""

    def estimate(self, frame: Frame) -> FrameEstimate:
        """Poses of every part in the frame; raises PerceptionError when the frame cannot be used at all."""
        ...
