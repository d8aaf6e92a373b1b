"""Rendering through a lens that distorts: a pinhole renderer's images, resampled."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Intrinsics
from scenes.camera import CAMERA
from scenes.gl import mujoco
from scenes.lens import STRAIGHT, Lens, Warp
from scenes.render import ALL, Renderer, Rendering, What


class DistortedRenderer:
    """A renderer whose ``lens`` may be changed at any time; it is used as it is while the lens does not distort.

    Instances and depth are drawn twice as fine as they are returned, so that no label is off by more than a quarter of
    a pixel on either axis. Nothing larger than ``max_width`` x ``max_height`` is drawn at once.
    """

    def __init__(self, renderer: Renderer, *, max_width: int, max_height: int) -> None:
        self.lens: Lens = STRAIGHT
        self._renderer, self._tile = renderer, (max_width, max_height)

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """See :class:`scenes.render.Renderer`."""
        if self.lens.straight:
            return self._renderer.render(data, intrinsics, what, camera)
        warp = Warp(self.lens, intrinsics)
        rgb = "rgb" in what
        labels: tuple[What, ...] = tuple(name for name in what if name != "rgb")
        seen = self._tiles(data, warp.source, ("rgb",), camera) if rgb else {}
        fine = self._tiles(data, warp.label_source, labels, camera) if labels else {}
        return Rendering(
            rgb=warp.colours(seen["rgb"]) if rgb else None,
            instances=warp.labels(fine["instances"]) if "instances" in what else None,
            depth_m=warp.labels(fine["depth_m"]) if "depth" in what else None,
        )

    def close(self) -> None:
        """Free the pinhole renderer."""
        self._renderer.close()

    def _tiles(
        self, data: mujoco.MjData, window: Intrinsics, what: tuple[What, ...], camera: str
    ) -> dict[Literal["rgb", "instances", "depth_m"], NDArray[Any]]:
        """A window of any size, drawn in pieces."""
        rows: dict[Any, list[NDArray[Any]]] = {}
        for y in range(0, window.height, self._tile[1]):
            height = min(self._tile[1], window.height - y)
            row: dict[Any, list[NDArray[Any]]] = {}
            for x in range(0, window.width, self._tile[0]):
                piece = window.crop(x, y, min(self._tile[0], window.width - x), height)
                drawn = self._renderer.render(data, piece, what, camera)
                for name, image in vars(drawn).items():
                    if image is not None:
                        row.setdefault(name, []).append(image.copy())
            for name, images in row.items():
                rows.setdefault(name, []).append(np.concatenate(images, axis=1))
        return {name: np.concatenate(parts) for name, parts in rows.items()}
