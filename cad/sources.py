"""Reads the bytes of mesh files (STL, OBJ, PLY, OFF) as triangles in the file's own numbers."""

from __future__ import annotations

import re
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh

from cad.meshes import MeshError
from cad.soup import Soup

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
        _check_stl(data, name)
    try:
        scene = trimesh.load_scene(BytesIO(data), file_type=suffix[1:], process=False, skip_materials=True)
    except Exception as error:  # the readers raise whatever their parsing runs into
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MeshError(f"{name} cannot be read as {suffix[1:].upper()} ({reason}); export it again") from error
    soups = []
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            soups.append(Soup(vertices=np.array(mesh.vertices, dtype=np.float64), faces=np.array(mesh.faces)))
    if not soups:
        raise MeshError(f"{name} has no triangles; export the part as a solid")
    for soup in soups:
        if soup.faces.min() < 0 or soup.faces.max() >= len(soup.vertices):
            raise MeshError(f"{name} has triangles of vertices that it does not hold (cut short?); export it again")
    return soups


def _check_stl(data: bytes, name: str) -> None:
    """An STL's own reader takes what there is; here its promise is held against its length."""
    if len(data) >= _STL_HEADER:
        promised = _STL_HEADER + _STL_FACET * struct.unpack_from("<I", data, _STL_HEADER - 4)[0]
        if len(data) == promised:
            return
    else:
        promised = _STL_HEADER
    if re.match(rb"\s*solid", data, re.IGNORECASE) and re.search(rb"facet", data[:4096], re.IGNORECASE):
        begun, ended = (len(re.findall(word, data, re.IGNORECASE)) for word in (rb"\bfacet\b", rb"\bendfacet\b"))
        if begun != ended or not re.search(rb"endsolid", data[-4096:], re.IGNORECASE):
            raise MeshError(f"{name} is cut short ({ended} complete facets, no endsolid); copy or export it again")
    elif len(data) < promised:
        raise MeshError(f"{name} is cut short or no STL ({len(data)} bytes of {promised}); copy or export it again")
