"""The physically based domain: MuJoCo's Filament renderer behind the renderers' protocol.

Levels are linear in radiance at a fixed exposure: no tone curve, no automatic exposure, no dither, so that a picture is
the same to the byte every time.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from cad.spatial import Array, Intrinsics
from scenes.camera import CAMERA, camera_pose
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.render import ALL, Rendering, What, check_window, instance_of_geom
from scenes.vulkan import INSTALL_VULKAN, vulkan_problem

if TYPE_CHECKING:
    from scenes.filament_view import FilamentView

INSTALL_FILAMENT = "pip install --upgrade mujoco"
TILE = 2048
"""Larger windows are drawn in squares of this many pixels a side, which bounds the memory that a render takes."""


@cache
def filament_problem() -> str:
    """What keeps this machine from rendering with Filament and the command that mends it; empty when nothing does.

    Without a Vulkan device Filament would end the process, so it is not started before this was asked.
    """
    try:
        import_module("mujoco.mjrf")
        import_module("mujoco.studio._studio")
    except ImportError as error:
        return (
            f"cannot render the filament domain: MuJoCo's Filament does not load ({error}); run\n  {INSTALL_FILAMENT}"
        )
    problem = vulkan_problem()
    return f"cannot render the filament domain: {problem}; run\n  {INSTALL_VULKAN}" if problem else ""


class FilamentRenderer:
    """MuJoCo's Filament. Meshes and textures are uploaded once; all else is what model and data say at each render.

    ``rgb`` is float32, linear in light, and tells levels up to 1.5 times saturation in steps of 1.5. Colours are shaded
    once a pixel and antialiased by coverage (see ``scenes.coverage``); instances and depth are of pixel centres. The
    first lamp that casts shadows shines in parallel rays, and its size makes them soft; the others cast none. Where no
    environment is on, the headlight's ambient colour comes from all around. The sky behind everything is black.
    """

    def __init__(self, model: mujoco.MjModel, *, max_width: int, max_height: int) -> None:
        """Raises SceneError with the command to run when Filament cannot draw here."""
        problem = filament_problem()
        if problem:
            raise SceneError(problem)
        from scenes.filament_view import FilamentView

        self._model, self._size = model, (max_width, max_height)
        self._instance_of_id = np.concatenate([[-1], instance_of_geom(model)]).astype(np.int16)
        self._view: FilamentView | None = FilamentView(model)

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """See :class:`Renderer`. Raises SceneError for a window larger than the renderer was made for."""
        if self._view is None:
            raise SceneError("this renderer was closed; make a new FilamentRenderer")
        check_window(intrinsics, self._size)
        T_world_cam = camera_pose(self._model, data, camera)
        if not np.isclose(np.linalg.det(T_world_cam[:3, :3]), 1.0):
            raise SceneError(f"camera {camera!r} has no pose; forward the data first (mj_forward)")
        self._view.update(data)
        rows = [[vars(self._draw(self._view, tile, T_world_cam, what)) for tile in row] for row in _tiles(intrinsics)]
        return Rendering(
            **{
                name: np.concatenate([np.concatenate([tile[name] for tile in row], axis=1) for row in rows])
                for name, image in rows[0][0].items()
                if image is not None
            }
        )

    def close(self) -> None:
        """Free what is on the device; closing twice is harmless."""
        self._view = None

    def _draw(self, view: FilamentView, window: Intrinsics, T_world_cam: Array, what: tuple[What, ...]) -> Rendering:
        view.aim(window, T_world_cam)
        return Rendering(
            rgb=view.levels() if "rgb" in what else None,
            instances=np.take(self._instance_of_id, view.ids()) if "instances" in what else None,
            depth_m=view.depth() if "depth" in what else None,
        )

    def __enter__(self) -> FilamentRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _tiles(window: Intrinsics) -> list[list[Intrinsics]]:
    """Rows of windows that together are one window."""
    return [
        [
            window.crop(x, y, min(TILE, window.width - x), min(TILE, window.height - y))
            for x in range(0, window.width, TILE)
        ]
        for y in range(0, window.height, TILE)
    ]
