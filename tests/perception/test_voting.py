import numpy as np
import pytest

from perception.voting import VotingError, offset_vote, ransac_vote, vector_field

SHIFT = np.array([5.0, -3.0])


def scene(rng: np.random.Generator, n_pixels: int = 200):
    pixels = rng.uniform(30, 90, (n_pixels, 2))
    keypoints = np.array([[20.0, 40.0], [95.0, 60.0], [60.0, 61.0]])
    wanted = keypoints - pixels[:, None]
    return pixels, keypoints, wanted


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_ransac_finds_exact_keypoints() -> None:
    pixels, keypoints, wanted = scene(np.random.default_rng(0))
    found, covariance = ransac_vote(pixels, unit(wanted), np.random.default_rng(1))
    assert np.allclose(found, keypoints, atol=1e-3)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_ransac_survives_a_third_of_random_votes() -> None:
    rng = np.random.default_rng(2)
    pixels, keypoints, wanted = scene(rng)
    votes = unit(wanted + rng.normal(0, 0.3, wanted.shape))
    votes[:70] = unit(rng.normal(size=votes[:70].shape))
    found, _ = ransac_vote(pixels, votes, rng)
    assert np.linalg.norm(found - keypoints, axis=1).max() < 1.5


def test_ransac_covariance_grows_with_noise() -> None:
    pixels, _, wanted = scene(np.random.default_rng(3))
    traces = []
    for sigma in (0.5, 4.0):
        rng = np.random.default_rng(4)
        _, covariance = ransac_vote(pixels, unit(wanted + rng.normal(0, sigma, wanted.shape)), rng)
        traces.append(np.trace(covariance, axis1=1, axis2=2))
    assert (traces[1] > traces[0]).all()


def test_the_same_seed_gives_the_same_votes() -> None:
    pixels, _, wanted = scene(np.random.default_rng(5))
    a, b = (ransac_vote(pixels, wanted, np.random.default_rng(6)) for _ in range(2))
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])


def test_parallel_votes_give_an_answer_with_a_wide_covariance() -> None:
    pixels = np.stack([np.arange(20.0), np.zeros(20)], axis=1)
    found, covariance = ransac_vote(pixels, np.tile([[[0.0, 1.0]]], (20, 1, 1)), np.random.default_rng(0))
    assert np.isfinite(found).all() and np.trace(covariance[0]) > 10


def test_offset_vote_is_exact_and_translates_with_its_pixels() -> None:
    pixels, keypoints, wanted = scene(np.random.default_rng(7))
    found, _ = offset_vote(pixels, wanted, np.zeros(wanted.shape[:2]))
    moved, _ = offset_vote(pixels + SHIFT, wanted, np.zeros(wanted.shape[:2]))
    assert np.allclose(found, keypoints, atol=1e-9)
    assert np.allclose(moved, keypoints + SHIFT, atol=1e-9)


def test_confident_offset_votes_count_more() -> None:
    rng = np.random.default_rng(8)
    pixels, keypoints, wanted = scene(rng)
    log_scale = np.zeros(wanted.shape[:2])
    wanted[100:] += [30.0, 0.0]
    log_scale[100:] = 3.0
    found, covariance = offset_vote(pixels, wanted, log_scale)
    assert np.linalg.norm(found - keypoints, axis=1).max() < 0.5
    assert (covariance[:, 0, 0] > covariance[:, 1, 1]).all()


def test_too_few_pixels_and_wrong_shapes_are_named() -> None:
    with pytest.raises(VotingError, match="3 pixels vote"):
        ransac_vote(np.zeros((3, 2)), np.ones((3, 1, 2)), np.random.default_rng(0))
    with pytest.raises(VotingError, match=r"expected \(P, 2\)"):
        offset_vote(np.zeros((5, 2)), np.ones((4, 1, 2)), np.zeros((4, 1)))
    with pytest.raises(VotingError, match="log_scale"):
        offset_vote(np.zeros((5, 2)), np.ones((5, 1, 2)), np.zeros((5, 2)))


def test_the_vector_field_points_to_the_keypoints_it_was_made_of() -> None:
    mask = np.zeros((40, 60), bool)
    mask[10:30, 15:45] = True
    keypoints = np.array([[20.25, 12.5], [44.0, 29.75], [70.0, -5.0], [18.0, 20.0]])
    field = vector_field(mask, keypoints)
    assert field.shape == (40, 60, 4, 2) and field.dtype == np.float32
    assert not field[~mask].any() and not field[20, 18, 3].any()
    np.testing.assert_allclose(field[12, 18, 0], np.array([2.25, 0.5]) / np.hypot(2.25, 0.5), atol=1e-6)
    v, u = np.nonzero(mask)
    found, _ = ransac_vote(np.stack([u, v], axis=-1), field[v, u], np.random.default_rng(0))
    np.testing.assert_allclose(found, keypoints, atol=0.02)
    with pytest.raises(VotingError, match=r"\(40, 60\) and keypoints \(8,\)"):
        vector_field(mask, keypoints.ravel())
