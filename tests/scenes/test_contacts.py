"""What contacts may do to a part, on the lightest built-in one; benchmarks/contact.py has all parts and time steps."""

from functools import lru_cache

import numpy as np
import pytest
import trimesh

from cad.decompose import hull_of
from cad.parts import load_part
from scenes.contacts import PART, PLANE, Touches, make_collision, set_options
from scenes.free_part import add_piece, set_mass_properties
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_board_scene, build_workcell
from twin.contact_study import ContactStudyConfig, best_grasp, study_grip, study_rest

NAME = "inserted"
CONFIG = ContactStudyConfig(rest_s=1.0, hold_s=0.5, settle_s=0.3)


@lru_cache
def grip():
    part = load_part(NAME)
    return study_grip(part, best_grasp(part), CONFIG)


@pytest.mark.parametrize("name", ["inserted", "top"])
def test_parts_rest_in_the_board_by_less_than_5_um_and_do_not_drift(name):
    rest = study_rest(load_part(name), CONFIG)
    assert 0 < rest.penetration_m < 5e-6
    assert rest.drift_m_s < 0.05e-6


def test_a_grip_squeezes_a_part_by_less_than_30_um():
    assert 0 < grip().squeeze_m < 30e-6
    assert grip().contacts >= 6


def test_a_part_stays_where_it_is_in_the_hand():
    assert grip().creep_m < 5e-6
    assert grip().slip_m < 30e-6


def test_a_coarser_step_makes_the_pads_softer():
    """The study sees what it is about."""
    coarse = ContactStudyConfig(timestep_s=0.002, hold_s=0.1, settle_s=0.3)
    part = load_part(NAME)
    assert study_grip(part, best_grasp(part), coarse).squeeze_m > 2 * grip().squeeze_m


def test_impossible_studies_are_refused():
    with pytest.raises(ValueError, match=r"carry_m -0\.1 must be positive"):
        ContactStudyConfig(carry_m=-0.1)


def test_the_robot_meets_the_plate_and_parts_the_level_at_its_top():
    model = build_workcell(CellConfig(), [NAME]).compile()
    meets = {
        (a, b): bool(
            model.geom(a).contype & model.geom(b).conaffinity or model.geom(b).contype & model.geom(a).conaffinity
        )
        for a in ("board", "board_level")
        for b in ("pad_left", "part_00_hull_00", "table", "tray")
    }
    assert {pair for pair, meet in meets.items() if meet} == {
        ("board", "pad_left"),
        ("board_level", "part_00_hull_00"),
    }
    top = CellConfig().T_world_board[2, 3]
    assert model.geom("board_level").pos[2] == pytest.approx(top)


def test_the_board_without_a_robot_has_the_same_level():
    model = build_board_scene(CellConfig(), [NAME]).compile()
    assert model.geom("board_level").type[0] == PLANE


def _screw(sections):
    head = trimesh.creation.cylinder(0.0019, 0.002, sections=sections)
    shank = trimesh.creation.cylinder(0.001, 0.006, sections=sections)
    head.apply_translation([0, 0, 0.001])
    shank.apply_translation([0, 0, -0.003])
    return [hull_of(np.asarray(mesh.vertices)) for mesh in (head, shank)]


def _pin(sections):
    return [hull_of(np.asarray(trimesh.creation.cylinder(0.001, 0.006, sections=sections).vertices))]


@pytest.mark.parametrize(("pieces", "radius"), [(_pin(96), 1.0e-3), (_screw(48), 1.9e-3)])
def test_round_parts_stop_rolling(pieces, radius):
    """A part on its side, rolling at 0.1 m/s, comes to rest within half a second and falls asleep."""
    spec = mujoco.MjSpec()
    set_options(spec, 0.001)
    make_collision(spec.worldbody.add_geom(type=PLANE, size=[0.1, 0.1, 0.01]), Touches.LEVEL, PART)
    body = spec.worldbody.add_body(name="part", pos=[0.0, 0.0, radius], quat=[np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    body.add_freejoint()
    set_mass_properties(body, trimesh.util.concatenate(pieces), 2e-4)
    for k, piece in enumerate(pieces):
        name = f"piece_{k}"
        add_piece(spec, name, piece)
        make_collision(body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH.value, meshname=name), Touches.PART, PART)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 300)
    data.qvel[0], data.qvel[5] = 0.1, -0.1 / radius
    mujoco.mj_step(model, data, 20)
    assert data.qvel[0] > 0.01
    mujoco.mj_step(model, data, 1000)
    np.testing.assert_array_equal(data.qvel, 0.0)
