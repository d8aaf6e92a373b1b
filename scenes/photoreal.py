"""Mitsuba 3 as it can be used on this machine (extra ``photoreal``).

Two of its variants draw the same scene: ``llvm_ad_rgb`` where a usable LLVM is found, several times faster, else
``scalar_rgb``, which needs nothing.
"""

from __future__ import annotations

import ctypes.util
import os
import re
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from scenes.errors import SceneError

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
LLVM_MAJOR = 19
"""The LLVM that is looked for; 14 is refused, and 15 and 16 end the process when they compile."""
FASTER = "apt-get install -y libllvm19"


def mitsuba_problem() -> str:
    """What keeps this machine from path tracing and the command that mends it; empty when nothing does."""
    if find_spec("mitsuba") is None:
        return "the mitsuba domain needs Mitsuba 3, which is not installed; run\n  pip install 'tagcell[photoreal]'"
    return ""


def mitsuba_hint() -> str:
    """What would make path tracing faster on this machine; empty when nothing would."""
    if mitsuba_problem() or usable_llvm(os.environ.get(LLVM_VARIABLE, "")):
        return ""
    return f"path tracing is several times faster with LLVM {LLVM_MAJOR}; run\n  {FASTER}"


def usable_llvm(wanted: str) -> str:
    """The LLVM library to compile with, "" for none; ``wanted`` is a path that the user asked for ("" = any)."""
    if wanted:
        version = re.search(r"LLVM(?:-|\.so\.)(\d+)", os.path.basename(os.path.realpath(wanted)))
        return wanted if version and int(version[1]) >= LLVM_MAJOR else ""
    return ctypes.util.find_library(f"LLVM-{LLVM_MAJOR}") or ""


@cache
def load_mitsuba() -> ModuleType:
    """Mitsuba with its fastest usable variant chosen; raises SceneError with the command to run when it is missing."""
    problem = mitsuba_problem()
    if problem:
        raise SceneError(problem)
    library = usable_llvm(os.environ.pop(LLVM_VARIABLE, ""))
    if library:
        os.environ[LLVM_VARIABLE] = library
    mitsuba = import_module("mitsuba")
    try:
        mitsuba.set_variant("llvm_ad_rgb" if library else "scalar_rgb")
    except ImportError:
        mitsuba.set_variant("scalar_rgb")
    return mitsuba


def draws_pixels(mitsuba: ModuleType) -> bool:
    """Whether its variant works on many rays at once, and so draws pixels from all over an image in one go."""
    return not mitsuba.variant().startswith("scalar")
