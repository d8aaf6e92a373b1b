import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.decompose import hull_of
from cad.parts import load_part
from cad.spatial import rotation_angle, rotation_z, transform
from cad.symmetry import find_symmetries, models_info


def box():
    return trimesh.creation.box((8e-3, 6e-3, 3e-3))


def cut_corner_box():
    corners = box().vertices
    cut = np.abs(corners - corners.max(axis=0)).max(axis=1) < 1e-9
    more = corners[cut] - np.diag([1.5e-3, 1.5e-3, 1.5e-3])
    return hull_of(np.concatenate([corners[~cut], more]))


def prism(sides):
    """Regular prism of the given number of sides, its axis along z."""
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([4e-3 * np.cos(angles), 4e-3 * np.sin(angles)], axis=1)
    return hull_of(np.array([[*p, z] for p in ring for z in (-1.5e-3, 1.5e-3)]))


def cone():
    return hull_of(np.concatenate([prism(48).vertices * [1, 1, 0], [[0, 0, 5e-3]]]))


def turned(mesh, seed):
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return mesh.copy().apply_transform(transform(R, [2e-3, -1e-3, 5e-3])), R


@pytest.mark.parametrize("seed", [None, 0, 1])
@pytest.mark.parametrize(
    ("make", "count"), [(box, 3), (lambda: trimesh.creation.box([5e-3] * 3), 23), (lambda: prism(3), 5)]
)
def test_discrete_groups_are_found_completely_in_any_orientation(make, count, seed):
    mesh = make()
    moved = mesh if seed is None else turned(mesh, seed)[0]
    found = find_symmetries(moved)
    assert len(found.discrete) == count
    assert found.continuous == ()
    for T in found.discrete:
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(T[:3, :3] @ moved.center_mass + T[:3, 3], moved.center_mass, atol=1e-9)


@pytest.mark.parametrize("seed", [None, 0, 1])
@pytest.mark.parametrize("make", [cut_corner_box, lambda: trimesh.util.concatenate([box()])])
def test_a_broken_symmetry_is_not_found(make, seed):
    mesh = make()
    expected = 3 if len(mesh.vertices) == 8 else 0
    moved = mesh if seed is None else turned(mesh, seed)[0]
    assert len(find_symmetries(moved).discrete) == expected


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize(("make", "flips"), [(lambda: prism(48), 1), (cone, 0)])
def test_round_parts_have_a_continuous_axis_and_at_most_a_flip(make, flips, seed):
    mesh, axis = make(), np.array([0.0, 0.0, 1.0])
    if seed is not None:
        mesh, R = turned(mesh, seed)
        axis = R @ axis
    found = find_symmetries(mesh)
    assert len(found.continuous) == 1
    assert abs(found.continuous[0].direction @ axis) == pytest.approx(1.0, abs=1e-4)
    assert len(found.discrete) == flips


def test_the_tolerance_decides_and_must_be_positive():
    mesh = trimesh.creation.box((8e-3, 7.9e-3, 3e-3))
    assert len(find_symmetries(mesh, 1e-4).discrete) == 7
    assert len(find_symmetries(mesh, 1e-5).discrete) == 3
    with pytest.raises(ValueError, match="positive"):
        find_symmetries(mesh, 0.0)


def test_models_info_is_in_millimetres_and_row_major():
    mesh = box().apply_translation([1e-3, 0, 0])
    info = models_info(mesh, find_symmetries(mesh))
    assert info["diameter"] == pytest.approx(np.sqrt(64 + 36 + 9))
    assert [info["min_x"], info["size_y"], info["size_z"]] == pytest.approx([-3, 6, 3])
    turns = [np.reshape(T, (4, 4)) for T in info["symmetries_discrete"]]
    half_turn = next(T for T in turns if rotation_angle(T[:3, :3], rotation_z(np.pi)) < 1e-6)
    np.testing.assert_allclose(half_turn[:3, 3], [2, 0, 0], atol=1e-6)


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_the_parts_have_no_proper_symmetry_but_mirror_in_y(name):
    part = load_part(name)
    stored = json.loads((part.folder / "symmetries.json").read_text())
    assert stored == models_info(part.mesh, find_symmetries(part.mesh))
    assert stored["symmetries_discrete"] == stored["symmetries_continuous"] == []
    mirrored = part.mesh.vertices * [1, -1, 1]
    np.testing.assert_allclose(mirrored.min(axis=0), part.mesh.bounds[0], atol=1e-8)
    assert abs(part.mesh.center_mass[1]) < 1e-8
