"""``tagcell doctor``: what Tagcell needs of this machine, what is there, and the command that mends what is not."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from importlib import metadata

from twin.robot import TwinError

GL_PACKAGES = ("libegl1", "libopengl0", "libgl1-mesa-dri")
GL_COMMAND = f"apt-get update && apt-get install -y {' '.join(GL_PACKAGES)}"
_PROBE = "from scenes.gl import make_context; make_context(8, 8)"


def gl_works() -> bool:
    """Whether a frame can be rendered without a screen, tried in a process of its own."""
    return subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, check=False).returncode == 0


def install_gl() -> None:
    """Install the Debian packages for rendering without a screen.

    Raises TwinError with the one command to run where this process may not install packages or that failed.
    """
    may = hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("apt-get")
    prefix = "" if may else "sudo "
    advice = f"no OpenGL route for rendering without a screen; run: {prefix}sh -c '{GL_COMMAND}'"
    if not may:
        raise TwinError(advice)
    print(f"installing {' '.join(GL_PACKAGES)} for rendering without a screen", flush=True)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-qq"], ["apt-get", "install", "-y", "-qq", *GL_PACKAGES]):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise TwinError(f"{advice}\n(`{' '.join(command)}` failed: {done.stderr.strip()[-300:]})")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages whose results a scorecard depends on."""
    names = ("tagcell", "mujoco", "torch", "opencv-python-headless", "numpy", "scipy", "mink", "trimesh")
    return {"python": platform.python_version()} | {n: metadata.version(n) for n in names}


def doctor(fix: bool = False) -> dict[str, str]:
    """Check the machine; with ``fix`` install what is missing and may be installed.

    Raises TwinError on what is left, with the command that mends it.
    """
    report = versions()
    if not gl_works():
        if not fix:
            raise TwinError(
                f"no OpenGL route for rendering without a screen; run: tagcell doctor --fix, or: {GL_COMMAND}"
            )
        install_gl()
        if not gl_works():
            raise TwinError(
                f"rendering still fails after installing {' '.join(GL_PACKAGES)}; try MUJOCO_GL=osmesa with libosmesa6"
            )
    report["rendering"] = "works"
    report["cores"] = str(os.cpu_count())
    return report
