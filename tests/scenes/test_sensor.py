"""The sensor against EMVA 1288 and against what it must leave alone."""

import cv2
import numpy as np
import pytest

from cad.spatial import BASLER
from scenes.errors import SceneError
from scenes.randomize import draw_sensor
from scenes.ranges import SensorRanges
from scenes.sensor import GLINT, SensorConfig, brightest, expose, mosaic_phase, noise_levels

SILENT = {"blur_px": 0.0, "shot_noise": 0.0, "read_noise": 0.0}


def grey(level, size=200):
    return np.full((size, size, 3), level, np.float32)


def edge_position(row):
    """Where a rising edge is, in pixels from the left border: the first moment of its slope."""
    low, high = row[:20].mean(), row[-20:].mean()
    return ((high - row) / (high - low)).sum()


def edge_image(at, *, blur_px, height=64, width=96):
    """A vertical edge between 40 and 200 at column ``at``, each pixel the mean over its area, then blurred."""
    columns = np.clip(np.arange(width) + 0.5 - at, 0, 1) * 160 + 40
    image = np.repeat(np.tile(columns, (height, 1))[..., None], 3, axis=2).astype(np.float32)
    return expose(image, SensorConfig(**(SILENT | {"blur_px": blur_px})), np.random.default_rng(0)).astype(np.float32)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("gain_db", [0.0, 12.0])
def test_photon_transfer_gives_back_gain_and_dark_noise(quick, gain_db):
    dark_noise_e, saturation_e = 30.0, 15000.0
    shot, read = noise_levels(saturation_e=saturation_e, dark_noise_e=dark_noise_e, analog_gain_db=gain_db)
    sensor = SensorConfig(blur_px=0.0, shot_noise=shot, read_noise=read, quick=quick)
    rng, levels = np.random.default_rng(0), np.linspace(30, 210, 10)
    images = [expose(grey(level, 400), sensor, rng).astype(float) for level in levels]
    slope, offset = np.polyfit([i.mean() for i in images], [i.var() - 1 / 12 for i in images], 1)
    K = 255 / saturation_e * 10 ** (gain_db / 20)
    assert slope == pytest.approx(K, rel=0.03)
    assert np.sqrt(max(offset, 0)) / K == pytest.approx(dark_noise_e, rel=0.15)


def test_at_saturation_the_signal_to_noise_ratio_is_the_root_of_the_electrons():
    shot, read = noise_levels(saturation_e=15000.0, dark_noise_e=0.0)
    image = expose(
        grey(200.0, 500), SensorConfig(blur_px=0.0, shot_noise=shot, read_noise=read), np.random.default_rng(1)
    )
    electrons = 200 / 255 * 15000
    assert image.mean() / np.sqrt(image.var() - 1 / 12) == pytest.approx(np.sqrt(electrons), rel=0.02)


def test_quick_noise_is_normal():
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.0, read_noise=20.0, quick=True)
    z = (expose(grey(127.0, 600), sensor, np.random.default_rng(2)).astype(float) - 127) / np.sqrt(400 + 1 / 12)
    assert z.mean() == pytest.approx(0, abs=0.005)
    assert (z**2).mean() == pytest.approx(1, abs=0.005)
    assert (z**3).mean() == pytest.approx(0, abs=0.02)
    assert (z**4).mean() == pytest.approx(3, abs=0.05)
    neighbours = [z[:, 1:] * z[:, :-1], z[1:] * z[:-1], z[..., 1:] * z[..., :-1]]
    assert all(abs(product.mean()) < 0.006 for product in neighbours)


@pytest.mark.parametrize("downscale", [1, 2, 2.5])
def test_noise_of_a_smaller_image_is_that_of_averaged_pixels(downscale):
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.05, read_noise=2.0)
    image = expose(grey(100.0), sensor, np.random.default_rng(0), downscale)
    assert image.var() == pytest.approx((4.0 + 5.0) / downscale**2 + 1 / 12, rel=0.05)
    assert image.mean() == pytest.approx(100, abs=0.1)


def test_blur_of_a_smaller_image_is_that_of_averaged_pixels():
    sensor = SensorConfig(**(SILENT | {"blur_px": 1.2}))
    edge = np.repeat(np.tile((np.arange(200) >= 100) * 200.0, (200, 1))[..., None], 3, 2).astype(np.float32)
    full = expose(edge, sensor, np.random.default_rng(0)).astype(float)
    averaged = full.reshape(100, 2, 100, 2, 3).mean(axis=(1, 3))
    small = edge.reshape(100, 2, 100, 2, 3).mean(axis=(1, 3))
    direct = expose(small, sensor, np.random.default_rng(0), downscale=2).astype(float)
    assert np.abs(averaged - direct).max() < 12  # of a step of 200


@pytest.mark.parametrize("bayer", [False, True])
def test_a_plain_sensor_changes_nothing_but_colour_detail(bayer):
    image = expose(grey(100.0), SensorConfig(**SILENT, bayer=bayer), np.random.default_rng(0))
    np.testing.assert_array_equal(image, 100)


def test_light_that_exceeds_saturation_blooms_before_it_is_cut():
    image = grey(20.0, 61)
    image[30, 30] = 5000.0
    sensor = SensorConfig(**(SILENT | {"blur_px": 1.0, "exposure": 0.5}))
    out = expose(image, sensor, np.random.default_rng(0))
    assert out.max() == 255
    assert (out[30, 29:32, 0] > 240).all()


def test_exposure_and_uneven_light_scale_grey_levels():
    sensor = SensorConfig(**SILENT, exposure=1.5, gradient=(0.2, -0.1))
    out = expose(grey(100.0, 101), sensor, np.random.default_rng(0))
    assert out[50, 50, 0] == 150
    assert out[50, -1, 0] == 180 and out[50, 0, 0] == 120
    assert out[-1, 50, 0] == 135 and out[0, 50, 0] == 165


@pytest.mark.parametrize("bayer", [False, True])
def test_white_balance_scales_colours_and_their_noise(bayer):
    gains = (1.5, 1.0, 1.25)
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.05, read_noise=2.0, white_balance=gains, bayer=bayer)
    image = expose(grey(100.0, 300), sensor, np.random.default_rng(0)).astype(float)
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 100 * np.array(gains), atol=0.2)
    if not bayer:
        np.testing.assert_allclose(image.var(axis=(0, 1)), 9 * np.array(gains) ** 2, rtol=0.05)


@pytest.mark.parametrize("bayer", [False, True])
def test_gamma_is_undone_by_its_inverse(bayer):
    ramp = np.repeat(np.tile(np.linspace(20, 250, 128), (64, 1))[..., None], 3, 2).astype(np.float32)
    coded = expose(ramp, SensorConfig(**SILENT, gamma=0.6, bayer=bayer), np.random.default_rng(0))
    decoded = 255 * (coded / 255) ** (1 / 0.6)
    np.testing.assert_allclose(decoded[:, 2:-2], ramp[:, 2:-2], atol=1.5)


@pytest.mark.parametrize("phase", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_the_mosaic_keeps_every_colour_wherever_the_window_begins(phase):
    image = np.zeros((40, 52, 3), np.float32)
    image[:] = (200, 120, 40)
    sensor = SensorConfig(**SILENT, bayer=True)
    out = expose(image, sensor, np.random.default_rng(0), phase=phase)
    np.testing.assert_array_equal(out, image.astype(np.uint8))


def test_the_mosaic_of_a_window_is_that_of_the_frame():
    rng = np.random.default_rng(0)
    frame = rng.uniform(0, 255, (60, 60, 3)).astype(np.float32)
    sensor = SensorConfig(**SILENT, bayer=True)
    whole = expose(frame, sensor, rng)
    for y, x in ((4, 6), (5, 6), (4, 7), (5, 7)):
        window = expose(frame[y : y + 32, x : x + 32], sensor, rng, phase=mosaic_phase(BASLER.crop(x, y, 32, 32)))
        np.testing.assert_array_equal(window[2:-2, 2:-2], whole[y + 2 : y + 30, x + 2 : x + 30])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_the_mosaic_does_not_shift_edges(turned, blur_px):
    shifts = []
    for at in np.arange(40, 42, 0.25):
        image = edge_image(at, blur_px=blur_px)
        image = image.transpose(1, 0, 2) if turned else image
        sensor = SensorConfig(**SILENT, bayer=True)
        out = expose(np.ascontiguousarray(image), sensor, np.random.default_rng(0)).astype(float)
        image, out = (im.transpose(1, 0, 2) if turned else im for im in (image, out))
        shifts.append(edge_position(out.mean(axis=(0, 2))) - edge_position(image.mean(axis=(0, 2))))
    assert np.abs(shifts).max() < 0.02
    assert abs(np.mean(shifts)) < 0.005


def test_a_mosaic_means_fewer_samples_of_each_colour_in_a_smaller_image():
    sensor = SensorConfig(blur_px=0.0, shot_noise=0.0, read_noise=8.0, bayer=True)
    image = expose(grey(120.0, 300), sensor, np.random.default_rng(0), downscale=4).astype(float)
    samples = np.array([4, 8, 4])  # of 16 pixels
    np.testing.assert_allclose(image.var(axis=(0, 1)) - 1 / 12, 64 / samples, rtol=0.05)


def test_the_same_generator_gives_the_same_image():
    image = grey(90.0, 64)
    for sensor in (SensorConfig(), SensorConfig(quick=True), SensorConfig(bayer=True, quick=True, gamma=0.7)):
        a, b, c = (expose(image, sensor, np.random.default_rng(seed)) for seed in (1, 1, 2))
        np.testing.assert_array_equal(a, b)
        assert (a != c).any()


def test_the_default_sensor_is_what_the_pick_cell_was_tuned_on():
    """Blur of 0.6 pixels, then noise of variance 0.25 + 0.017 for each grey level from the generator's own normals."""
    image = np.random.default_rng(0).integers(0, 256, (97, 113, 3), dtype=np.uint8)
    ideal = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6, borderType=cv2.BORDER_REFLECT_101)
    ideal = np.clip(ideal, 0, 255)
    noise = np.random.default_rng(7).standard_normal(image.shape, dtype=np.float32)
    expected = np.rint(np.clip(ideal + noise * np.sqrt(0.25 + 0.017 * ideal), 0, 255))
    np.testing.assert_array_equal(expose(image, SensorConfig(), np.random.default_rng(7)), expected)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_exposing_leaves_the_ideal_image_alone(dtype):
    image = grey(90.0, 64).astype(dtype)
    for bayer in (False, True):
        expose(image, SensorConfig(exposure=1.3, bayer=bayer), np.random.default_rng(0))
        assert (image == 90).all()


def test_the_brightest_fiftieth_sets_the_exposure():
    image = grey(50.0, 400)
    image[:60, :60] = 180.0
    level = brightest(image)
    assert level == 180.0
    image[:60, :60] = 5000.0
    assert brightest(image) == GLINT
    sensor = draw_sensor(SensorRanges(highlight=(240.0, 240.0), gradient=0.0), level, np.random.default_rng(0))
    assert sensor.exposure * 180 == pytest.approx(240)


@pytest.mark.parametrize(
    ("field", "value"),
    [("exposure", 0.0), ("blur_px", -1.0), ("gamma", np.nan), ("white_balance", (1.0, 0.0, 1.0))],
)
def test_an_impossible_sensor_is_refused(field, value):
    with pytest.raises(SceneError, match=field):
        SensorConfig(**{field: value})
