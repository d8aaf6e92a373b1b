import numpy as np
import pytest

from cad.equivalence import Symmetries
from cad.spatial import rotation_from_rotvec, rotation_x, rotation_z, transform
from perception.metrics import DetectionScores, mask_iou, match_detections, mssd, pose_error, summary

IDENTITY = Symmetries()
TWO_FOLD = Symmetries(discrete=transform(rotation_z(np.pi))[None])


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return transform(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))


@pytest.mark.parametrize("seed", range(5))
def test_pose_error_is_zero_only_for_the_pose_and_its_symmetric_twins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    twin = T @ transform(rotation_z(np.pi))
    vertices = np.array([[1.0, 2, 3], [-1, -2, 3], [1, 2, -3], [-1, -2, -3]]) * 1e-3
    for other in (T, twin):
        error = pose_error(T, other, TWO_FOLD)
        assert max(error.e_x_m, error.e_y_m, error.e_z_m, error.e_theta_rad) < 1e-7
        assert mssd(T, other, vertices, TWO_FOLD) < 1e-12
    assert pose_error(T, twin, IDENTITY).e_theta_rad == pytest.approx(np.pi)
    assert mssd(T, twin, vertices, IDENTITY) == pytest.approx(2 * np.hypot(1e-3, 2e-3))


def test_pose_error_reads_axes_in_the_camera_frame() -> None:
    T = transform(rotation_x(0.4), [0.1, 0.2, 0.7])
    off = transform(rotation_from_rotvec([0.0, 0.0, 0.03]), [1e-3, -2e-3, 5e-3]) @ T
    off[:3, 3] = T[:3, 3] + [1e-3, -2e-3, 5e-3]
    figures = pose_error(T, off, IDENTITY).as_mm_deg()
    assert figures == pytest.approx({"e_x_mm": 1, "e_y_mm": 2, "e_z_mm": 5, "e_theta_deg": np.degrees(0.03)})


def test_mssd_of_a_shift_is_its_length() -> None:
    rng = np.random.default_rng(0)
    T = random_pose(rng)
    moved = transform(None, [3e-4, 0.0, 4e-4]) @ T
    assert mssd(T, moved, rng.normal(size=(20, 3)), IDENTITY) == pytest.approx(5e-4)


def test_summary() -> None:
    figures = summary([1.0, 2.0, 3.0, 4.0])
    assert figures == pytest.approx({"mean": 2.5, "std": np.sqrt(1.25), "median": 2.5, "p95": 3.85, "n": 4})
    assert summary([])["n"] == 0 and np.isnan(summary([])["mean"])


def test_mask_iou_places_masks_by_their_origins() -> None:
    a = np.ones((4, 6), bool)
    assert mask_iou(a, a, (10, 20), (10, 20)) == 1.0
    assert mask_iou(a, a, (10, 20), (13, 20)) == pytest.approx(12 / 36)
    assert mask_iou(a, a, (10, 20), (10, 24)) == 0.0
    assert mask_iou(~a, ~a) == 0.0
    whole = np.zeros((40, 40), bool)
    whole[20:24, 10:16] = True
    assert mask_iou(whole, a, (0, 0), (10, 20)) == 1.0


def test_matching_is_greedy_by_score_and_takes_each_instance_once() -> None:
    iou = np.array([[0.9, 0.0], [0.95, 0.6], [0.0, 0.7]])
    assert match_detections(iou, [0.9, 0.8, 0.7], 0.5).tolist() == [0, 1, -1]
    assert match_detections(iou, [0.7, 0.8, 0.9], 0.5).tolist() == [-1, 0, 1]
    assert match_detections(np.zeros((2, 0)), [1.0, 0.5], 0.5).tolist() == [-1, -1]


def test_perfect_detections_score_one() -> None:
    scores = DetectionScores()
    scores.add(np.eye(3), [0.9, 0.8, 0.7])
    scores.add(np.zeros((0, 0)), [])
    assert all(value == 1.0 for value in scores.report().values())


def test_precision_recall_and_average_precision_of_a_worked_case() -> None:
    """Ranked hit, miss, hit of four instances: precision 1 up to recall 1/4, then 2/3 up to recall 1/2."""
    scores = DetectionScores()
    scores.add(np.array([[0.9, 0, 0, 0], [0.2, 0, 0, 0], [0, 0.6, 0, 0]]), [0.9, 0.8, 0.7])
    assert scores.precision_recall(0.5) == pytest.approx((2 / 3, 2 / 4))
    assert scores.average_precision(0.5) == pytest.approx((26 * 1.0 + 25 * 2 / 3) / 101)
    assert scores.average_precision(0.75) == pytest.approx(26 / 101)
    assert scores.mean_iou() == pytest.approx((0.9 + 0.6) / 4)


def test_ignored_instances_are_neither_wanted_nor_punished() -> None:
    scores = DetectionScores()
    scores.add(np.array([[0.9, 0.0], [0.0, 0.9]]), [0.9, 0.8], ignore=[False, True])
    scores.add(np.zeros((0, 1)), [], ignore=[True])
    assert scores.precision_recall() == (1.0, 1.0)


def test_overlaps_must_fit_the_scores() -> None:
    with pytest.raises(ValueError, match=r"\(D, G\)"):
        DetectionScores().add(np.zeros((2, 3)), [0.5])
