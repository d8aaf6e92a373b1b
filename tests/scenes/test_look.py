"""How a scene is lit and what it is made of: ranges, draws from them, textures, wear, and a stage dressed in them."""

import dataclasses
import re
import typing
from pathlib import Path

import numpy as np
import pytest

from cad.parts import load_part
from cad.spatial import BASLER
from scenes import ranges as all_ranges
from scenes.errors import SceneError
from scenes.look import classic_finish
from scenes.randomize import (
    DEFAULT_LAMPS,
    EXPOSURE,
    GOLD,
    LIGHTS,
    ROUGHNESS,
    camera_above,
    draw_camera,
    draw_distractor_surface,
    draw_look,
    draw_part_surface,
    draw_sensor,
)
from scenes.ranges import LOOKS, VIEWS, LensRanges, LookRanges, SensorRanges, ViewRanges
from scenes.shots import Placed, Shot
from scenes.stage import Stage, StageConfig
from scenes.textures import make_textures, make_wear, worn

ALL = (LookRanges, ViewRanges, SensorRanges, LensRanges)
STEEL, PLASTIC = load_part("main"), dataclasses.replace(load_part("main"), metallic=0.0, rgba=(0.2, 0.2, 0.21, 1.0))


def within(value, pair, slack=1e-12):
    return pair[0] - slack <= value <= pair[1] + slack


@pytest.mark.parametrize("kind", ALL)
def test_every_range_has_limits_that_hold_its_default_and_refuse_what_is_beyond(kind):
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        limits = hints[field.name].__metadata__[0]
        value = getattr(kind(), field.name)
        beyond, message = limits.high + 1, re.escape(f"{limits.low:g} to {limits.high:g}")
        wrong = (value[0], beyond) if isinstance(value, tuple) else beyond
        with pytest.raises(SceneError, match=f"range {field.name} = .*{message}"):
            kind(**{field.name: wrong})
        if isinstance(value, tuple) and limits.high > limits.low:
            middle = (limits.low + limits.high) / 2
            with pytest.raises(SceneError, match=f"range {field.name} = .*low end"):
                kind(**{field.name: (limits.high, middle)})


def test_the_documented_ranges_are_the_real_ones():
    text = (Path(__file__).parents[2] / "docs" / "looks.md").read_text()

    def shown(value):
        return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"

    splits = ((LOOKS["train"], LOOKS["test"]), (VIEWS["train"], VIEWS["test"]), (SensorRanges(), SensorRanges()))
    for train, test in splits:
        for name, value in vars(train).items():
            other = getattr(test, name)
            assert f"| `{name}` | {shown(value)} | {shown(other) if other != value else 'same'} |" in text


def test_not_a_number_is_refused():
    with pytest.raises(SceneError, match="range ambient"):
        LookRanges(ambient=(float("nan"), 0.2))


def test_the_test_split_differs_in_light_background_and_distance():
    train, test = LOOKS["train"], LOOKS["test"]
    assert LOOKS["val"] == train and VIEWS["val"] == VIEWS["train"]
    for name in ("lamp_elevation_deg", "ambient", "texture_repeat", "surroundings_level"):
        low, high = sorted((getattr(train, name), getattr(test, name)))
        assert low[1] < high[0], name
    assert VIEWS["train"].height_m[1] < VIEWS["test"].height_m[0]


@pytest.mark.parametrize("ranges", [all_ranges.TRAIN_LOOK, all_ranges.TEST_LOOK])
def test_every_drawn_look_keeps_its_ranges(ranges):
    for seed in range(300):
        rng = np.random.default_rng(seed)
        look = draw_look(ranges, 5, rng, environments=4, worn=3)
        assert -1 <= look.texture < 5 and 0 <= look.environment < 4 and -1 <= look.worn < 3
        if look.default:
            assert look.lamps == DEFAULT_LAMPS and look.texture == look.worn == -1
            continue
        assert within(len(look.lamps), ranges.lamps) and len(look.lamps) <= LIGHTS
        assert within(look.ambient, ranges.ambient)
        assert within(look.texture_repeat, ranges.texture_repeat)
        assert within(look.board_roughness, ranges.board_roughness)
        assert within(look.tag_level, ranges.tag_level)
        assert within(look.surroundings_level, ranges.surroundings_level)
        for k, lamp in enumerate(look.lamps):
            assert np.linalg.norm(lamp.towards) == pytest.approx(1)
            assert within(np.degrees(np.arcsin(lamp.towards[2])), ranges.lamp_elevation_deg, 1e-9)
            assert within(lamp.distance_m, ranges.lamp_distance_m)
            assert within(lamp.radius_m, ranges.lamp_radius_m)
            assert not (lamp.shadow and k > 0)
        total = sum(np.mean(lamp.rgb) for lamp in look.lamps)
        assert within(total, ranges.lamp_total, 4 * ranges.lamp_tint * ranges.lamp_total[1])


def test_the_same_seed_gives_the_same_look_in_every_domain():
    """Domains differ in the number of environments they hold, never in what is drawn."""
    looks = [draw_look(LookRanges(), 5, np.random.default_rng(3), environments=12, worn=3) for _ in range(2)]
    assert looks[0] == looks[1]
    assert looks[0] != draw_look(LookRanges(), 5, np.random.default_rng(4), environments=12, worn=3)


def test_shares_are_kept():
    ranges, rng = LookRanges(default_look=0.4, worn_share=0.3, texture_share=0.7), np.random.default_rng(0)
    looks = [draw_look(ranges, 5, rng, environments=2, worn=2) for _ in range(800)]
    assert np.mean([look.default for look in looks]) == pytest.approx(0.4, abs=0.06)
    others = [look for look in looks if not look.default]
    assert np.mean([look.worn >= 0 for look in others]) == pytest.approx(0.3, abs=0.07)
    assert np.mean([look.texture >= 0 for look in others]) == pytest.approx(0.7, abs=0.07)


def test_without_textures_environments_and_wear_none_is_drawn():
    rng = np.random.default_rng(0)
    looks = [draw_look(LookRanges(), 0, rng) for _ in range(50)]
    assert {(look.texture, look.environment, look.worn) for look in looks} == {(-1, -1, -1)}


def test_a_metal_part_stays_a_metal_of_its_colour():
    ranges, rng = LookRanges(gold_share=0.0), np.random.default_rng(0)
    nominal = np.array(STEEL.rgba[:3])
    for _ in range(300):
        surface = draw_part_surface(ranges, STEEL, False, rng)
        rgb = np.array(surface.rgb)
        assert within(surface.metallic, ranges.metallic)
        assert within(surface.roughness, ROUGHNESS)
        assert rgb.max() / rgb.min() < 1.35  # grey stays grey
        assert 0.5 * nominal.mean() ** 2.2 < rgb.mean() <= 1.0


def test_a_black_plastic_part_stays_dark_and_no_metal():
    ranges, rng = LookRanges(gold_share=1.0), np.random.default_rng(0)
    for _ in range(300):
        surface = draw_part_surface(ranges, PLASTIC, False, rng)
        assert surface.metallic == 0.0
        assert max(surface.rgb) < 0.35


def test_gold_plating_has_its_share_and_spares_blackened_metal():
    rng = np.random.default_rng(0)

    def yellow(part, share):
        surfaces = [draw_part_surface(LookRanges(gold_share=share), part, False, rng) for _ in range(400)]
        return np.mean([surface.rgb[2] / surface.rgb[0] < 0.78 for surface in surfaces])

    assert GOLD[2] / GOLD[0] < 0.65
    assert yellow(STEEL, 0.25) == pytest.approx(0.25, abs=0.07)
    assert yellow(dataclasses.replace(STEEL, rgba=(0.22, 0.22, 0.23, 1.0)), 1.0) == 0.0


def test_the_default_look_has_the_pick_cells_materials():
    surface = draw_part_surface(LookRanges(), STEEL, True, np.random.default_rng(0))
    assert (surface.metallic, surface.roughness) == (STEEL.metallic, STEEL.roughness)
    assert (surface.specular, surface.shininess) == classic_finish(STEEL.metallic, STEEL.roughness)
    np.testing.assert_allclose(np.array(surface.rgb) / STEEL.rgba[:3], surface.rgb[0] / STEEL.rgba[0])


def test_smoother_surfaces_have_sharper_highlights():
    rng = np.random.default_rng(0)
    surfaces = [draw_part_surface(LookRanges(), STEEL, False, rng) for _ in range(100)]
    surfaces += [draw_distractor_surface(LookRanges(), rng) for _ in range(100)]
    order = np.argsort([surface.roughness for surface in surfaces])
    shininess = np.array([surface.shininess for surface in surfaces])[order]
    assert (np.diff(shininess) <= 1e-12).all()
    assert all(0 <= s.specular <= 1 and min(s.rgb) >= 0 and max(s.rgb) <= 1 for s in surfaces)


@pytest.mark.parametrize("ranges", list(VIEWS.values()))
def test_the_camera_stays_within_its_ranges(ranges):
    rng = np.random.default_rng(0)
    for _ in range(200):
        T = draw_camera(ranges, rng)
        assert within(T[2, 3], ranges.height_m)
        assert np.abs(T[:2, 3]).max() <= ranges.shift_m
        assert np.degrees(np.arccos(-T[2, 2])) <= np.hypot(ranges.tilt_deg, ranges.tilt_deg) + 1e-9
        assert abs(np.degrees(np.arctan2(T[1, 0], T[0, 0]))) <= ranges.yaw_deg + 0.1


def test_every_drawn_sensor_keeps_its_ranges():
    ranges = SensorRanges(bayer_share=0.4, gamma=(0.5, 1.0))
    rng, bayer = np.random.default_rng(0), 0
    for brightest in np.linspace(1, 900, 300):
        sensor = draw_sensor(ranges, brightest, rng)
        reached = sensor.exposure * brightest
        assert within(reached, ranges.highlight, 1e-6) or sensor.exposure in EXPOSURE
        assert within(sensor.blur_px, ranges.blur_px) and within(sensor.gamma, ranges.gamma)
        assert np.abs(sensor.gradient).max() <= ranges.gradient
        gains = np.array(sensor.white_balance)
        assert gains.min() == 1.0
        assert np.abs(gains / gains[1] - 1).max() <= ranges.white_balance + 1e-9
        K_low, K_high = 255 / ranges.saturation_e[1], 255 / ranges.saturation_e[0] * 10 ** (12 / 20)
        assert within(sensor.shot_noise, (K_low, K_high))
        assert within(sensor.read_noise / sensor.shot_noise, ranges.dark_noise_e, 1e-9)
        bayer += sensor.bayer
    assert bayer / 300 == pytest.approx(0.4, abs=0.1)


def test_textures_come_from_the_seed_and_differ_from_each_other():
    first, again, other = (make_textures(np.random.default_rng(s), 9) for s in (1, 1, 2))
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).mean() > 0.1
        assert a.shape == (512, 512, 3)


def test_wear_spares_what_it_does_not_cover_and_marks_the_rest():
    layers = make_wear(np.random.default_rng(0), 4)
    image = np.random.default_rng(1).integers(0, 256, (512, 512, 3), dtype=np.uint8)
    for layer in layers:
        out = worn(image, layer).astype(int)
        cover, colour = layer[..., 3:] / 255, layer[..., :3].astype(int)
        np.testing.assert_allclose(out, image + cover * (colour - image.astype(int)), atol=1.01)
        assert 0.02 < cover.mean() < 0.7
    bare = np.zeros((512, 512, 4), np.uint8)
    np.testing.assert_array_equal(worn(image, bare), image)


@pytest.fixture(scope="module")
def stage():
    config = StageConfig(slots=2, max_size=(128, 128), shadow_half_m=0.02, shadow_size=256)
    rng = np.random.default_rng(0)
    stage = Stage([load_part("main"), load_part("top")], make_textures(rng, 2), config, wear=make_wear(rng, 1))
    yield stage
    stage.close()


def shot_of(stage, *names):
    """A shot of parts in a row, at rest on their first faces."""
    placed = []
    for i, name in enumerate(names):
        T = stage.part(name).stable_poses[0].T_table_part.copy()
        T[0, 3] += 0.012 * i
        placed.append(Placed(name=name, T_board_object=T, stable_pose=0))
    camera = BASLER.crop(2736 - 64, 1824 - 64, 128, 128)
    return Shot(
        intrinsics=camera,
        downscale=1,
        T_board_cam=camera_above(0.7),
        focus_board=(0.0, 0.0),
        parts=tuple(placed),
        distractors=(),
    )


def test_dressing_sets_every_material_shown(stage):
    shot, model = shot_of(stage, "main", "top"), stage.model
    stage.arrange(shot)
    ranges = LookRanges(default_look=0.0, texture_share=1.0, worn_share=1.0, gold_share=0.0)
    seen = set()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        look = draw_look(ranges, 2, rng, environments=3, worn=1)
        stage.dress(shot, look, ranges, rng)
        plate = model.geom_matid[model.geom("board_visual").id]
        assert model.material(plate).name == f"plate_{look.texture:02d}"
        np.testing.assert_allclose(model.mat_rgba[plate, :3], look.board_rgb, rtol=1e-6)
        tags = model.geom_matid[model.geom("tags_visual").id]
        assert model.material(tags).name == "tags_00"
        for geom in stage.shown:
            k = model.geom_matid[geom]
            assert within(model.mat_metallic[k], ranges.metallic, 1e-6)
            assert within(model.mat_roughness[k], ROUGHNESS, 1e-6)
        seen.add(stage.render(shot.intrinsics, ("rgb",)).rgb.tobytes())
    assert len(seen) == 6


def test_what_a_dressed_stage_shows_does_not_depend_on_what_it_showed_before(stage):
    def picture(seed, *names):
        rng, ranges = np.random.default_rng(seed), LookRanges()
        shot = shot_of(stage, *names)
        stage.arrange(shot)
        stage.dress(shot, draw_look(ranges, 2, rng, environments=3, worn=1), ranges, rng)
        return stage.render(shot.intrinsics, ("rgb",)).rgb.copy()

    first = picture(0, "main")
    for seed in range(1, 5):
        picture(seed, "top", "main", "main")
    np.testing.assert_array_equal(picture(0, "main"), first)
