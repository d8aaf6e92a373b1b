from typing import Any

import numpy as np
import pytest

from cad.spatial import Array
from perception import score_crops
from perception.augment import CROP_CENTRE
from perception.classifier import BIN_CENTRES, YAW_BINS, JointAnswer
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.score_crops import score_classifier, score_keypoints

TABLE = FaceTable.load(["inserted"])
FACES = np.array([0, 1, 2, 3, 0, -1])
LABELS = CropLabels(
    face=FACES,
    yaw=np.linspace(-3, 3, 6),
    centre=np.full((6, 2), CROP_CENTRE),
    ray=np.zeros((6, 2)),
    keypoints=np.random.default_rng(0).uniform(40, 80, (6, 1, 8, 2)),
)
CROPS = CropSet(
    images=np.zeros((6, 128, 128, 3), np.uint8),
    obj_id=(FACES >= 0).astype(np.int64),
    stable_pose=FACES,
    T_cam_part=np.tile(np.eye(4), (6, 1, 1)),
    T_cam_board=np.tile(np.eye(4), (6, 1, 1)),
    K=np.tile(np.eye(3), (6, 1, 1)),
    packed_masks=np.full((6, 128, 16), 255, np.uint8),
)


def answer(yaws: Array, centre_off: float = 0.0) -> JointAnswer:
    """A sure answer with the right faces and the given yaws."""
    log = np.full((6, len(TABLE), YAW_BINS), -20.0)
    for i in range(5):
        log[i, FACES[i], np.abs(np.exp(1j * BIN_CENTRES) - np.exp(1j * yaws[i])).argmin()] = -0.01
    return JointAnswer(
        log_probability=log,
        log_not_a_part=np.where(FACES < 0, -0.01, -9.0),
        centre=LABELS.centre + np.array([centre_off, 0.0]),
    )


def score(monkeypatch: pytest.MonkeyPatch, given: JointAnswer) -> dict[str, float]:
    monkeypatch.setattr(score_crops, "classify_all", lambda *_: given)
    model: Any = None
    return score_classifier(model, CROPS, LABELS, TABLE)


def test_the_truth_scores_full_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = score(monkeypatch, answer(LABELS.yaw, centre_off=1.5))
    assert [figures[k] for k in ("strict", "equal_view", "top4", "class", "empty_rejected")] == [1.0] * 5
    assert figures["part_rejected"] == 0.0 and figures["centre_px"] == pytest.approx(3.0)


def test_half_a_turn_off_is_wrong_though_the_class_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    figures = score(monkeypatch, answer(LABELS.yaw + np.pi))
    assert figures["strict"] == figures["equal_view"] == 0.0 and figures["class"] == 1.0


def test_votes_for_the_true_keypoints_have_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.random.default_rng(1).uniform(30, 90, (60, 2))

    def votes(model: Any, images: Any, rays: Any, faces: Any) -> list[dict[str, Array]]:
        rows = np.flatnonzero(FACES >= 0)[: len(images)]
        wanted = [LABELS.keypoints[row, 0] - pixels[:, None] for row in rows]
        return [
            {
                "pixels": pixels,
                "unit": w / np.linalg.norm(w, axis=-1, keepdims=True),
                "offset": w,
                "log_scale": np.zeros(w.shape[:2]),
                "mask": np.ones((64, 64)),
            }
            for w in wanted
        ]

    monkeypatch.setattr(score_crops, "infer_votes", votes)
    model: Any = None
    figures = score_keypoints(model, CROPS, LABELS, TABLE)
    assert figures["offset_px"] < 1e-6 and figures["ransac_px"] < 1e-2 and figures["mask_iou"] == 1.0
