"""Headless OpenGL: a working route is chosen before MuJoCo is imported, so ``from scenes.gl import mujoco``.

MuJoCo reads ``MUJOCO_GL`` once, at import, and fails there with an unrelated message when the library behind it is
missing. Here the libraries are probed first. Where no route works MuJoCo is imported without OpenGL, so that physics
still runs, and the first attempt to render raises a SceneError with the command that mends it.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from collections.abc import Callable
from typing import Any

from scenes.errors import SceneError

VARIABLE = "MUJOCO_GL"
INSTALL_EGL = "apt-get install -y libegl1 libopengl0 libgl1-mesa-dri"
INSTALL_OSMESA = "apt-get install -y libosmesa6"
_EGL_PLATFORM_DEVICE = 0x313F
_OFF = "disable"


def _egl_works() -> bool:
    """Whether EGL opens a display without a screen, on any of its devices."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libOpenGL.so.0")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query_address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query_address or not display_address:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(query_address)
    get_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(display_address)
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    if not query(16, devices, ctypes.byref(count)):
        return False
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    for device in devices[: count.value]:
        display = get_display(_EGL_PLATFORM_DEVICE, device, None)
        if display and egl.eglInitialize(display, None, None):
            return True
    return False


def _osmesa_works() -> bool:
    """Whether the off-screen Mesa library loads."""
    name = ctypes.util.find_library("OSMesa")
    if name is None:
        return False
    try:
        return hasattr(ctypes.CDLL(name), "OSMesaCreateContextExt")
    except OSError:
        return False


ROUTES: dict[str, tuple[Callable[[], bool], str]] = {
    "egl": (_egl_works, INSTALL_EGL),
    "osmesa": (_osmesa_works, INSTALL_OSMESA),
}
"""Route -> (probe, the command that makes it work on Debian). Tried in this order; EGL also reaches a GPU."""


def choose_route(wanted: str, routes: dict[str, tuple[Callable[[], bool], str]]) -> tuple[str, str]:
    """The value for ``MUJOCO_GL`` and the problem, empty when there is none.

    ``wanted`` is what the user asked for ("" = anything); a route that is not in ``routes`` is left to MuJoCo.
    """
    if wanted and wanted not in routes:
        return wanted, ""
    for name in [wanted] if wanted else routes:
        if routes[name][0]():
            return name, ""
    command = routes[wanted][1] if wanted else INSTALL_OSMESA
    asked = (
        f"{VARIABLE}={wanted} was asked for but its library is missing" if wanted else "no headless OpenGL was found"
    )
    return _OFF, f"cannot render: {asked}; run\n  {command}"


def _prepare() -> str:
    """Point MuJoCo and PyOpenGL at a route that works; returns the problem when there is none."""
    route, problem = choose_route(os.environ.get(VARIABLE, "").lower().strip(), ROUTES)
    os.environ[VARIABLE] = route
    if sys.platform == "linux" and route in ROUTES:
        os.environ.setdefault("PYOPENGL_PLATFORM", route)
    return problem


PROBLEM = _prepare()

import mujoco  # noqa: E402  (MuJoCo reads the environment when it is imported)
from mujoco import rollout  # noqa: E402, F401


def make_context(width: int, height: int) -> Any:
    """A current OpenGL context for frames of up to ``width`` x ``height`` pixels.

    Raises SceneError with the command to run when this machine has no headless OpenGL.
    """
    if PROBLEM:
        raise SceneError(PROBLEM)
    try:
        context = mujoco.GLContext(width, height)
        context.make_current()
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        raise SceneError(
            f"cannot render: {VARIABLE}={os.environ[VARIABLE]} gives no OpenGL context ({error}); "
            f"try {VARIABLE}=osmesa after\n  {INSTALL_OSMESA}"
        ) from error
    return context
