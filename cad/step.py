"""Reads STEP files: triangles of every solid in metres, and the unit that the file declares.

The CAD kernel (Open CASCADE, through cascadio) runs as a process of its own with a time limit, so that no file can
take this process down. It converts every unit to millimetres itself and gives metres.
"""

from __future__ import annotations

import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import trimesh

from cad.meshes import ANGULAR_DEFLECTION_RAD, DEFLECTION_MM, MeshError
from cad.soup import Soup, soups_of

_BEGIN, _END = b"ISO-10303-21", b"END-ISO-10303-21"  # ISO 10303-21, 5.1: first and last token of a file
_PREFIXES = {"$": "m", ".MILLI.": "mm", ".CENTI.": "cm", ".MICRO.": "um"}
_CONVERTED = {"INCH": "in", "FOOT": "ft"}
_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_TIME_LIMIT_S = 120.0
_WORKER = Path(__file__).with_name("step_worker.py")


def read_step(data: bytes, name: str, *, time_limit_s: float = _TIME_LIMIT_S) -> list[Soup]:
    """The triangles in metres of every shape in a STEP file, placed as its assembly says.

    Triangles stay within DEFLECTION_MM of the surfaces. Raises MeshError, naming the file by ``name``, where the data
    are not STEP, end early, hold no surface, or where the kernel fails or takes longer than ``time_limit_s``.
    """
    if not data.lstrip().startswith(_BEGIN):
        raise MeshError(f"{name} is not a STEP file (it does not begin with {_BEGIN.decode()}); export the part again")
    if _END not in data[-4096:]:
        raise MeshError(f"{name} is cut short (it does not end with {_END.decode()}); copy or export it again")
    command = [sys.executable, "-P", str(_WORKER), str(DEFLECTION_MM), str(ANGULAR_DEFLECTION_RAD)]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=time_limit_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise MeshError(
            f"{name} took the CAD kernel longer than {time_limit_s:g} s; export the part alone, or as STL"
        ) from error
    if done.returncode < 0:
        raise MeshError(f"{name} crashed the CAD kernel (signal {-done.returncode}); export it again, or as STL")
    if done.returncode:
        raise MeshError(f"{name} cannot be read as STEP{_reason(done.stderr)}; export it again, or as STL")
    soups = soups_of(trimesh.load_scene(BytesIO(done.stdout), file_type="glb", process=False))
    if not soups:
        raise MeshError(f"{name} holds no solid and no surface (a drawing or a wire frame?); export the solid part")
    return soups


def declared_unit(data: bytes) -> str | None:
    """The unit of length that a STEP file's geometry is in (m, cm, mm, um, in or ft).

    None where the file names none, an unusual one, or several.
    """
    text = re.sub(r"\s+", "", data.decode("latin-1"))
    contexts = re.findall(r"GLOBAL_UNIT_ASSIGNED_CONTEXT\(\(([#\d,]+)\)\)", text)
    assigned = {number for context in contexts for number in re.findall(r"\d+", context)}
    found = set()
    for number, body in re.findall(r"#(\d+)=\(([^;]*\bLENGTH_UNIT\(\)[^;]*)\);", text):
        if number in assigned:
            found.add(_unit_of(body))
    return found.pop() if len(found) == 1 else None


def _unit_of(body: str) -> str | None:
    if metric := re.search(r"SI_UNIT\(([$.A-Z]+),\.METRE\.\)", body):
        return _PREFIXES.get(metric[1])
    if converted := re.search(r"CONVERSION_BASED_UNIT\('(\w+)'", body):
        return _CONVERTED.get(converted[1].upper())
    return None


def _reason(stderr: bytes) -> str:
    lines = _ANSI.sub("", stderr.decode("utf-8", "replace")).splitlines()
    lines = [line.strip(" *") for line in lines if "ERR" in line]
    return f" ({lines[0].removeprefix('ERR ')})" if lines else ""
