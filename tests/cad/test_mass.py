"""Volume, centre of mass and inertia of meshes against closed forms."""

import json

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cad.collision import find_collision_shapes
from cad.folders import PartFacts, write_part_folder
from cad.parts import load_part
from cad.spatial import transform

DENSITY = 7850.0


def solid(mesh, density=DENSITY):
    mesh = mesh.copy()
    mesh.density = density
    return mesh


def moments(mesh):
    return np.diag(mesh.moment_inertia)


def extruded(area, second_moments, height):
    """Volume and moments about the centroid of a straight prism: its section's area and second moments (x, y)."""
    volume = area * height
    (ixx, iyy), axial = second_moments, volume * height**2 / 12
    return volume, np.array([iyy * height + axial, ixx * height + axial, (ixx + iyy) * height])


def regular_polygon(sides, radius):
    """Area and second moments (integrals of x^2 and y^2) of a regular polygon with corners at ``radius``."""
    area = sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
    second = area * radius**2 / 12 * (2 + np.cos(2 * np.pi / sides))
    return area, second


def test_a_box_is_exact():
    a, b, c = 8e-3, 6e-3, 3e-3
    mesh = solid(trimesh.creation.box((a, b, c)).apply_translation([1e-3, -2e-3, 5e-3]))
    mass = DENSITY * a * b * c
    assert mesh.volume == pytest.approx(a * b * c, rel=1e-12)
    np.testing.assert_allclose(mesh.center_mass, [1e-3, -2e-3, 5e-3], atol=1e-15)
    np.testing.assert_allclose(moments(mesh), mass / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b]))


@pytest.mark.parametrize("sections", [6, 24, 96])
def test_a_meshed_cylinder_is_exactly_the_prism_it_is(sections):
    radius, height = 2e-3, 5e-3
    mesh = solid(trimesh.creation.cylinder(radius, height, sections=sections))
    area, second = regular_polygon(sections, radius)
    volume, expected = extruded(area, (second, second), height)
    assert mesh.volume == pytest.approx(volume, rel=1e-9)
    np.testing.assert_allclose(moments(mesh), DENSITY * expected, rtol=1e-9)


def test_a_meshed_cylinder_comes_to_the_round_one_with_the_square_of_its_sections():
    radius, height = 2e-3, 5e-3
    mass = DENSITY * np.pi * radius**2 * height
    across, along = mass * (3 * radius**2 + height**2) / 12, mass * radius**2 / 2
    errors = []
    for sections in (64, 128):
        mesh = solid(trimesh.creation.cylinder(radius, height, sections=sections))
        errors.append(np.abs(moments(mesh) / [across, across, along] - 1).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.01)


def test_a_hollow_tube_lacks_what_its_hole_would_weigh():
    outer, inner, height, sections = 3.0, 2.0, 4.0, 64
    cylinders = [trimesh.creation.cylinder(r, h, sections=sections) for r, h in ((outer, height), (inner, 9.0))]
    mesh = solid(trimesh.boolean.difference(cylinders).apply_scale(1e-3))
    (area, second), (hole, lost) = (regular_polygon(sections, 1e-3 * r) for r in (outer, inner))
    volume, expected = extruded(area - hole, (second - lost, second - lost), 1e-3 * height)
    assert mesh.volume == pytest.approx(volume, rel=1e-6)
    np.testing.assert_allclose(mesh.center_mass, 0, atol=1e-9)
    np.testing.assert_allclose(moments(mesh), DENSITY * expected, rtol=1e-6)


def test_a_segment_of_a_sphere():
    radius, height = 3e-3, 2e-3  # a cap cut off by a plane, its base at z = 1 mm
    floor = radius - height
    angle = np.linspace(0, np.arccos(floor / radius), 200)
    profile = radius * np.stack([np.sin(angle), np.cos(angle)], axis=1)[::-1]
    mesh = solid(trimesh.creation.revolve(1e3 * np.vstack([[0, floor], profile]), sections=400).apply_scale(1e-3))
    volume = np.pi * height**2 * (3 * radius - height) / 3
    centre = 3 * (2 * radius - height) ** 2 / (4 * (3 * radius - height))
    z = np.linspace(floor, radius, 200_001)
    rim = radius**2 - z**2
    axial = float(DENSITY * np.pi / 2 * np.trapezoid(rim**2, z))
    across = float(axial / 2 + DENSITY * np.pi * np.trapezoid(rim * (z - centre) ** 2, z))
    assert mesh.volume == pytest.approx(volume, rel=3e-4)
    np.testing.assert_allclose(mesh.center_mass, [0, 0, centre], atol=3e-7)
    np.testing.assert_allclose(moments(mesh), [across, across, axial], rtol=5e-4)


def test_inertia_turns_with_the_part():
    R = Rotation.random(rng=np.random.default_rng(3)).as_matrix()
    mesh = solid(trimesh.creation.box((8e-3, 6e-3, 3e-3)))
    inertia = mesh.moment_inertia
    turned = solid(mesh.copy().apply_transform(transform(R, [1e-3, 2e-3, 3e-3])))
    np.testing.assert_allclose(turned.moment_inertia, R @ inertia @ R.T, rtol=1e-9, atol=1e-18)


def test_a_part_s_mass_is_its_density_times_the_closed_form(tmp_path):
    mesh = trimesh.creation.box((8e-3, 6e-3, 3e-3))
    facts = PartFacts(
        name="brick",
        obj_id=50,
        density_kg_m3=2000.0,
        material="brick",
        rgba=(1.0, 0.0, 0.0, 1.0),
        metallic=0.0,
        roughness=0.5,
    )
    write_part_folder(tmp_path / "brick", mesh, find_collision_shapes(mesh), facts)
    assert json.loads((tmp_path / "brick" / "part.json").read_text())["mass_kg"] == pytest.approx(2000 * 144e-9)
    assert load_part("brick", tmp_path).mass_kg == pytest.approx(2.88e-4, rel=1e-9)


@pytest.mark.parametrize("name", ["inserted", "main", "top"])
def test_built_in_parts_weigh_density_times_volume(name):
    part = load_part(name)
    assert part.mass_kg == pytest.approx(part.info["density_kg_m3"] * part.mesh.volume, rel=1e-6)
