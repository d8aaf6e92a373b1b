import numpy as np
import pytest

from perception.encoding import DARK_LEVELS, encode, encoded


def test_ends_stay_and_order_is_kept() -> None:
    levels = encode(np.arange(256, dtype=np.float32))
    assert levels[0] == pytest.approx(0.0, abs=1e-4) and levels[255] == pytest.approx(255.0, abs=1e-3)
    assert (np.diff(levels) > 0).all()


def test_noise_is_about_as_large_in_the_dark_as_in_the_light() -> None:
    """Photons of a camera whose electronics are as noisy as the light of DARK_LEVELS."""
    rng, electrons = np.random.default_rng(0), 20.0
    linear, even = [], []
    for level in (3.0, 15.0, 60.0, 200.0):
        light = rng.poisson(level * electrons, 20000) / electrons
        seen = light + rng.normal(0.0, np.sqrt(DARK_LEVELS / electrons), 20000)
        linear.append(seen.std())
        even.append(encode(np.maximum(seen, 0.0).astype(np.float32)).std())
    assert max(linear) / min(linear) > 3.0
    assert max(even) / min(even) < 1.3


def test_images_are_encoded_pixel_by_pixel() -> None:
    image = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    out = encoded(image)
    assert out.dtype == np.float32
    np.testing.assert_allclose(out, encode(image.astype(np.float32)), atol=1e-4)


def test_what_lies_in_a_shadow_keeps_its_contrast() -> None:
    ground, part, lit = encode(np.array([1.0, 14.0, 200.0], np.float32))
    assert part - ground > 2 * (14.0 - 1.0)
    assert (part - ground) / (lit - ground) > 2 * 13.0 / 199.0
