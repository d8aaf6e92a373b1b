import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.equivalence import symmetries_from_json
from cad.parts import load_part
from cad.spatial import apply, rotation_angle, rotation_z, transform
from cad.symmetry import MAX_ORDER, default_tolerance_m, deviation_m, find_symmetries, models_info


def hull(points):
    return trimesh.convex.convex_hull(np.asarray(points, dtype=np.float64))


def rings(*rings_mm):
    """Convex solid between rings (angles, radius, height) about z, in mm."""
    return hull([[r * np.cos(a), r * np.sin(a), z] for angles, r, z in rings_mm for a in angles])


def evenly(n):
    return 2 * np.pi * np.arange(n) / n


def prism(sides, radius=4.0, height=3.0):
    return rings((evenly(sides), radius, 0), (evenly(sides), radius, height))


def uneven(seed, count):
    """Angles of a circle cut at random, no gap over 9 degrees."""
    return np.concatenate([evenly(40), np.random.default_rng(seed).uniform(0, 2 * np.pi, count)])


def block(*size):
    return trimesh.creation.box(size)


def box_at(size, centre):
    return block(*size).apply_translation(centre)


def cylinder(radius, height, sections=64):
    return trimesh.creation.cylinder(radius, height, sections=sections)


def minus(solid, *holes):
    return trimesh.boolean.difference([solid, *holes])


def plus(*solids):
    return trimesh.boolean.union(solids)


def alternate_corners():
    """Every other corner of a cube."""
    return np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 2.0


def nut():
    return minus(prism(6, 2.3, 1.6), cylinder(1.0, 9.0, 60))


def screw():
    head, shank = cylinder(1.9, 2.0, 96), cylinder(1.0, 6.0).apply_translation([0, 0, -3.5])
    return minus(plus(head, shank), prism(6, 0.87, 3.0))


def propeller():
    blades = [box_at((3.0, 0.8, 1.2), (2.5, 0.6, 0.4)) for _ in range(3)]
    return plus(
        cylinder(1.5, 2.0, 60),
        *(b.apply_transform(transform(rotation_z(a))) for b, a in zip(blades, evenly(3), strict=True)),
    )


def gear():
    teeth = [box_at((0.6, 0.3, 1.5), (3.0, 0, 0)) for _ in range(17)]
    return plus(
        cylinder(3.0, 1.5, 128),
        *(t.apply_transform(transform(rotation_z(a))) for t, a in zip(teeth, evenly(17), strict=True)),
    )


def pin_header():
    return plus(block(10.16, 2.54, 2.54), *(box_at((0.64, 0.64, 11.5), (x, 0, 1.2)) for x in (-3.8, -1.3, 1.3, 3.8)))


def bracket():
    return plus(box_at((6, 4, 1), (0, 0, 0.5)), box_at((1, 4, 5), (-2.5, 0, 2.5)))


def equal_moments(height_factor, angles=None):
    """A cylinder or prism whose three moments of inertia are equal: height = factor x radius."""
    angles = evenly(96) if angles is None else angles
    return rings((angles, 3.0, 0), (angles, 3.0, 3.0 * height_factor))


def finer(mesh, times):
    for _ in range(times):
        mesh = mesh.subdivide()
    return mesh


# Solid in millimetres, elements of its group (the turns of a continuous axis not counted), continuous axes.
SOLIDS = {
    "box": (lambda: block(8, 6, 3), 4, 0),
    "square prism": (lambda: block(6, 6, 3), 8, 0),
    "cube": (lambda: block(5, 5, 5), 24, 0),
    "tetrahedron": (lambda: hull(alternate_corners()), 12, 0),
    "octahedron": (lambda: hull(np.concatenate([np.eye(3), -np.eye(3)]) * 3), 24, 0),
    "triangular prism": (lambda: prism(3), 6, 0),
    "heptagonal prism": (lambda: prism(7), 14, 0),
    "octagonal prism of equal moments": (lambda: equal_moments(1.6, evenly(8)), 16, 0),
    "hex nut": (nut, 12, 0),
    "gear of 17 teeth": (gear, 34, 0),
    "propeller": (propeller, 3, 0),
    "pin header": (pin_header, 2, 0),
    "bracket": (bracket, 1, 0),
    "ellipsoid": (lambda: trimesh.creation.icosphere(3, 1.0).apply_transform(np.diag([3, 2, 1, 1.0])), 4, 0),
    "screw with a hexagonal socket": (screw, 6, 0),
    "cylinder": (lambda: cylinder(2.0, 5.0), 2, 1),
    "cylinder of equal moments": (lambda: equal_moments(np.sqrt(3)), 2, 1),
    "uneven cylinder": (lambda: rings((uneven(0, 60), 3, 0), (uneven(1, 30), 3, 4)), 2, 1),
    "uneven cylinder of equal moments": (lambda: rings((uneven(0, 60), 3, 0), (uneven(1, 30), 3, 5.196)), 2, 1),
    "fine cylinder": (lambda: finer(cylinder(2.0, 5.0, 120), 1), 2, 1),
    "tube": (lambda: minus(cylinder(1.0, 0.9, 48), cylinder(0.7, 2.0, 40)), 2, 1),
    "rod": (lambda: cylinder(0.3, 9.0), 2, 1),
    "cone": (lambda: rings((evenly(64), 4, 0), ([0], 0, 5)), 1, 1),
    "hull of the screw": (lambda: screw().convex_hull, 1, 1),
    "ball": (lambda: trimesh.creation.icosphere(4, 3.0), 1, 2),
    "ball of rings": (lambda: trimesh.creation.uv_sphere(radius=3.0, count=[48, 48]), 1, 2),
}
# Each is broken by 0.1 mm.
BROKEN = {
    "cube": (lambda: block(5, 5, 5.1), 8, 0),
    "square prism": (lambda: block(6, 6.1, 3), 4, 0),
    "notched box": (lambda: minus(block(8, 6, 3), box_at((0.2, 0.2, 0.2), (4, 3, 1.5))), 1, 0),
    "hex nut": (lambda: minus(nut(), box_at((0.2, 3, 3), (2.3, 0, 0.8))), 2, 0),
    "flat on a cylinder": (lambda: minus(cylinder(2, 5), box_at((1, 4, 9), (2.4, 0, 0))), 2, 0),
    "hole in a cylinder": (lambda: minus(cylinder(2, 5), cylinder(0.3, 0.2).apply_translation([1, 0, 2.5])), 1, 0),
    "one pin of a header": (lambda: plus(pin_header(), box_at((0.64, 0.64, 0.2), (3.8, 0, 6.95))), 1, 0),
}
# The others have groups of the same kinds.
SLOW = {"tetrahedron", "cube", "octahedron", "triangular prism", "square prism", "octagonal prism of equal moments"}
SLOW |= {"gear of 17 teeth", "heptagonal prism", "propeller", "pin header", "ellipsoid", "ball of rings"}
SLOW |= {"screw with a hexagonal socket", "flat on a cylinder"}


def marked(solids):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in solids]


def placed(make, seed):
    """The solid in metres, turned and shifted at random."""
    R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return make().copy().apply_scale(1e-3).apply_transform(transform(R, [2e-3, -1e-3, 5e-3])), R


def assert_group(found):
    """Products of any two elements are elements, to rounding; so are inverses."""
    flat = found.elements.reshape(-1, 16)
    products = np.einsum("aij,bjk->abik", found.elements, found.elements).reshape(-1, 16)
    differences = np.abs(products[:, None] - flat[None]).max(axis=2)
    assert differences.min(axis=1).max() < 1e-6
    assert len(np.unique(differences.argmin(axis=1))) == len(flat)


@pytest.mark.parametrize("name", marked(SOLIDS))
def test_known_groups_are_found_in_any_place(name):
    make, elements, axes = SOLIDS[name]
    mesh, _ = placed(make, sum(name.encode()))
    found = find_symmetries(mesh)
    assert (len(found.elements), len(found.continuous)) == (elements, axes)
    assert deviation_m(mesh, found, steps=4) <= found.tolerance_m
    assert_group(found) if not axes else None
    for T in found.discrete:
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(apply(T, mesh.center_mass), mesh.center_mass, atol=1e-9)


@pytest.mark.parametrize("name", marked(BROKEN))
def test_a_symmetry_broken_by_a_tenth_of_a_millimetre_is_seen(name):
    make, elements, axes = BROKEN[name]
    found = find_symmetries(placed(make, 5)[0])
    assert (len(found.elements), len(found.continuous)) == (elements, axes)


def test_an_axis_is_where_it_should_be_and_a_flip_turns_across_it():
    mesh, R = placed(lambda: cylinder(2.0, 5.0), 1)
    found = find_symmetries(mesh)
    axis = found.continuous[0]
    assert abs(axis.direction @ R[:, 2]) == pytest.approx(1.0, abs=1e-7)
    assert np.linalg.norm(np.cross(axis.point - [2e-3, -1e-3, 5e-3], R[:, 2])) < 1e-7
    np.testing.assert_allclose(found.discrete[0][:3, :3] @ axis.direction, -axis.direction, atol=1e-9)


def test_an_aligned_part_has_aligned_symmetries():
    found = find_symmetries(block(8e-3, 6e-3, 3e-3))
    turns = {tuple(np.round(np.diag(T[:3, :3])).astype(int)) for T in found.discrete}
    assert turns == {(1, -1, -1), (-1, 1, -1), (-1, -1, 1)}
    np.testing.assert_allclose(np.abs(found.discrete[:, :3, :3]), np.tile(np.eye(3), (3, 1, 1)), atol=1e-9)


def test_the_tolerance_decides_and_must_be_positive():
    mesh = block(8e-3, 7.9e-3, 3e-3)
    assert len(find_symmetries(mesh, 1e-4).discrete) == 7
    assert len(find_symmetries(mesh, 1e-5).discrete) == 3
    assert deviation_m(mesh, find_symmetries(mesh, 1e-4)) == pytest.approx(0.05e-3, rel=0.02)
    assert default_tolerance_m(1e-3) == 5e-6 < default_tolerance_m(5e-3) == 15e-6 < default_tolerance_m(0.1) == 30e-6
    with pytest.raises(ValueError, match="positive"):
        find_symmetries(mesh, 0.0)


def test_many_turns_are_told_from_round():
    assert len(find_symmetries(prism(20).apply_scale(1e-3)).discrete) == 39
    assert find_symmetries(prism(MAX_ORDER + 1).apply_scale(1e-3)).continuous


def test_models_info_is_in_millimetres_and_row_major():
    mesh = block(8e-3, 6e-3, 3e-3).apply_translation([1e-3, 0, 0])
    found = find_symmetries(mesh)
    info = models_info(mesh, found)
    assert info["diameter"] == pytest.approx(np.sqrt(64 + 36 + 9))
    assert [info["min_x"], info["size_y"], info["size_z"]] == pytest.approx([-3, 6, 3])
    assert info["symmetry_tolerance"] == pytest.approx(0.03)
    turns = [np.reshape(T, (4, 4)) for T in info["symmetries_discrete"]]
    half_turn = next(T for T in turns if rotation_angle(T[:3, :3], rotation_z(np.pi)) < 1e-6)
    np.testing.assert_allclose(half_turn[:3, 3], [2, 0, 0], atol=1e-6)
    read = symmetries_from_json(info)
    np.testing.assert_allclose(read.discrete, found.discrete, atol=1e-8)
    assert read.tolerance_m == pytest.approx(found.tolerance_m)


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_the_parts_have_no_proper_symmetry_but_mirror_in_y(name):
    part = load_part(name)
    stored = json.loads((part.folder / "symmetries.json").read_text())
    assert stored == models_info(part.mesh, find_symmetries(part.mesh))
    assert stored["symmetries_discrete"] == stored["symmetries_continuous"] == []
    mirrored = part.mesh.vertices * [1, -1, 1]
    np.testing.assert_allclose(mirrored.min(axis=0), part.mesh.bounds[0], atol=1e-8)
    assert abs(part.mesh.center_mass[1]) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "elements", "axes"),
    [
        (lambda: finer(block(5, 5, 5), 6), 24, 0),
        (lambda: finer(cylinder(2, 5, 300), 3), 2, 1),
        (lambda: finer(bracket(), 5), 1, 0),
        (lambda: trimesh.creation.icosphere(0, 3.0), 60, 0),
    ],
)
def test_large_meshes_and_large_groups(make, elements, axes):
    mesh, _ = placed(make, 2)
    found = find_symmetries(mesh)
    assert (len(found.elements), len(found.continuous)) == (elements, axes)
