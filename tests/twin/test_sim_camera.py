import numpy as np
import pytest

from cad.parts import load_part, planar
from cad.spatial import Intrinsics, inverse, rotation_x
from perception.estimates import Frame
from scenes.camera import camera_pose
from scenes.errors import SceneError
from scenes.gl import mujoco
from scenes.render import Rendering
from scenes.sensor import SensorConfig, expose
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.oracle import OracleEstimator
from twin.sim_camera import SimCamera

CELL = CellConfig()
SMALL = Intrinsics(width=16, height=12, fx=100.0, fy=100.0, cx=7.5, cy=5.5)


class GreyRenderer:
    """Renders nothing but grey, and remembers what was asked."""

    def __init__(self):
        self.asked = []

    def render(self, data, intrinsics, what=("rgb",), camera="camera"):
        self.asked.append((data.time, intrinsics, what))
        return Rendering(rgb=np.full((intrinsics.height, intrinsics.width, 3), 120, np.uint8))

    def close(self):
        pass


@pytest.fixture(scope="module")
def cell():
    names = ["inserted", "main", "top"]
    return build_workcell(CELL, names).compile(), [load_part(name) for name in names]


def test_frames_carry_the_time_of_exposure_and_take_their_latency(cell):
    model, _ = cell
    data, renderer = mujoco.MjData(model), GreyRenderer()
    camera = SimCamera(model, data, renderer, rng=np.random.default_rng(0), intrinsics=SMALL, latency_s=0.05)
    first, second = camera.capture(), camera.capture()
    assert first.time_s == 0.0 and second.time_s == pytest.approx(0.05)
    assert data.time == pytest.approx(0.1)
    assert [a[1:] for a in renderer.asked] == [(SMALL, ("rgb",))] * 2
    assert first.intrinsics == SMALL and first.image.dtype == np.uint8


def test_noise_comes_from_the_generator(cell):
    model, _ = cell

    def frame(seed, **kwargs):
        camera = SimCamera(
            model, mujoco.MjData(model), GreyRenderer(), rng=np.random.default_rng(seed), intrinsics=SMALL, **kwargs
        )
        return camera.capture().image

    quiet = SensorConfig(blur_px=0.0, shot_noise=0.0, read_noise=0.0)
    np.testing.assert_array_equal(frame(1), frame(1))
    assert (frame(1) != frame(2)).any()
    assert (frame(1, sensor=quiet) == 120).all()


def test_exposure_multiplies_the_cameras_own_and_takes_time_to_change(cell):
    model, _ = cell
    data, quiet = mujoco.MjData(model), SensorConfig(blur_px=0.0, shot_noise=0.0, read_noise=0.0, exposure=0.5)
    camera = SimCamera(
        model,
        data,
        GreyRenderer(),
        rng=np.random.default_rng(0),
        intrinsics=SMALL,
        sensor=quiet,
        latency_s=0.05,
        change_s=0.02,
    )
    frames = [camera.capture(), camera.capture(3.0), camera.capture(3.0), camera.capture()]
    assert [int(f.image[0, 0, 0]) for f in frames] == [60, 180, 180, 60]
    assert [f.time_s for f in frames] == pytest.approx([0.0, 0.07, 0.12, 0.19])
    with pytest.raises(SceneError, match=r"exposure -0\.5"):
        camera.capture(-1.0)


def test_the_usual_exposure_leaves_every_byte_as_it_is(cell):
    model, _ = cell
    plain, sensor = (
        SimCamera(model, mujoco.MjData(model), GreyRenderer(), rng=np.random.default_rng(5), intrinsics=SMALL),
        SensorConfig(),
    )
    ideal = np.full((SMALL.height, SMALL.width, 3), 120, np.uint8)
    np.testing.assert_array_equal(plain.capture().image, expose(ideal, sensor, np.random.default_rng(5)))


def test_negative_times_are_refused(cell):
    model, _ = cell
    for name in ("latency_s", "change_s"):
        with pytest.raises(ValueError, match=f"{name} -1"):
            SimCamera(model, mujoco.MjData(model), GreyRenderer(), rng=np.random.default_rng(0), **{name: -1.0})


def test_the_oracle_tells_the_truth_about_what_lies_on_the_board(cell):
    model, parts = cell
    data = mujoco.MjData(model)
    resting = [p.stable_poses[k].T_table_part for p, k in zip(parts, (1, 0, 1), strict=True)]
    lying = [CELL.T_world_board @ planar(0.02 * i, 0.01, i) @ T for i, T in enumerate(resting[:2])]
    in_tray = CELL.nest_frames("top")[0] @ resting[2]
    set_parts(model, data, np.array([*lying, in_tray]))
    camera = SimCamera(model, data, GreyRenderer(), rng=np.random.default_rng(0), intrinsics=SMALL, latency_s=0.0)
    estimate = OracleEstimator(model, data, parts, CELL).estimate(camera.capture())
    assert [(p.part, p.stable_pose, p.accepted) for p in estimate.parts] == [("inserted", 1, True), ("main", 0, True)]
    T_world_cam = camera_pose(model, data)
    np.testing.assert_allclose(T_world_cam @ estimate.T_cam_board, CELL.T_world_board, atol=1e-9)
    for seen, T_world_part in zip(estimate.parts, lying, strict=True):
        np.testing.assert_allclose(seen.T_cam_part, inverse(T_world_cam) @ T_world_part, atol=1e-9)


def test_the_oracle_declines_what_leans(cell):
    model, parts = cell
    data = mujoco.MjData(model)
    leaning = planar(0.0, 0.0, 0.0) @ parts[1].stable_poses[0].T_table_part
    leaning[:3, :3] = leaning[:3, :3] @ rotation_x(0.3)
    lowest = (parts[1].mesh.vertices @ leaning[:3, :3].T)[:, 2].min()
    leaning[2, 3] = -lowest
    away = np.eye(4)
    away[2, 3] = 1.0
    set_parts(model, data, np.array([away, CELL.T_world_board @ leaning, away]))
    frame = Frame(image=np.zeros((1, 1, 3), np.uint8), intrinsics=SMALL, time_s=0.0)
    (seen,) = OracleEstimator(model, data, parts, CELL).estimate(frame).parts
    assert not seen.accepted and "leans" in seen.verdict
