"""The compiled cell against the published tables and the physics it must show."""

import numpy as np
import pytest

from cad import gripper, robot
from cad.parts import PartError, load_part
from cad.spatial import apply, inverse, rotation_z, transform
from scenes.arm import arm_inputs, hand_inputs
from scenes.cell_config import TrayConfig
from scenes.contacts import BOX, PART, Touches, make_collision
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_arm, build_workcell, set_parts

CONFIG = CellConfig()
NAMES = ("inserted", "main", "top")


@pytest.fixture(scope="module")
def cell():
    return build_workcell(CONFIG, NAMES).compile()


def test_parts_weigh_what_their_folders_say(cell):
    for i, name in enumerate(NAMES):
        part, body = load_part(name), cell.body(f"part_{i:02d}")
        np.testing.assert_allclose(body.mass, part.mass_kg)
        np.testing.assert_allclose(body.ipos, part.mesh.center_mass, atol=1e-9)
        moments = np.linalg.eigvalsh(part.mesh.moment_inertia * part.mass_kg / part.mesh.mass)
        np.testing.assert_allclose(np.sort(body.inertia), moments, rtol=1e-6)


def test_arm_leads_the_state_and_names_are_as_agreed(cell):
    for i, name in enumerate((*robot.JOINT_NAMES, "hande_left", "hande_right")):
        assert cell.joint(name).qposadr[0] == i
    for name in ("ur5e_base", "hande_base", "board", "tray", "stand"):
        assert cell.body(name).id > 0
    for name in ("pad_left", "pad_right", "table", "board", "tray"):
        assert cell.geom(name).contype[0] > 0
    assert cell.site("flange").id != cell.site("tcp").id


def test_arm_holds_still_at_home_without_touching_anything(cell):
    data = mujoco.MjData(cell)
    data.qpos[:6] = data.ctrl[arm_inputs(cell)[0]] = CONFIG.home_q
    mujoco.mj_step(cell, data, 400)
    np.testing.assert_allclose(data.qpos[:6], CONFIG.home_q, atol=1e-6)
    touching = {cell.geom(g).name for c in data.contact for g in (c.geom1, c.geom2)}
    assert not any(name.startswith(("arm_", "hand_", "pad_")) for name in touching)


def test_home_leaves_the_camera_a_free_view(cell):
    """No point of arm or hand projects into the frame."""
    data = mujoco.MjData(cell)
    data.qpos[:6] = CONFIG.home_q
    mujoco.mj_forward(cell, data)
    T_cam_world = inverse(CONFIG.T_world_cam)
    for solid in (*robot.COLLISION, *gripper.COLLISION):
        geom = data.geom(solid.name)
        reach = cell.geom(solid.name).rbound[0]
        p = apply(T_cam_world, geom.xpos)
        if p[2] > 0:
            half = 0.5 * np.array([CONFIG.intrinsics.width, CONFIG.intrinsics.height]) / CONFIG.intrinsics.fx * p[2]
            assert (np.abs(p[:2]) - reach > half).any(), solid.name


def test_arm_is_stopped_by_the_board(cell):
    data = mujoco.MjData(cell)
    T = CONFIG.T_world_board @ transform(np.diag([1.0, -1.0, -1.0]), [0, 0, -0.002]) @ inverse(gripper.T_FLANGE_TCP)
    q = min(robot.inverse_kinematics(T), key=lambda q: np.abs(q - CONFIG.home_q).sum())
    data.qpos[:6] = data.ctrl[arm_inputs(cell)[0]] = q
    mujoco.mj_forward(cell, data)
    pairs = [{cell.geom(c.geom1).name, cell.geom(c.geom2).name} for c in data.contact]
    assert {"board", "pad_left"} in pairs


def test_nests_are_flat_places_on_the_tray_one_row_a_class():
    frames = np.concatenate([CONFIG.nest_frames(name) for name in CONFIG.tray.classes])
    np.testing.assert_allclose(frames[:, 2, 3], CONFIG.T_world_tray[2, 3])
    distances = np.linalg.norm(frames[:, None, :3, 3] - frames[None, :, :3, 3], axis=-1)
    assert distances[~np.eye(len(frames), dtype=bool)].min() >= min(CONFIG.tray.pitch_m) - 1e-12
    with pytest.raises(SceneError, match="no nest for 'bolt'"):
        CONFIG.nest_frames("bolt")


def test_part_in_a_nest_stays_where_it_was_put(cell):
    data = mujoco.MjData(cell)
    data.qpos[:6] = data.ctrl[arm_inputs(cell)[0]] = CONFIG.home_q
    T = np.stack([CONFIG.nest_frames(n)[0] @ load_part(n).stable_poses[0].T_table_part for n in NAMES])
    set_parts(cell, data, T)
    mujoco.mj_step(cell, data, 400)
    for i in range(len(NAMES)):
        np.testing.assert_allclose(data.body(f"part_{i:02d}").xpos, T[i, :3, 3], atol=3e-5)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: CellConfig(timestep_s=0.01), "timestep_s 0.01"),
        (lambda: CellConfig(home_q=(0.0, 0.0)), "home_q has 2"),
        (lambda: CellConfig(pick_area_half_m=(0.2, 0.05)), "exceeds the board's free middle"),
        (lambda: TrayConfig(nests_per_class=9), "use fewer nests_per_class"),
    ],
)
def test_impossible_cells_are_refused(make, says):
    with pytest.raises(SceneError, match=says):
        make()


def test_unknown_part_is_named():
    with pytest.raises(PartError, match="no part is called 'bolt'"):
        build_workcell(CONFIG, ["bolt"])


def test_hand_lifts_a_box_of_a_third_of_a_gram():
    """Grip 8 mm wide across, carry 50 mm up: it follows to 0.1 mm and is not squeezed by more than 0.05 mm."""
    spec = build_arm(CONFIG)
    floor = spec.worldbody.add_geom(name="floor", type=BOX, size=[0.5, 0.5, 0.01], pos=[0.4, 0, -0.01])
    make_collision(floor, Touches.CELL, PART)
    body = spec.worldbody.add_body(name="box", pos=[0.45, 0.0, 0.0015])
    body.add_freejoint()
    geom = body.add_geom(name="box", type=BOX, size=[0.004, 0.003, 0.0015])
    make_collision(geom, Touches.PART, PART)
    geom.mass = 0.0003
    model = spec.compile()
    data = mujoco.MjData(model)

    def solve(height):
        T = transform(rotation_z(0.0) @ np.diag([1.0, -1.0, -1.0]), [0.45, 0.0, height])
        found = robot.inverse_kinematics(T @ inverse(gripper.T_FLANGE_TCP))
        return min(found, key=lambda q: np.abs(q - CONFIG.home_q).sum())

    low, high = solve(0.0006), solve(0.0506)
    positions, hand = arm_inputs(model)[0], hand_inputs(model)[0]
    data.qpos[:6] = data.ctrl[positions] = low
    data.qpos[6:8] = 0.010
    data.ctrl[hand] = 0.020
    closing = round(0.20 / CONFIG.timestep_s)
    for step in range(closing):
        data.ctrl[hand] = max(0.0, 0.020 - 0.1 * step * CONFIG.timestep_s)
        mujoco.mj_step(model, data)
    opening = data.qpos[6] + data.qpos[7]
    assert abs(opening - 0.008) < 5e-5
    rising = round(0.4 / CONFIG.timestep_s)
    before = data.body("box").xpos - data.site("tcp").xpos
    for step in range(rising):
        s = (step + 1) / rising
        data.ctrl[positions] = low + (high - low) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        mujoco.mj_step(model, data)
    mujoco.mj_step(model, data, 100)
    assert data.body("box").xpos[2] > 0.05
    assert np.linalg.norm(data.body("box").xpos - data.site("tcp").xpos - before) < 1e-4
