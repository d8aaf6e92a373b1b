"""Intervals and bounds: published values, and what drawing whole frames must give."""

import numpy as np
import pytest

from perception.bootstrap import FrameBootstrap, clopper_pearson_lower, clopper_pearson_upper


def test_clopper_pearson_agrees_with_published_values() -> None:
    assert clopper_pearson_lower(30, 30) == pytest.approx(0.905, abs=5e-4)
    assert clopper_pearson_lower(298, 298) < 0.99 <= clopper_pearson_lower(299, 299)
    assert clopper_pearson_upper(0, 299) == pytest.approx(1.0 - 0.05 ** (1 / 299))
    assert (clopper_pearson_lower(0, 5), clopper_pearson_upper(5, 5), clopper_pearson_upper(0, 0)) == (0.0, 1.0, 1.0)
    assert clopper_pearson_upper(3, 50) == pytest.approx(1.0 - clopper_pearson_lower(47, 50))


def test_intervals_hold_as_often_as_they_say() -> None:
    """Frames of five parts that share an error: at 95 % the true mean is inside nearly as often, not as for parts."""
    rng, inside, n_frames = np.random.default_rng(0), 0, 40
    frames = np.repeat(np.arange(n_frames), 5)
    for k in range(200):
        values = np.repeat(rng.normal(size=n_frames), 5) + 0.1 * rng.normal(size=frames.size)
        low, high = FrameBootstrap(range(n_frames), np.random.default_rng(k), 300).mean(values, frames.tolist())
        inside += low <= 0.0 <= high
    assert 0.88 < inside / 200 < 0.99


def test_frames_without_values_count_among_those_drawn() -> None:
    bootstrap = FrameBootstrap(range(10), np.random.default_rng(0), 500)
    assert bootstrap.mean([1.0, 1.0], [3, 4]) == (1.0, 1.0)
    low, high = bootstrap.mean([0.0, 1.0], [3, 4])
    assert (low, high) == (0.0, 1.0)
    assert np.isnan(bootstrap.mean([], [])).all() and np.isnan(bootstrap.quantile([], [], 0.5)).all()


def test_quantiles_bracket_the_sample_and_keep_its_order() -> None:
    rng = np.random.default_rng(2)
    values, frames = rng.exponential(size=400), (np.arange(400) // 4).tolist()
    bootstrap = FrameBootstrap(range(100), rng, 400)
    for q in (0.5, 0.95):
        low, high = bootstrap.quantile(values, frames, q)
        assert low < np.quantile(values, q) < high
    assert bootstrap.quantile(values, frames, 0.5)[1] < bootstrap.quantile(values, frames, 0.95)[0]


def test_a_ratio_of_the_same_frames_is_as_sure_as_they_are_alike() -> None:
    rng = np.random.default_rng(3)
    values, frames = rng.exponential(size=200), (np.arange(200) // 4).tolist()
    bootstrap = FrameBootstrap(range(50), rng, 300)
    low, high = bootstrap.ratio(30.0 * values, frames, values, frames)
    assert low == pytest.approx(30.0) and high == pytest.approx(30.0)


def test_nothing_to_draw_from_is_an_error() -> None:
    with pytest.raises(ValueError, match="0 frames"):
        FrameBootstrap([], np.random.default_rng(0))
