"""Laws of the arm's kinematics, of its collision solids and of the cell's meshes."""

import json

import numpy as np
import pytest
import trimesh

from cad import gripper, station
from cad.parts import LIBRARY
from cad.primitives import Primitive, PrimitiveError, cylinder_between
from cad.robot import (
    BODY_NAMES,
    COLLISION,
    LINK_INERTIAS,
    UR5E,
    DhTable,
    RobotModelError,
    forward_kinematics,
    inverse_kinematics,
    jacobian,
)
from cad.spatial import apply, inverse, rotation_x, rotvec_from_rotation, transform, wrap_angle

CELL = LIBRARY / "cell"
INDEX = json.loads((CELL / "meshes.json").read_text())
MEGABYTE = 1e6
SEAM_HEIGHTS_M = (0.090, 0.072, 0.064, 0.064, 0.050, 0.050)
"""Where the axis of joint ``i + 1`` leaves link ``i``, along z of frame ``i``."""


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture(scope="module")
def meshes():
    """Meshes of each body, vertices merged."""
    found = {}
    for entry in INDEX["meshes"]:
        found.setdefault(entry["body"], []).append(trimesh.load(CELL / entry["file"], force="mesh"))
    return found


def test_known_flange_positions():
    a2, a3, d1, d4, d5, d6 = UR5E.a[1], UR5E.a[2], UR5E.d[0], UR5E.d[3], UR5E.d[4], UR5E.d[5]
    stretched = forward_kinematics(np.zeros(6))[6]
    np.testing.assert_allclose(stretched[:3, 3], [a2 + a3, -(d4 + d6), d1 - d5], atol=1e-15)
    np.testing.assert_allclose(stretched[:3, :3], rotation_x(np.pi / 2), atol=1e-15)
    upright = forward_kinematics([0, -np.pi / 2, 0, -np.pi / 2, 0, 0])[6]
    np.testing.assert_allclose(upright[:3, 3], [0, -(d4 + d6), d1 - a2 - a3 + d5], atol=1e-15)
    turned = forward_kinematics([np.pi / 2, 0, 0, 0, 0, 0])[6]
    np.testing.assert_allclose(turned[:3, 3], [d4 + d6, a2 + a3, d1 - d5], atol=1e-15)


def test_frames_are_rigid_and_base_is_identity(rng):
    for _ in range(50):
        frames = forward_kinematics(rng.uniform(-2 * np.pi, 2 * np.pi, 6))
        np.testing.assert_array_equal(frames[0], np.eye(4))
        np.testing.assert_allclose(frames @ inverse(frames), np.tile(np.eye(4), (7, 1, 1)), atol=1e-14)
        np.testing.assert_allclose(np.linalg.det(frames[:, :3, :3]), 1.0, atol=1e-14)


def test_each_joint_turns_only_what_follows_it(rng):
    q = rng.uniform(-3, 3, 6)
    for i in range(6):
        moved = forward_kinematics(q + 0.3 * np.eye(6)[i])
        np.testing.assert_array_equal(moved[: i + 1], forward_kinematics(q)[: i + 1])
        assert np.abs(moved[i + 1] - forward_kinematics(q)[i + 1]).max() > 0.1


def test_jacobian_is_the_derivative(rng):
    step = 1e-6
    for _ in range(20):
        q = rng.uniform(-np.pi, np.pi, 6)
        columns = []
        for unit in np.eye(6):
            high, low = forward_kinematics(q + step * unit)[6], forward_kinematics(q - step * unit)[6]
            angular = rotvec_from_rotation(high[:3, :3] @ low[:3, :3].T)
            columns.append(np.concatenate([high[:3, 3] - low[:3, 3], angular]) / (2 * step))
        np.testing.assert_allclose(jacobian(q), np.array(columns).T, atol=1e-8)


def test_inverse_kinematics_round_trip(rng):
    for _ in range(300):
        q = rng.uniform(-np.pi, np.pi, 6)
        target = forward_kinematics(q)[6]
        found = inverse_kinematics(target)
        assert 1 <= len(found) <= 8
        assert np.abs(wrap_angle(found - q)).max(axis=1).min() < 1e-9
        for solution in found:
            np.testing.assert_allclose(forward_kinematics(solution)[6], target, atol=1e-9)


def test_top_down_target_has_eight_branches():
    target = transform(rotation_x(np.pi), [0.45, 0.0, 0.005]) @ inverse(gripper.T_FLANGE_TCP)
    found = inverse_kinematics(target)
    assert found.shape == (8, 6)
    assert len(np.unique(found.round(6), axis=0)) == 8
    assert ((found >= -np.pi) & (found < np.pi)).all()


def test_inverse_kinematics_at_the_wrist_singularity():
    q = np.array([0.3, -1.2, 1.5, -0.7, 0.0, 0.4])
    target = forward_kinematics(q)[6]
    found = inverse_kinematics(target, q6_singular=0.4)
    assert np.abs(wrap_angle(found - q)).max(axis=1).min() < 1e-9
    for solution in inverse_kinematics(target):
        np.testing.assert_allclose(forward_kinematics(solution)[6], target, atol=1e-9)


def test_out_of_reach_has_no_solution():
    assert inverse_kinematics(transform(t=[2.0, 0.0, 0.3])).shape == (0, 6)
    assert inverse_kinematics(transform(t=[0.0, 0.0, 0.3])).shape == (0, 6)


def test_wrong_input_is_named():
    with pytest.raises(RobotModelError, match=r"\(5,\)"):
        forward_kinematics(np.zeros(5))
    with pytest.raises(RobotModelError, match=r"a = .*needs 6"):
        DhTable(a=(0.0,), d=(0.0,), alpha=(0.0,))
    bent = DhTable(a=(0.001, *UR5E.a[1:]), d=UR5E.d, alpha=UR5E.alpha)
    with pytest.raises(RobotModelError, match="calibrated"):
        inverse_kinematics(np.eye(4), bent)


def test_link_inertias_are_physical():
    assert sum(link.mass_kg for link in LINK_INERTIAS) == pytest.approx(17.7)  # Universal Robots' table, links 1..6
    for link in LINK_INERTIAS:
        x, y, z = link.moments_kg_m2
        assert min(x, y, z) > 0 and x + y >= z and y + z >= x and z + x >= y


def test_every_mesh_is_a_closed_solid_of_a_known_body(meshes):
    known = {*BODY_NAMES, "hande_base", "hande_left", "hande_right", "camera_body", "stand", "tray", "table"}
    assert set(meshes) == known
    for entry in [*INDEX["meshes"], *INDEX["markers"].values()]:
        mesh = trimesh.load(CELL / entry["file"], force="mesh")
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, entry["file"]
        assert len(entry["rgba"]) == 4 and 0 <= entry["metallic"] <= 1 and 0 <= entry["roughness"] <= 1
    assert {e["file"] for e in [*INDEX["meshes"], *INDEX["markers"].values()]} == {f.name for f in CELL.glob("*.stl")}


def test_files_stay_small():
    assert sum(f.stat().st_size for f in CELL.glob("*.stl")) < 3 * MEGABYTE
    assert (CELL / "cell.step").stat().st_size < 2 * MEGABYTE


@pytest.mark.parametrize("link", range(6))
def test_neighbouring_links_meet_at_every_pose(link, meshes, rng):
    """The face of each link's seam ring lies on the next link, however the joint between them is turned."""
    height = SEAM_HEIGHTS_M[link]
    vertices = np.concatenate([m.vertices for m in meshes[BODY_NAMES[link]]])
    on_axis = np.hypot(vertices[:, 0], vertices[:, 1]) < 0.075
    face = vertices[on_axis & (np.abs(vertices[:, 2] - height) < 1e-6)]
    assert len(face) > 20
    following = trimesh.proximity.ProximityQuery(trimesh.util.concatenate(meshes[BODY_NAMES[link + 1]]))
    for _ in range(5):
        frames = forward_kinematics(rng.uniform(-np.pi, np.pi, 6))
        points = apply(inverse(frames[link + 1]) @ frames[link], face)
        assert np.abs(following.signed_distance(points)).max() < 0.2e-3


@pytest.mark.parametrize(
    ("solids", "slack_m"),
    [(COLLISION, 0.008), (gripper.COLLISION, 0.010), (station.COLLISION, 0.026)],
    ids=["arm", "hand", "station"],
)
def test_collision_solids_enclose_the_meshes_closely(solids, slack_m, meshes):
    for body in {s.body for s in solids}:
        parts = [s for s in solids if s.body == body]
        vertices = np.concatenate([m.vertices for m in meshes[body]])
        inside = np.min([s.distance(vertices) for s in parts], axis=0) <= 1e-6
        assert inside.mean() >= 0.97, body
        surfaces = [trimesh.proximity.ProximityQuery(mesh) for mesh in meshes[body]]
        for solid in parts:
            inside_by = np.max([s.signed_distance(_extremes(solid)) for s in surfaces], axis=0)  # negative is outside
            assert inside_by.min() > -slack_m, solid.name


def _extremes(solid):
    """Centres of the outer faces of a solid, in its body's frame."""
    size = np.array(solid.size) if solid.kind == "box" else np.array(solid.size)[[0, 0, 1]]
    return apply(solid.T_body_geom, np.concatenate([np.diag(size), -np.diag(size)]))


def test_names_of_collision_solids_are_unique():
    names = [s.name for s in (*COLLISION, *gripper.COLLISION, *station.COLLISION)]
    assert len(set(names)) == len(names)
    assert all(n.startswith(("arm_", "hand_", "pad_", "stand_", "tray")) for n in names)


def test_signed_distance_of_the_solids(rng):
    box = Primitive(name="b", body="x", kind="box", size=(1.0, 2.0, 3.0), T_body_geom=transform(t=[1.0, 0.0, 0.0]))
    np.testing.assert_allclose(box.distance([[1, 0, 0], [3, 0, 0], [3, 3, 0]]), [-1.0, 1.0, np.sqrt(2)])
    rod = cylinder_between("c", "x", [0, 0, 0], [0, 4, 0], 1.0)
    np.testing.assert_allclose(rod.distance([[0, 2, 0], [0, 5, 0], [3, 2, 0], [2, 5, 0]]), [-1, 1, 2, np.sqrt(2)])
    pill = Primitive(name="p", body="x", kind="capsule", size=(1.0, 2.0), T_body_geom=np.eye(4))
    np.testing.assert_allclose(pill.distance([[0, 0, 0], [0, 0, 4], [3, 0, 1]]), [-1, 1, 2])
    with pytest.raises(PrimitiveError, match="box takes 3"):
        Primitive(name="b", body="x", kind="box", size=(1.0, 2.0), T_body_geom=np.eye(4))
    with pytest.raises(PrimitiveError, match="two different points"):
        cylinder_between("c", "x", [0, 0, 0], [0, 0, 0], 1.0)
