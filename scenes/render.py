"""Rendering behind one protocol: colour, part instances and depth of any camera window.

What is drawn depends on the compiled model and its data as they are when ``render`` is called: visible geoms,
materials, lights, environment and camera. So one model serves every renderer, and changes at run time take effect.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Intrinsics
from scenes.camera import CAMERA
from scenes.errors import SceneError
from scenes.gl import mujoco

What = Literal["rgb", "instances", "depth"]
ALL: tuple[What, ...] = ("rgb", "instances", "depth")
VISUAL_GROUPS = (0, 1, 2)
"""Geom groups that are drawn; collision geoms live in group 3, and a group of 5 hides a geom at run time."""
COLLISION_GROUP, HIDDEN_GROUP = 3, 5


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """What was asked for of one window, (H, W) each; the rest is None.

    ``rgb`` (H, W, 3) grey levels of an ideal linear sensor that saturates at 255: uint8, or float32 that may exceed 255
    where the renderer tells more. ``instances`` int16, the index of the part instance seen in a pixel or -1;
    ``depth_m`` float32, distance along the camera's z in metres.
    """

    rgb: NDArray[np.uint8] | NDArray[np.float32] | None = None
    instances: NDArray[np.int16] | None = None
    depth_m: NDArray[np.float32] | None = None

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The colours (H, W, 3) as they are shown; raises ValueError when they were not asked for."""
        if self.rgb is None:
            raise ValueError("this rendering has no colours; ask for 'rgb'")
        if self.rgb.dtype == np.uint8:
            return self.rgb.view(np.uint8)
        return np.rint(np.clip(self.rgb, 0, 255)).astype(np.uint8)


class Renderer(Protocol):
    """Draws one compiled model."""

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """Draw the scene as ``camera`` sees it through a window with these intrinsics; ``data`` must be forwarded."""
        ...

    def close(self) -> None:
        """Free what the renderer holds; it cannot be used afterwards."""
        ...


def check_window(intrinsics: Intrinsics, size: tuple[int, int]) -> None:
    """Raise SceneError for a window that is larger than ``size`` (width, height), which a renderer was made for."""
    width, height = intrinsics.width, intrinsics.height
    if width > size[0] or height > size[1]:
        raise SceneError(
            f"a window of {width} x {height} does not fit into this renderer's {size[0]} x {size[1]}; "
            "make the renderer with a larger max_width and max_height"
        )


def instance_of_geom(model: mujoco.MjModel) -> NDArray[np.int16]:
    """(ngeom,) index of the part instance whose visual geom this is, -1 for every other geom."""
    found = (re.fullmatch(r"part_(\d+)_visual", model.geom(i).name) for i in range(model.ngeom))
    return np.array([int(match[1]) if match else -1 for match in found], np.int16)
