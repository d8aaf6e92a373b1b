"""Annotated pictures of what perception saw and what the controller chose to do about it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cad.parts import Part
from cad.spatial import Array, Intrinsics, apply, inverse
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.overlay import Image, draw_lines, draw_overlay

PAD = (255, 0, 255)  # RGB
NEAR_M = 0.012
"""A grasp is drawn into the insets of the parts that lie this near to it."""


def annotate(
    frame: Frame,
    estimate: FrameEstimate,
    parts: Mapping[str, Part],
    chosen: Array | None = None,
    opening_m: float = 0.0,
) -> Image:
    """The picture of :func:`perception.overlay.draw_overlay` with the chosen grasp in it; RGB.

    ``chosen`` is ``T_cam_tcp`` (4, 4) of the grasp to come and ``opening_m`` the opening of the fingers.
    """

    def grasp(image: Image, camera: Intrinsics, part: PartEstimate | None) -> None:
        if chosen is None or (part and np.linalg.norm(chosen[:3, 3] - part.T_cam_part[:3, 3]) >= NEAR_M):
            return
        draw_lines(image, camera, _pads(chosen, opening_m), PAD, 2 if part else 1, closed=True)

    return draw_overlay(frame, estimate, parts, grasp)


def grasp_in_camera(T_base_tcp: Array, T_base_board: Array, T_cam_board: Array) -> Array:
    """``T_cam_tcp`` of a grasp given in the robot's base frame."""
    return T_cam_board @ inverse(T_base_board) @ T_base_tcp


def _pads(T_cam_tcp: Array, opening_m: float) -> list[Array]:
    """Both pads as seen from above, in ``cam``: a rectangle each, at the opening of the approach."""
    corners = []
    for side in (-1, 1):
        near, far = side * opening_m / 2, side * (opening_m / 2 + 0.0025)
        corners.append(
            apply(T_cam_tcp, np.array([[near, -0.003, 0], [near, 0.003, 0], [far, 0.003, 0], [far, -0.003, 0]]))
        )
    return corners
