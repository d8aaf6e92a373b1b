"""What varies between images: sensor, textures, distractors, looks and shots."""

from dataclasses import replace

import numpy as np
import pytest

from cad.parts import load_part, part_names
from cad.spatial import BASLER, apply, inverse
from scenes.distractors import distractor_meshes
from scenes.errors import SceneError
from scenes.randomize import LookRanges, ViewRanges, draw_camera, draw_look
from scenes.sensor import SensorConfig, expose
from scenes.shots import ShotRanges, ShotSampler, footprint_radius
from scenes.textures import make_textures

GREY = np.full((200, 200, 3), 100, np.uint8)


@pytest.mark.parametrize("downscale", [1, 2])
def test_noise_has_the_stated_variance(downscale):
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.05, read_noise=2.0)
    image = expose(GREY, sensor, np.random.default_rng(0), downscale)
    rounding = 1 / 12
    assert image.std() ** 2 == pytest.approx((4.0 + 5.0) / downscale**2 + rounding, rel=0.05)
    assert image.mean() == pytest.approx(100, abs=0.1)


def test_blur_of_a_downscaled_image_is_that_of_averaged_pixels():
    sensor = SensorConfig(blur_px=1.2, shot_noise=0.0, read_noise=0.0)
    edge = np.repeat(np.repeat((np.arange(200)[None, :] >= 100).astype(np.uint8) * 200, 200, 0)[..., None], 3, 2)
    full = expose(edge, sensor, np.random.default_rng(0)).astype(float)
    averaged = full.reshape(100, 2, 100, 2, 3).mean(axis=(1, 3))
    small = edge.reshape(100, 2, 100, 2, 3).mean(axis=(1, 3)).astype(np.uint8)
    direct = expose(small, sensor, np.random.default_rng(0), downscale=2).astype(float)
    assert np.abs(averaged - direct).max() < 12  # of a step of 200


def test_a_plain_sensor_changes_nothing():
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.0, read_noise=0.0)
    np.testing.assert_array_equal(expose(GREY, sensor, np.random.default_rng(0)), GREY)


def test_impossible_sensor_is_refused():
    with pytest.raises(SceneError, match="gain must be positive"):
        SensorConfig(gain=0.0)


def test_textures_come_from_the_seed_and_differ_from_each_other():
    first, again, other = (make_textures(np.random.default_rng(s), 9) for s in (1, 1, 2))
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.1
        assert a.shape == (512, 512, 3)


def test_distractors_lie_on_the_board_and_are_of_many_kinds():
    meshes = distractor_meshes()
    assert len({name.split("_")[0] for name in meshes}) >= 6
    for name, mesh in meshes.items():
        assert abs(mesh.bounds[0, 2]) < 1e-9, name
        assert mesh.extents.max() < 0.025, name


def test_range_upside_down_is_refused():
    with pytest.raises(SceneError, match="range ambient"):
        LookRanges(ambient=(0.5, 0.1))


def test_the_default_look_gets_its_share():
    rng = np.random.default_rng(0)
    looks = [draw_look(LookRanges(default_look=0.4), 5, rng) for _ in range(500)]
    assert np.mean([look.default for look in looks]) == pytest.approx(0.4, abs=0.08)
    assert {look.texture for look in looks} == {-1, 0, 1, 2, 3, 4}
    assert all(1 <= len(look.lamps) <= 3 for look in looks)


def test_camera_stays_within_its_ranges():
    rng, ranges = np.random.default_rng(0), ViewRanges()
    for _ in range(100):
        T = draw_camera(ranges, rng)
        assert abs(T[2, 3] - ranges.height_m) <= ranges.height_range_m
        assert np.degrees(np.arccos(-T[2, 2])) <= np.hypot(ranges.tilt_deg, ranges.tilt_deg) + 1e-9


def test_shots_keep_every_object_apart_and_use_every_face():
    parts = [load_part(name) for name in part_names()]
    radii = {name: float(np.linalg.norm(m.vertices[:, :2], axis=1).max()) for name, m in distractor_meshes().items()}
    ranges = ShotRanges()
    sampler, rng = ShotSampler(parts, radii, ranges), np.random.default_rng(3)
    faces = set()
    for draw in [sampler.crop] * 400 + [sampler.window] * 50:
        shot = draw(rng)
        if draw == sampler.crop and shot.parts:
            faces.add((shot.parts[0].name, shot.parts[0].stable_pose))
        circles = [(p.T_board_object[:2, 3], radii[p.name]) for p in shot.distractors]
        for placed in shot.parts:
            part = next(p for p in parts if p.name == placed.name)
            pose = part.stable_poses[placed.stable_pose]
            middle = (placed.T_board_object @ inverse(pose.T_table_part))[:2, 3]
            circles.append((middle, footprint_radius(part, pose)))
        for i, (a, r) in enumerate(circles):
            for b, s in circles[:i]:
                assert np.linalg.norm(a - b) > r + s + 0.9 * ranges.gap_m[0]
    assert len(faces) == sum(len(p.stable_poses) for p in parts)


def test_windows_lie_in_the_frame():
    parts = [load_part("main")]
    sampler, rng = ShotSampler(parts, {"ball_0": 0.002}, ShotRanges()), np.random.default_rng(3)
    quarter = BASLER.downscaled(4)
    for _ in range(50):
        shot = sampler.window(rng)
        x0, y0 = quarter.cx - shot.intrinsics.cx, quarter.cy - shot.intrinsics.cy
        assert 0 <= x0 <= quarter.width - 320
        assert 0 <= y0 <= quarter.height - 320
        p_cam = apply(inverse(shot.T_board_cam), [*shot.focus_board, 0.0])
        np.testing.assert_allclose(shot.intrinsics.project(p_cam), 160.0, atol=1e-6)


def test_parts_without_stable_poses_are_refused():
    part = replace(load_part("main"), stable_poses=())
    with pytest.raises(SceneError, match="has no stable poses"):
        ShotSampler([part], {"ball_0": 0.002}, ShotRanges())
