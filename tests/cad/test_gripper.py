"""Laws of the hand and the station: frames, figures, and meshes that agree with the constants."""

import json

import numpy as np
import pytest
import trimesh

from cad import gripper, station
from cad.parts import LIBRARY
from cad.spatial import BASLER, apply, rotation_x, transform

CELL = LIBRARY / "cell"
INDEX = json.loads((CELL / "meshes.json").read_text())


def load(name):
    return trimesh.load(CELL / f"{name}.stl", force="mesh")


def solid(name):
    return next(s for s in (*gripper.COLLISION, *station.COLLISION) if s.name == name)


def body_mesh(body):
    return trimesh.util.concatenate([load(e["file"][:-4]) for e in INDEX["meshes"] if e["body"] == body])


def test_tool_frame_is_at_the_fingertips():
    np.testing.assert_array_equal(gripper.T_FLANGE_TCP[:3, :3], np.eye(3))
    lengths = gripper.COUPLING_HEIGHT_M + gripper.BODY_HEIGHT_M + gripper.CARRIAGE_HEIGHT_M + gripper.FINGER_LENGTH_M
    assert gripper.T_FLANGE_TCP[2, 3] == pytest.approx(lengths) == pytest.approx(0.147)
    for side in ("left", "right"):
        assert body_mesh(f"hande_{side}").bounds[1, 2] == pytest.approx(0.0, abs=1e-9)


def test_body_mesh_has_the_published_size():
    bounds = body_mesh("hande_base").bounds
    assert bounds[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert bounds[1, 2] == pytest.approx(gripper.COUPLING_HEIGHT_M + gripper.BODY_HEIGHT_M)
    assert np.ptp(load("hande_body").bounds[:, 0]) == pytest.approx(2 * gripper.BODY_RADIUS_M, rel=5e-3)


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_pad_solid_is_the_blade_exactly(side, sign):
    blade = solid(f"pad_{side}")
    assert blade.touches and blade.size == pytest.approx(gripper.PAD_HALF_EXTENTS_M)
    placed = gripper.T_TCP_LEFT_PAD if side == "left" else gripper.T_TCP_RIGHT_PAD
    np.testing.assert_allclose(blade.T_body_geom, placed, atol=1e-12)
    mesh = trimesh.util.concatenate([load(f"hande_{side}_tip"), load(f"hande_{side}_pad")])
    low = mesh.vertices[mesh.vertices[:, 2] > -gripper.PAD_HEIGHT_M + 1e-6]
    np.testing.assert_allclose(np.abs(low[:, 0]).max(), gripper.PAD_THICKNESS_M, atol=1e-8)
    np.testing.assert_allclose(sign * low[:, 0].min() if sign > 0 else low[:, 0].max(), 0.0, atol=1e-8)
    np.testing.assert_allclose(np.ptp(low[:, 1]), gripper.PAD_WIDTH_M, atol=1e-8)


@pytest.mark.parametrize("side", ["left", "right"])
def test_neck_solids_follow_the_taper(side):
    mesh = load(f"hande_{side}_tip")
    points = mesh.sample(2000, seed=3)
    solids = [s for s in gripper.COLLISION if s.name.startswith((f"hand_{side}_neck", f"pad_{side}"))]
    assert np.min([s.distance(points) for s in solids], axis=0).max() < 1e-6
    steps = [s for s in solids if "neck" in s.name]
    assert all(np.ptp(s.size) < 0.01 and s.size[0] * 2 <= gripper.FINGER_ROOT_THICKNESS_M for s in steps)


def test_only_the_pads_reach_the_closing_plane():
    for s in gripper.COLLISION:
        if s.body not in ("hande_left", "hande_right"):
            continue
        nearest = abs(s.T_body_geom[0, 3]) - s.size[0]
        assert nearest == pytest.approx(0.0, abs=1e-9) if s.touches else nearest >= gripper.PAD_COATING_M - 1e-9


def test_fingers_clear_the_body_over_the_whole_stroke():
    body = trimesh.proximity.ProximityQuery(body_mesh("hande_base"))
    for slide in gripper.FINGER_RANGE_M:
        T_flange_left = gripper.T_FLANGE_TCP @ transform(t=[slide, 0.0, 0.0])
        points = apply(T_flange_left, load("hande_left_rack").vertices)
        assert body.signed_distance(points).max() < 1e-6  # positive is inside


def test_counts_and_openings_are_inverse():
    assert gripper.counts_from_opening(gripper.STROKE_M) == 0
    assert gripper.counts_from_opening(0.0) == gripper.COUNTS == 255
    assert gripper.counts_from_opening(0.06) == 0 and gripper.counts_from_opening(-0.01) == 255
    for counts in range(256):
        assert gripper.counts_from_opening(gripper.opening_from_counts(counts)) == counts


def test_camera_never_sees_its_own_stand():
    """Nothing of camera and stand lies inside the view's pyramid, for a camera 0.70 m above the board at x = 0.45."""
    camera = body_mesh("camera_body")
    assert camera.bounds[1, 2] < 0.0
    T_cam_world = transform(rotation_x(np.pi), [0.0, 0.0, 0.705]) @ transform(t=[-0.45, 0.0, 0.0])
    stand = apply(T_cam_world @ transform(t=[0.45 + station.BOOM_REACH_M, 0.0, 0.0]), body_mesh("stand").vertices)
    ahead = stand[stand[:, 2] > 0.0]
    tangent = np.hypot(BASLER.width / 2 / BASLER.fx, BASLER.height / 2 / BASLER.fy)
    assert (np.linalg.norm(ahead[:, :2], axis=1) > 1.2 * tangent * ahead[:, 2]).all()


def test_bracket_and_camera_do_not_overlap():
    bracket = solid("stand_bracket")
    near = bracket.T_body_geom[0, 3] - bracket.size[0] + station.BOOM_REACH_M
    assert near > station.LENS_RADIUS_M and near > station.CAMERA_WIDTH_M / 2


def test_tray_is_flat_on_top():
    tray = load("tray_plate")
    np.testing.assert_allclose(np.ptp(tray.bounds, axis=0), station.TRAY_SIZE_M, atol=1e-8)
    assert tray.bounds[1, 2] == pytest.approx(0.0, abs=1e-9)
    top = tray.area_faces[tray.triangles_center[:, 2] > -1e-6].sum()
    assert top > 0.96 * station.TRAY_SIZE_M[0] * station.TRAY_SIZE_M[1]
    outline = load("tray_nest")
    assert outline.bounds[0, 2] == pytest.approx(0.0, abs=1e-9) and outline.bounds[1, 2] <= 0.0501e-3
