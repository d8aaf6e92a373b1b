from dataclasses import replace

import numpy as np
import pytest

from cad.parts import planar
from cad.spatial import rotation_from_rotvec, rotation_x, transform
from perception.contour import Refinement
from perception.covariance import (
    QUALITIES,
    Errors,
    NoiseModel,
    fit_noise,
    inner_error,
    joined,
    normalised_squares,
    pose_covariance,
    shortfall_of,
)

T_CAM_TABLE = transform(rotation_x(np.pi + 0.02), [0.01, -0.02, 0.7])
T_REST = transform(rotation_from_rotvec([0.4, -0.2, 0.9]), [1e-3, -5e-4, 1.5e-3])
AT = (0.11, -0.06, 0.7)
GAUSS_NEWTON = np.diag(np.square([4e-6, 6e-6, 4e-4]))
CONTOUR = Refinement(
    x=AT[0],
    y=AT[1],
    yaw=AT[2],
    covariance=GAUSS_NEWTON,
    matched_fraction=0.7,
    matched_outline=0.8,
    correlation=0.9,
    explained=0.95,
)
NOISE = NoiseModel(scale=2.0, floor_m=1e-5, floor_rad=1e-3, height_m=4e-5, lean_rad=3e-3, growth=(2.0, 0.5, 4.0, 0.7))
PROBABILITY = 0.99


def shortfall(contour: Refinement, probability: float = PROBABILITY) -> np.ndarray:
    return shortfall_of([getattr(contour, name) for name in QUALITIES], probability)


def pose(x: float, y: float, yaw: float, height: float = 0.0, lean: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A part that leans about its foot, on a table that is higher; its foot stays on the same ray to the camera."""
    foot = T_CAM_TABLE @ [x, y, 0.0, 1.0]
    normal = T_CAM_TABLE[:3, 2]
    along_ray = transform(np.eye(3), foot[:3] / (normal @ foot[:3]) * height)
    leaning = transform(rotation_from_rotvec([*lean, 0.0]))
    return along_ray @ T_CAM_TABLE @ planar(x, y, 0.0) @ leaning @ planar(0.0, 0.0, yaw) @ T_REST


def test_covariance_is_that_of_sampled_poses() -> None:
    rng, T = np.random.default_rng(0), pose(*AT)
    stated = pose_covariance(CONTOUR, PROBABILITY, NOISE, T_CAM_TABLE, T)
    flat = NOISE.flat(GAUSS_NEWTON, shortfall(CONTOUR))
    squares = []
    for x, y, yaw in rng.multivariate_normal(AT, flat, 3000):
        lean = (rng.normal(0, NOISE.lean_rad), rng.normal(0, NOISE.lean_rad))
        other = pose(x, y, yaw, rng.normal(0, NOISE.height_m), lean)
        turn = other[:3, :3] @ T[:3, :3].T
        rotvec = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        error = np.concatenate([other[:3, 3] - T[:3, 3], rotvec])
        squares.append(error @ np.linalg.solve(stated, error))
    assert np.mean(squares) == pytest.approx(6.0, abs=0.3)
    assert np.linalg.eigvalsh(stated).min() > 0


def test_each_cause_is_found_again_in_the_error() -> None:
    x, y, yaw = AT
    T = pose(x, y, yaw)
    wrong = pose(x + 3e-5, y - 2e-5, yaw + 2e-3, 6e-5, (1e-3, -2e-3))
    found = inner_error(wrong, T, T_CAM_TABLE, x, y)
    np.testing.assert_allclose(found, [3e-5, -2e-5, 2e-3, 6e-5, 1e-3, -2e-3], rtol=0.02, atol=3e-7)


def test_a_higher_table_moves_a_part_along_its_ray_alone() -> None:
    tight = replace(NOISE, scale=1e-6, floor_m=1e-9, floor_rad=1e-9, lean_rad=1e-9)
    C = pose_covariance(CONTOUR, PROBABILITY, tight, T_CAM_TABLE, pose(*AT))
    foot = T_CAM_TABLE @ [AT[0], AT[1], 0.0, 1.0]
    ray = foot[:3] / np.linalg.norm(foot[:3])
    across = np.eye(3) - np.outer(ray, ray)
    assert np.trace(across @ C[:3, :3] @ across) < 1e-4 * np.trace(C[:3, :3])


def draw(n: int, rng: np.random.Generator, noise: NoiseModel = NOISE) -> Errors:
    contours = GAUSS_NEWTON * rng.uniform(0.3, 3.0, n)[:, None, None]
    lacks = rng.uniform(0.0, [0.7, 0.4, 0.3, 1.2], (n, 4))
    errors = [rng.multivariate_normal(np.zeros(6), noise.inner(C, s)) for C, s in zip(contours, lacks, strict=True)]
    return Errors(by_cause=np.array(errors), planar=contours, shortfall=lacks, accepted=lacks[:, 3] < 0.8)


def test_fitted_noise_holds_on_other_errors() -> None:
    rng = np.random.default_rng(1)
    other = replace(NOISE, floor_m=3e-5, floor_rad=4e-3)
    seen = {"a 0": draw(300, rng), "b 1": draw(300, rng, other)}
    seen["a 0"].by_cause[:3, 0] = 3e-3  # a rim taken for the outline
    fitted = fit_noise([seen])
    for part, noise in (("a", NOISE), ("b", other), ("a 0", NOISE), ("b 1", other)):
        new = draw(2000, rng, noise)
        flat, whole = normalised_squares(new, fitted[part])
        assert flat.mean() == pytest.approx(3.0, abs=0.5)
        assert whole.mean() == pytest.approx(6.0, abs=0.6)
        bad = new.shortfall[:, 0] > 0.4
        assert flat[bad].mean() == pytest.approx(3.0, abs=0.6)  # it grows as it should where contours are bad
    assert fitted["a"].height_m == pytest.approx(NOISE.height_m, rel=0.15)


def test_faces_of_a_part_have_noise_of_their_own_and_rare_ones_that_of_the_part() -> None:
    rng = np.random.default_rng(5)
    upright = replace(NOISE, floor_m=6e-5, floor_rad=6e-3)
    fitted = fit_noise([{"a 0": draw(200, rng), "a 1": draw(200, rng, upright), "a 2": draw(5, rng)} for _ in range(3)])
    assert set(fitted) == {"a", "a 0", "a 1"}
    assert 3 * fitted["a 0"].floor_m < fitted["a 1"].floor_m
    for face, noise in (("a 0", NOISE), ("a 1", upright)):
        new = draw(2000, rng, noise)
        assert normalised_squares(new.take(new.accepted), fitted[face])[0].mean() == pytest.approx(3.0, abs=0.4)


def test_noise_is_widened_by_what_other_folds_hold() -> None:
    rng = np.random.default_rng(3)
    folds = [{"a 0": draw(25, rng)} for _ in range(4)]
    alone, widened = fit_noise([{"a 0": joined([fold["a 0"] for fold in folds])}])["a"], fit_noise(folds)["a"]
    factor = widened.scale / alone.scale
    assert 1.0 < factor < 2.0
    assert widened.floor_m == pytest.approx(alone.floor_m * np.sqrt(factor), rel=1e-3)
    assert widened.height_m == alone.height_m
    new = draw(1000, rng)
    assert normalised_squares(new, widened)[0].mean() < normalised_squares(new, alone)[0].mean()


def test_noise_is_that_of_accepted_estimates() -> None:
    """Errors of the others have tails that no Gaussian has: they must not make the accepted ones look uncertain."""
    rng = np.random.default_rng(4)
    folds = []
    for _ in range(4):
        errors = draw(120, rng)
        errors.by_cause[~errors.accepted] *= rng.choice([1.0, 8.0], (np.count_nonzero(~errors.accepted), 1))
        folds.append({"a 0": errors})
    fitted = fit_noise(folds)["a"]
    new = draw(2000, rng)
    flat, whole = normalised_squares(new.take(new.accepted), fitted)
    assert flat.mean() == pytest.approx(3.0, abs=0.4)
    assert whole.mean() == pytest.approx(6.0, abs=0.6)


def test_a_worse_contour_has_a_larger_covariance_up_to_a_limit() -> None:
    def size(**scores: float) -> float:
        return float(np.linalg.det(NOISE.flat(GAUSS_NEWTON, shortfall(replace(CONTOUR, **scores)))))

    assert size(matched_fraction=1.0) < size() < size(matched_fraction=0.2) < size(matched_fraction=0.2, explained=0.5)
    assert np.all(shortfall(CONTOUR, 0.5) >= shortfall(CONTOUR)) and shortfall(CONTOUR, 1.0)[3] == 0.0
    bad = dict.fromkeys(("matched_fraction", "correlation", "explained"), -9.0)
    assert size(**bad) == size(**dict.fromkeys(bad, -10.0))


def test_few_errors_say_nothing() -> None:
    assert fit_noise([{"a 0": draw(5, np.random.default_rng(2))}]) == {}
    with pytest.raises(ValueError, match="floor_m"):
        NoiseModel(floor_m=0.0)
    with pytest.raises(ValueError, match="growth"):
        NoiseModel(growth=(1.0,))
