from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from cad.parts import load_part
from cad.spatial import BASLER, apply, inverse, rotation_x, transform
from cad.tagboard import TagboardConfig
from perception import pvnet_baseline
from perception.calibration import TagPose
from perception.estimates import Frame, PerceptionError
from perception.pnp import PnpError
from perception.pvnet_baseline import NO_POSE, PvnetEstimator, frame_mask, load_pvnets
from perception.pvnet_baseline_net import Pvnets
from perception.segmentation import Detection
from perception.weight_files import save_weights

T_CAM_BOARD = transform(rotation_x(np.pi), [-0.1, 0.07, 0.7])
NAMES = ("inserted", "top")


def detection(u: float, v: float, classes: tuple[float, float], score: float) -> Detection:
    return Detection(
        centre_px=np.array([u, v]),
        score=score,
        class_probabilities=np.array(classes),
        mask=np.ones((20, 30), bool),
        mask_origin=(int(u / 4) - 15, int(v / 4) - 10),
    )


@pytest.fixture
def estimator(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Untrained networks behind a segmentation that finds three parts."""
    torch.manual_seed(0)
    found = [
        detection(2000, 1500, (0.9, 0.1), 0.9),
        detection(3000, 900, (0.2, 0.8), 0.7),
        detection(3, 3640, (0.6, 0.4), 0.4),
    ]
    bare = object.__new__(PvnetEstimator)
    bare.tagboard, bare.seed = TagboardConfig(), 0
    segmenter: Any = SimpleNamespace(part_names=NAMES, detect=lambda frame, scale: found)
    bare.segmenter = segmenter
    bare.parts = {name: load_part(name) for name in NAMES}
    bare.nets = Pvnets(dict.fromkeys(NAMES, 8)).eval()
    tags = TagPose(T_cam_board=T_CAM_BOARD, tags_seen=12, rms_px=0.1)
    monkeypatch.setattr(pvnet_baseline, "camera_from_tags", lambda frame, board: tags)
    return bare


@pytest.fixture(scope="module")
def frame() -> Frame:
    image = np.random.default_rng(0).integers(0, 255, (BASLER.height, BASLER.width, 3), dtype=np.uint8)
    return Frame(image=image, intrinsics=BASLER, time_s=0.0)


def test_every_detection_becomes_one_accepted_estimate_of_its_likeliest_class(estimator, frame: Frame) -> None:
    found = estimator.estimate(frame)
    assert [p.part for p in found.parts] == ["inserted", "top", "inserted"]
    assert [p.score for p in found.parts] == [0.9, 0.7, 0.4]
    assert set(found.seconds) == {"tags", "segmentation", "networks", "poses"} and found.tags_seen == 12
    for estimate in found.parts:
        assert estimate.accepted == (estimate.verdict != NO_POSE)
        assert estimate.raw_T_cam_part is not None and np.isfinite(estimate.raw_T_cam_part).all()
        part = estimator.parts[estimate.part]
        resting = apply(inverse(T_CAM_BOARD) @ estimate.T_cam_part, part.mesh.vertices)
        assert resting[:, 2].min() == pytest.approx(0.0, abs=2e-5)
        assert estimate.mask is not None and estimate.mask.shape == (80, 120)
    again = estimator.estimate(frame)
    np.testing.assert_array_equal(again.parts[0].T_cam_part, found.parts[0].T_cam_part)


def test_a_failed_pose_is_an_estimate_with_a_reason_and_a_pose(estimator, frame: Frame, monkeypatch) -> None:
    def fails(*_: Any) -> Any:
        raise PnpError("no pose")

    monkeypatch.setattr(pvnet_baseline, "pose_from_keypoints", fails)
    found = estimator.estimate(frame)
    assert [p.verdict for p in found.parts] == [NO_POSE] * 3
    for estimate, wanted in zip(found.parts, estimator.segmenter.detect(None, 1.0), strict=True):
        part = estimator.parts[estimate.part]
        assert part.stable_poses[estimate.stable_pose].probability == max(p.probability for p in part.stable_poses)
        rest = inverse(part.stable_poses[estimate.stable_pose].T_table_part)[:3, 3]
        at = BASLER.project(apply(estimate.T_cam_part, rest))
        np.testing.assert_allclose(at, wanted.centre_px, atol=1e-3)
        assert estimate.raw_T_cam_part is not None and np.isfinite(estimate.raw_T_cam_part).all()


def test_a_frame_without_detections_has_no_parts(estimator, frame: Frame, monkeypatch) -> None:
    monkeypatch.setattr(estimator.segmenter, "detect", lambda frame, scale: [])
    assert estimator.estimate(frame).parts == ()


def test_a_mask_is_scaled_to_the_frame() -> None:
    mask, origin = frame_mask(detection(400, 300, (1.0, 0.0), 1.0))
    assert mask.shape == (80, 120) and origin == (340, 260) and mask.all()


def write(folder: Path, nets: torch.nn.Module) -> Path:
    parts = {
        name: {"mesh_hash": load_part(name).mesh_hash, "stable_poses": len(load_part(name).stable_poses)}
        for name in NAMES
    }
    save_weights(folder / "pvnet.safetensors", nets.state_dict(), {"parts": parts})
    return folder / "pvnet.safetensors"


def test_weights_come_back(estimator, tmp_path: Path) -> None:
    nets, parts = load_pvnets(write(tmp_path, estimator.nets))
    assert tuple(parts) == NAMES and not nets.training
    wanted = estimator.nets.state_dict()
    for key, value in nets.state_dict().items():
        assert torch.allclose(value.float(), wanted[key].float(), rtol=1e-2, atol=1e-3)


def test_another_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PerceptionError, match="train again"):
        load_pvnets(write(tmp_path, torch.nn.Linear(3, 3)))
    with pytest.raises(PerceptionError, match=r"perception\.train pvnet"):
        load_pvnets(tmp_path / "none" / "pvnet.safetensors")
