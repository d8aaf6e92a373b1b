"""``tagcell doctor``: what Tagcell needs of this machine, what is there, and the command that mends what is not."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from importlib import metadata

from scenes.photoreal import mitsuba_hint
from scenes.vulkan import VULKAN_PACKAGES
from twin.robot import TwinError

GL_PACKAGES = ("libegl1", "libopengl0", "libgl1-mesa-dri")
_PROBES = {"classic": "from scenes.gl import make_context; make_context(8, 8)"} | {
    domain: f"from scenes.domains import domain_problem; print(domain_problem({domain!r}), end='')"
    for domain in ("filament", "mitsuba")
}


def domain_state(domain: str) -> str:
    """What keeps a domain from being rendered, empty when nothing does; tried in a process of its own."""
    done = subprocess.run([sys.executable, "-c", _PROBES[domain]], capture_output=True, text=True, check=False)
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"the renderer ended with code {done.returncode}"])[-1]
    return done.stdout.strip()


def install(packages: tuple[str, ...], purpose: str) -> None:
    """Install Debian packages.

    Raises TwinError with the one command to run where this process may not install packages or that failed.
    """
    may = hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("apt-get")
    advice = f"{purpose} needs {' '.join(packages)}; run: {'' if may else 'sudo '}sh -c '{_command(packages)}'"
    if not may:
        raise TwinError(advice)
    print(f"installing {' '.join(packages)} for {purpose}", flush=True)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-qq"], ["apt-get", "install", "-y", "-qq", *packages]):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise TwinError(f"{advice}\n(`{' '.join(command)}` failed: {done.stderr.strip()[-300:]})")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages whose results a scorecard depends on."""
    names = ("tagcell", "mujoco", "torch", "opencv-python-headless", "numpy", "scipy", "mink", "trimesh")
    return {"python": platform.python_version()} | {n: metadata.version(n) for n in names}


def doctor(fix: bool = False) -> dict[str, str]:
    """Check the machine; with ``fix`` install what is missing and may be installed.

    Raises TwinError when nothing can be rendered, with the command that mends it. The other domains are optional:
    their lines in the report say what they need.
    """
    problems = {domain: domain_state(domain) for domain in _PROBES}
    if problems["classic"] and fix:
        install(GL_PACKAGES, "rendering without a screen")
        problems["classic"] = domain_state("classic")
    if problems["classic"]:
        raise TwinError(
            f"nothing can be rendered without a screen: {problems['classic']}\n"
            f"run: tagcell doctor --fix, or: {_command(GL_PACKAGES)}; else try MUJOCO_GL=osmesa with libosmesa6"
        )
    if problems["filament"] and fix:
        try:
            install(VULKAN_PACKAGES, "the filament domain")
            problems["filament"] = domain_state("filament")
        except TwinError as error:
            print(f"left out: {error}", file=sys.stderr)
    hint = " ".join(mitsuba_hint().split())
    return (
        versions()
        | {f"{domain} rendering": " ".join(problem.split()) or "works" for domain, problem in problems.items()}
        | ({"hint": hint} if hint else {})
        | {"cores": str(os.cpu_count())}
    )


def _command(packages: tuple[str, ...]) -> str:
    return f"apt-get update && apt-get install -y {' '.join(packages)}"
