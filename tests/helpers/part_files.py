"""Files of parts to take in: samples, boxes, surfaces with faults, and what must come of them."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cad.intake import read_part
from cad.meshes import check_mesh
from cad.parts import CadError

PARTS = Path(__file__).parents[2] / "examples" / "parts"


@cache
def taken(name):
    return read_part(PARTS / f"{name}.step")


@cache
def clean():
    """The bracket's vertices in mm and its triangles: no symmetry, holes, a bend."""
    mesh = taken("bracket").mesh
    return 1e3 * np.array(mesh.vertices), np.array(mesh.faces)


def written(path, *pieces):
    """A PLY of meshes (vertices, faces) as they are, one after the other."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, first, strict=False)])
    trimesh.Trimesh(vertices, faces, process=False).export(path, vertex_normal=False)
    return path


def box(size=(8, 6, 3), at=(0, 0, 0)):
    mesh = trimesh.creation.box(size)
    return np.array(mesh.vertices) + at, np.array(mesh.faces)


def mirrored(piece):
    """The same box with the other diagonals."""
    vertices, faces = piece
    middle = vertices.mean(axis=0)
    return (vertices - middle) * [-1, 1, 1] + middle, faces[:, ::-1]


def same(intake, vertices, faces, *, ppm=1, um=0.01):
    """A part must have the volume and the bounding box of the clean mesh, given in mm."""
    check_mesh(intake.mesh)
    expected = trimesh.Trimesh(1e-3 * vertices, faces, process=False)
    assert intake.mesh.volume == pytest.approx(expected.volume, rel=1e-6 * ppm)
    np.testing.assert_allclose(intake.mesh.bounds, expected.bounds, atol=1e-6 * um)
    np.testing.assert_allclose(intake.size_mm, 1e3 * expected.extents, atol=1e-3 * um)


def refusal(path, **options):
    """What a file that is refused is answered with, in one line that names it."""
    with pytest.raises(CadError) as caught:
        read_part(path, **options)
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    return message
