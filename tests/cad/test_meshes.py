import numpy as np
import pytest
import trimesh

from cad.meshes import (
    MeshError,
    check_mesh,
    mesh_from_triangles,
    surface_samples,
    write_mesh,
)
from cad.parts import hash_file


def box(size=(8e-3, 6e-3, 3e-3)):
    return trimesh.creation.box(size)


def test_meshes_that_bound_no_solid_are_refused():
    mesh = box()
    with pytest.raises(MeshError, match="watertight"):
        check_mesh(trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False))
    with pytest.raises(MeshError, match="normals outwards"):
        check_mesh(trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False))
    twisted = mesh.faces.copy()
    twisted[0] = twisted[0, ::-1]
    with pytest.raises(MeshError, match="wound both ways"):
        check_mesh(trimesh.Trimesh(mesh.vertices, twisted, process=False))
    with pytest.raises(MeshError, match="no triangles"):
        mesh_from_triangles(np.zeros((0, 3)), np.zeros((0, 3), int))


def test_equal_vertices_of_separate_faces_are_merged():
    soup = box().triangles.reshape(-1, 3)
    mesh = mesh_from_triangles(soup, np.arange(len(soup)).reshape(-1, 3))
    assert len(mesh.vertices) == 8
    assert mesh.volume == pytest.approx(8e-3 * 6e-3 * 3e-3)


def test_a_written_mesh_reads_back_and_is_the_same_file_every_time(tmp_path):
    mesh = trimesh.creation.icosphere(radius=4e-3)
    write_mesh(mesh, tmp_path / "a.ply")
    write_mesh(mesh.copy(), tmp_path / "b" / "c.ply")
    assert hash_file(tmp_path / "a.ply") == hash_file(tmp_path / "b" / "c.ply")
    again = trimesh.load_mesh(tmp_path / "a.ply", process=False)
    check_mesh(again)
    assert again.volume == pytest.approx(mesh.volume, rel=1e-6)


def test_surface_samples_lie_on_the_surface_with_its_normals_and_repeat_with_the_seed():
    mesh = box()
    points, normals = surface_samples(mesh, 500, np.random.default_rng(3))
    half = mesh.extents / 2
    on_face = np.abs(np.abs(points) - half) < 1e-12
    assert on_face.any(axis=1).all()
    np.testing.assert_allclose((normals * points).sum(axis=1), (np.abs(normals) * half).sum(axis=1))
    np.testing.assert_array_equal(points, surface_samples(mesh, 500, np.random.default_rng(3))[0])
    share = (np.abs(normals[:, 2]) > 0.5).mean()
    assert share == pytest.approx(2 * 48 / mesh.area * 1e-6, abs=0.07)
