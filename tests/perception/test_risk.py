import numpy as np
import pytest

from perception.risk import risk_coverage


def test_curve_of_a_few_estimates_by_hand() -> None:
    found = risk_coverage([0.9, 0.8, 0.7, 0.6], [False, True, False, True])
    np.testing.assert_allclose(found.coverage, [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(found.risk, [0.0, 0.5, 1 / 3, 0.5])
    assert found.area == pytest.approx(np.mean([0.0, 0.5, 1 / 3, 0.5]))
    assert found.coverage_at(0.1) == 0.25
    assert found.coverage_at(0.4) == 0.75
    assert found.risk_at(0.6) == pytest.approx(1 / 3)
    assert found.risk_at(1.0) == 0.5


def test_perfect_order_has_no_excess_and_no_order_has_the_mean_risk() -> None:
    wrong = np.arange(1000) >= 900
    assert risk_coverage(-np.arange(1000), wrong).excess_area == pytest.approx(0.0, abs=1e-12)
    blind = risk_coverage(np.zeros(1000), wrong)
    assert blind.area == pytest.approx(0.1)
    assert len(blind.coverage) == 1
    assert risk_coverage(np.arange(1000), wrong).area > blind.area


def test_scores_that_are_none_are_errors() -> None:
    for scores, wrong in (([], []), ([0.1], [True, False]), ([np.nan], [True])):
        with pytest.raises(ValueError, match="one finite score"):
            risk_coverage(scores, wrong)
