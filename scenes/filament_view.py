"""One camera's pictures of a model in Filament: colours, geom ids and depth of any window."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.spatial import BASLER, Array, Intrinsics
from scenes.coverage import antialias
from scenes.filament_scene import HEADROOM, SCALE, FilamentScene
from scenes.gl import mujoco

# isort: split
from mujoco import mjrf

_RGB, _FLOAT = mjrf.PixelFormat.PIXEL_FORMAT_RGB8, mjrf.PixelFormat.PIXEL_FORMAT_R32F
_MODE = mjrf.DrawMode
SHIFTS = (-0.125, 0.125)
SAMPLES = np.array([(x + s, y + s) for s in SHIFTS for y in (-0.25, 0.25) for x in (-0.25, 0.25)])
"""(8, 2) pixels right and down of the centre: two grids of 2 x 2, with 4 different places along either axis."""


REACH = (0.02 + BASLER.width / 2 / BASLER.fx, 0.02 + BASLER.height / 2 / BASLER.fy)
"""Tangents of half the angles of the camera's whole view, with room for windows that go a little beyond the frame."""
LARGEST_VIEW = 16384
"""Pixels along each side of the largest view that Vulkan's drivers draw; a larger one would end the process."""
MARGIN = 1
"""Pixels drawn round a window, whose colours the antialiasing of its border needs."""
_INSIDE = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))


class FilamentView:
    """``update`` and ``aim`` it, then ask for pictures; every one is of the whole window, its top row first."""

    def __init__(self, model: mujoco.MjModel) -> None:
        config = mjrf.ContextConfig()
        config.graphics_api = mjrf.GraphicsApi.GRAPHICS_API_VULKAN
        with _silent():
            self._context = mjrf.Context(config)
        self._model = model
        self._scene = FilamentScene(self._context, model)
        self._targets: dict[mjrf.PixelFormat, tuple[mjrf.RenderTarget, mjrf.ReadRequest]] = {}

    def update(self, data: mujoco.MjData) -> None:
        """Show the model and its data as they are now."""
        self._scene.update(data)

    def aim(self, window: Intrinsics, T_world_cam: Array) -> None:
        """Look through a window of a camera at ``T_world_cam`` (4, 4, OpenCV's axes)."""
        size = window.width + 2 * MARGIN, window.height + 2 * MARGIN
        self._window = window.crop(-MARGIN, -MARGIN, *size)
        self._T_world_cam = T_world_cam
        self._seen: NDArray[np.float32] | None = None

    def levels(self) -> NDArray[np.float32]:
        """(H, W, 3) grey levels, antialiased: 255 saturates the sensor."""
        colours = self._draw(self._window, _MODE.DRAW_MODE_DEFAULT, _RGB)
        return antialias(colours, self._centres(), self._samples(), SAMPLES) * np.float32(HEADROOM)

    def ids(self) -> NDArray[np.uint16]:
        """(H, W) 1 + the geom seen at pixel centres, 0 for none."""
        colours = self._draw(self._window, _MODE.DRAW_MODE_SEGMENTATION_BY_ID, _RGB)[_INSIDE]
        return colours[..., :2].astype(np.uint16) @ np.array([1, 256], np.uint16)

    def depth(self) -> NDArray[np.float32]:
        """(H, W) metres along the camera's z at pixel centres, that of the far plane where there is nothing."""
        return self._centres()[_INSIDE]

    def _centres(self) -> NDArray[np.float32]:
        if self._seen is None:
            self._seen = self._depth(self._window)
        return self._seen

    def _samples(self) -> NDArray[np.float32]:
        """(8, H + 2, W + 2) the depth ``SAMPLES`` away from pixel centres."""
        grids = [self._depth(_doubled(self._window, shift)) for shift in SHIFTS]
        return np.stack([grid[row::2, column::2] for grid in grids for row in (0, 1) for column in (0, 1)])

    def _depth(self, window: Intrinsics) -> NDArray[np.float32]:
        near, far = (np.float32(plane) for plane in self._planes)
        return near * far / (near + self._draw(window, _MODE.DRAW_MODE_DEPTH, _FLOAT) * (far - near))

    @property
    def _planes(self) -> tuple[float, float]:
        extent = self._model.stat.extent
        return self._model.vis.map.znear * extent, self._model.vis.map.zfar * extent

    def _draw(self, window: Intrinsics, mode: mjrf.DrawMode, pixels: mjrf.PixelFormat) -> NDArray[Any]:
        target, read, image = self._target(window, pixels)
        request = mjrf.RenderRequest()
        request.scene, request.target, request.draw_mode = self._scene.scene, target, mode
        left, top, width, height = _whole(window)
        request.camera = self._camera(window.crop(left, top, width, height))
        request.viewport = mjrf.Rect(left=left, bottom=window.height - top - height, width=width, height=height)
        request.post_processing = request.reflections = request.skybox = request.haze = False
        request.shadows = mode == _MODE.DRAW_MODE_DEFAULT
        self._context.wait_for_frame(self._context.render([request], [read]))
        return image

    def _target(
        self, window: Intrinsics, pixels: mjrf.PixelFormat
    ) -> tuple[mjrf.RenderTarget, mjrf.ReadRequest, NDArray[Any]]:
        """Where pictures of a pixel format are drawn, and a new array that the next one is read into."""
        height, width = window.height, window.width
        shape, kind = ((height, width, 3), np.uint8) if pixels == _RGB else ((height, width), np.float32)
        image = np.zeros(shape, kind)
        if pixels not in self._targets:
            target = self._context.create_render_target(mjrf.RenderTargetConfig(color_format=pixels))
            self._targets[pixels] = target, mjrf.ReadRequest(target=target)
        target, read = self._targets[pixels]
        target.resize(width, height)
        read.set_buffer(image)
        return target, read, image

    def _camera(self, window: Intrinsics) -> mjrf.Camera:
        T = self._T_world_cam
        near, far = (SCALE * plane for plane in self._planes)
        left, right = (near * (u - window.cx) / window.fx for u in (-0.5, window.width - 0.5))
        top, bottom = (near * (window.cy - v) / window.fy for v in (-0.5, window.height - 0.5))
        return mjrf.Camera(
            pos=(SCALE * T[:3, 3]).astype(np.float32),
            forward=T[:3, 2].astype(np.float32),
            up=-T[:3, 1].astype(np.float32),
            frustum_center=(left + right) / 2,
            frustum_width=(right - left) / 2,
            frustum_bottom=bottom,
            frustum_top=top,
            frustum_near=near,
            frustum_far=far,
        )


def _whole(window: Intrinsics) -> tuple[int, int, int, int]:
    """Left, top, width and height, in a window's pixels, of the camera's whole view round it.

    Filament fits shadow maps to what it is told to draw. It is told to draw the whole view, of which only the window
    lies in the target, so that shadows are the same in every window. A view of too many pixels is the window alone.
    """
    half_width = math.ceil(max(REACH[0] * window.fx, window.cx + 1, window.width - window.cx))
    half_height = math.ceil(max(REACH[1] * window.fy, window.cy + 1, window.height - window.cy))
    if 2 * max(half_width, half_height) > LARGEST_VIEW:
        return 0, 0, window.width, window.height
    return math.floor(window.cx) - half_width, math.floor(window.cy) - half_height, 2 * half_width, 2 * half_height


def _doubled(window: Intrinsics, shift: float) -> Intrinsics:
    """A window of twice the resolution, ``shift`` pixels of the coarse one further right and down."""
    return Intrinsics(
        width=2 * window.width,
        height=2 * window.height,
        fx=2 * window.fx,
        fy=2 * window.fy,
        cx=2 * (window.cx - shift) + 0.5,
        cy=2 * (window.cy - shift) + 0.5,
    )


@contextmanager
def _silent() -> Iterator[None]:
    """Keep Filament from telling standard output about the device it found."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
