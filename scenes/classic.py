"""MuJoCo's own rasteriser behind the renderers' protocol."""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Intrinsics
from scenes.camera import CAMERA, set_intrinsics
from scenes.errors import SceneError
from scenes.gl import make_context, mujoco
from scenes.render import ALL, VISUAL_GROUPS, Rendering, What, check_window, instance_of_geom


class ClassicRenderer:
    """MuJoCo's rasteriser. One context is made for the largest window and reused for all smaller ones.

    ``samples`` is the number of samples a pixel in colour frames; instances and depth are always of pixel centres.
    """

    def __init__(self, model: mujoco.MjModel, *, max_width: int, max_height: int, samples: int = 4) -> None:
        self._model = model
        self._size = (max_width, max_height)
        model.vis.global_.offwidth, model.vis.global_.offheight = self._size
        model.vis.quality.offsamples = samples
        self._gl = make_context(max_width, max_height)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        _drop_stencil(self._context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nsite + model.nlight + 64)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in VISUAL_GROUPS for group in range(6)]
        self._option.sitegroup[:] = False
        self._instance_of_geom = instance_of_geom(model)
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False  # its own hook may come when OpenGL is gone already; this one comes before
        atexit.register(self._free)

    def render(
        self,
        data: mujoco.MjData,
        intrinsics: Intrinsics,
        what: tuple[What, ...] = ALL,
        camera: str = CAMERA,
    ) -> Rendering:
        """See :class:`Renderer`. Raises SceneError for a window larger than the renderer was made for."""
        if not self._free.alive:
            raise SceneError("this renderer was closed; make a new ClassicRenderer")
        check_window(intrinsics, self._size)
        set_intrinsics(self._model, intrinsics, camera)
        self._gl.make_current()
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        view.fixedcamid = self._model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, view, everything, self._scene)
        rect = mujoco.MjrRect(0, 0, intrinsics.width, intrinsics.height)
        rgb = self._draw_rgb(rect) if "rgb" in what else None
        instances = depth = None
        if "instances" in what or "depth" in what:
            colours, z = self._draw_ids(rect)
            instances = self._instances(colours) if "instances" in what else None
            depth = self._depth(z) if "depth" in what else None
        return Rendering(rgb=rgb, instances=instances, depth_m=depth)

    def close(self) -> None:
        """Free the context, which otherwise happens when the renderer is collected; closing twice is harmless."""
        self._free()

    def __enter__(self) -> ClassicRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw_rgb(self, rect: mujoco.MjrRect) -> NDArray[np.uint8]:
        rgb = np.empty((rect.height, rect.width, 3), np.uint8)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, None, rect, self._context)
        return np.ascontiguousarray(rgb[::-1])

    def _draw_ids(self, rect: mujoco.MjrRect) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Id colours (H, W, 3) and the depth buffer (H, W), bottom row first."""
        flags = self._scene.flags
        colours = np.empty((rect.height, rect.width, 3), np.uint8)
        z = np.empty((rect.height, rect.width), np.float32)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        with self._one_sample():
            mujoco.mjr_render(rect, self._scene, self._context)
            mujoco.mjr_readPixels(colours, z, rect, self._context)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        return colours, z

    @contextmanager
    def _one_sample(self) -> Iterator[None]:
        """Draw straight into the buffer that colour frames are averaged into, of one sample a pixel.

        Ids and depth are of pixel centres, the same from either buffer; this one takes less than half the time.
        """
        context = self._context
        before = context.offFBO, context.offSamples
        if context.offSamples:
            context.offFBO, context.offSamples = context.offFBO_r, 0
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        try:
            yield
        finally:
            context.offFBO, context.offSamples = before
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)

    def _instances(self, colours: NDArray[np.uint8]) -> NDArray[np.int16]:
        """Instance indices (H, W) from id colours (H, W, 3): red + 256 green + 65536 blue = scene geom + 1."""
        ids: NDArray[Any] = colours[::-1, :, 0]
        if self._scene.ngeom > 254:
            ids = ids + (colours[::-1, :, 1].astype(np.uint16) << 8)
        table = np.full(self._scene.ngeom + 1, -1, np.int16)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = self._instance_of_geom[geom.objid]
        return np.take(table, ids)

    def _depth(self, z: NDArray[np.float32]) -> NDArray[np.float32]:
        """Metres (H, W) from the reversed depth buffer (1 near, 0 far), bottom row first."""
        extent = self._model.stat.extent
        near, far = self._model.vis.map.znear * extent, self._model.vis.map.zfar * extent
        depth = z[::-1] * np.float32(far - near)
        depth += np.float32(near)
        return np.divide(np.float32(near * far), depth, out=depth)


def _drop_stencil(context: mujoco.MjrContext) -> None:
    """Give a new context's buffers depth without a stencil, which only reflections use.

    The same pixels from half the bytes: an eighth of a frame's time.
    """
    from OpenGL import GL  # its platform is chosen where MuJoCo's is, and missing where nothing can be drawn

    buffers = (
        (context.offFBO, context.offDepthStencil, context.offSamples),
        (context.offFBO_r, context.offDepthStencil_r, 0),
    )
    for framebuffer, depth, samples in buffers:
        if not framebuffer:
            continue
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, framebuffer)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_STENCIL_ATTACHMENT, GL.GL_RENDERBUFFER, 0)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, depth)
        size = context.offWidth, context.offHeight
        GL.glRenderbufferStorageMultisample(GL.GL_RENDERBUFFER, samples, GL.GL_DEPTH_COMPONENT32F, *size)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_RENDERBUFFER, depth)


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    gl.make_current()
    context.free()
    gl.free()
