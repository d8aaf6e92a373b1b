"""A camera window in Mitsuba's terms."""

from __future__ import annotations

from copy import copy
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics
from scenes.errors import SceneError
from scenes.scene_export import SceneDescription

MM = 1000.0
NEAR_M, FAR_M = 0.01, 100.0
CAM_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's camera looks along +z with x to the left and y up."""


class View:
    """A window of a camera, and the frame that Mitsuba works in: millimetres from where the window looks.

    ``T_world_cam`` (4, 4) is the camera's pose, ``parts`` (3,) the middle of the parts in the world, or of everything
    where there are none.

    Mitsuba leaves a gap of 1e-4 of a point's coordinates between a surface and the rays that start there; so far from
    the origin or in metres, small parts would lose their shadows.
    """

    def __init__(self, intrinsics: Intrinsics, T_world_cam: Array, scene: SceneDescription) -> None:
        self.intrinsics = intrinsics
        self.T_world_cam = T_world_cam
        middle = [(intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2]
        ray = T_world_cam[:3, :3] @ intrinsics.rays(middle)
        parts = [geom for geom in scene.geoms if geom.instance >= 0] or scene.geoms
        self.parts = np.mean([geom.T_world_geom[:3, 3] for geom in parts], axis=0) if parts else np.zeros(3)
        self._origin = T_world_cam[:3, 3] + ray * ((self.parts - T_world_cam[:3, 3]) @ T_world_cam[:3, 2])
        self._moved = np.concatenate([geom.T_world_geom for geom in scene.geoms]) if scene.geoms else np.zeros((4, 4))

    def through(self, window: Intrinsics) -> View:
        """The same scene and frame through another window of the camera."""
        other = copy(self)
        other.intrinsics = window
        return other

    def signature(self, seed: int) -> bytes:
        """Differs where the seed, the window, the camera or anything's pose differs."""
        i = self.intrinsics
        head = [seed, i.width, i.height, i.fx, i.cx, i.cy]
        return np.concatenate([head, self.T_world_cam.ravel(), self._moved.ravel()]).tobytes()

    def local(self, points: Array) -> Array:
        """World points (..., 3) in metres to Mitsuba's frame."""
        return (points - self._origin) * MM

    def depth_m(self, local: NDArray[np.float32]) -> Array:
        """Metres along the camera's z of points (..., 3) in Mitsuba's frame."""
        return (local.astype(np.float64) / MM + self._origin - self.T_world_cam[:3, 3]) @ self.T_world_cam[:3, 2]

    def sensor(self, mi: ModuleType, window: Intrinsics, samples: int) -> dict[str, Any]:
        """The camera through ``window``; one sample is that of the pixel's centre."""
        width, height = window.width, window.height
        T_local_cam = self.T_world_cam @ CAM_FROM_MITSUBA
        T_local_cam[:3, 3] = self.local(T_local_cam[:3, 3])
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(2 * np.degrees(np.arctan(width / (2 * window.fx)))),
            "principal_point_offset_x": ((width - 1) / 2 - window.cx) / width,
            "principal_point_offset_y": ((height - 1) / 2 - window.cy) / height,
            "near_clip": NEAR_M * MM,
            "far_clip": FAR_M * MM,
            "to_world": mi.ScalarTransform4f(T_local_cam),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": samples, "jitter": samples > 1},
        }


def check_square(intrinsics: Intrinsics) -> None:
    """Raise SceneError for a window whose pixels are not square."""
    if abs(intrinsics.fx / intrinsics.fy - 1) > 1e-6:
        raise SceneError(
            f"focal lengths {intrinsics.fx} and {intrinsics.fy} differ; the mitsuba domain draws square pixels only, "
            "use one focal length or the classic domain"
        )
