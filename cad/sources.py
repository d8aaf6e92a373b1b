"""Reads the bytes of mesh files (STL, OBJ, PLY, OFF) as triangles in the file's own numbers."""

from __future__ import annotations

import re
import struct
from io import BytesIO
from pathlib import Path

import trimesh

from cad.meshes import MeshError
from cad.soup import Soup, soups_of

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off")
CAD_SUFFIXES = (".step", ".stp")
_STL_HEADER, _STL_FACET = 84, 50  # bytes


def read_bytes(path: Path) -> bytes:
    """The content of a part's file.

    Raises MeshError, with the remedy, for a file that is not there, is a folder, is empty or may not be read, and for
    a suffix that is not one of CAD_SUFFIXES and MESH_SUFFIXES.
    """
    try:
        if path.is_dir():
            raise MeshError(f"{path} is a folder; name the part's file in it")
        if path.suffix.lower() not in CAD_SUFFIXES + MESH_SUFFIXES:
            known = ", ".join(CAD_SUFFIXES + MESH_SUFFIXES)
            raise MeshError(f"{path} has suffix {path.suffix!r}; use one of {known}")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise MeshError(f"there is no file {path}; check the spelling and the folder") from error
    except OSError as error:
        raise MeshError(f"{path} cannot be read: {error.strerror or error}; check its permissions") from error
    if not data.strip():
        raise MeshError(f"{path} is empty; copy or export it again")
    return data


def read_triangles(data: bytes, suffix: str, name: str) -> list[Soup]:
    """The triangles of every object in a mesh file, in its own numbers; ``name`` is for messages.

    Raises MeshError for data that are no such mesh, end early or hold no triangle.
    """
    suffix = suffix.lower()
    if suffix == ".stl":
        data = _whole_stl(data, name)
    elif suffix == ".ply":
        header, end, rest = data.partition(b"end_header")
        data = _as_utf8(header) + end + rest
    else:
        data = _as_utf8(data)
    try:
        scene = trimesh.load_scene(BytesIO(data), file_type=suffix[1:], process=False, skip_materials=True)
    except Exception as error:  # the readers raise whatever their parsing runs into
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MeshError(f"{name} cannot be read as {suffix[1:].upper()} ({reason}); export it again") from error
    soups = soups_of(scene)
    if not soups:
        raise MeshError(f"{name} has no triangles; export the part as a solid")
    if suffix == ".off":
        _check_off(data, sum(len(soup.faces) for soup in soups), name)
    for soup in soups:
        if soup.faces.min() < 0 or soup.faces.max() >= len(soup.vertices):
            raise MeshError(f"{name} has triangles of vertices that it does not hold (cut short?); export it again")
    return soups


def _as_utf8(text: bytes) -> bytes:
    """Names and comments come in any encoding; the readers take one."""
    return text.decode("utf-8", "replace").encode()


def _whole_stl(data: bytes, name: str) -> bytes:
    """An STL without what follows its triangles; its reader would take part of one, so it is measured first."""
    promised = _STL_HEADER
    if len(data) >= _STL_HEADER:
        promised += _STL_FACET * struct.unpack_from("<I", data, _STL_HEADER - 4)[0]
    if len(data) != promised and re.match(rb"\s*solid\b", data, re.IGNORECASE) and b"facet" in data[:4096].lower():
        begun, ended = (len(re.findall(word, data, re.IGNORECASE)) for word in (rb"\bfacet\b", rb"\bendfacet\b"))
        if begun != ended or b"endsolid" not in data[-4096:].lower():
            raise MeshError(f"{name} is cut short ({ended} complete facets, no endsolid); copy or export it again")
        return _as_utf8(data)
    if len(data) < promised:
        raise MeshError(f"{name} is cut short or no STL ({len(data)} bytes of {promised}); copy or export it again")
    return data[:promised]


def _check_off(data: bytes, triangles: int, name: str) -> None:
    """An OFF names its polygons up front; none gives less than one triangle."""
    numbers = re.sub(rb"#.*", b"", data).split()[1:4]
    if len(numbers) == 3 and triangles < int(numbers[1]):
        raise MeshError(f"{name} is cut short ({triangles} of {int(numbers[1])} faces); copy or export it again")
