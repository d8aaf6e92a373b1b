from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cad.parts import planar
from cad.spatial import BASLER, rotation_x, transform
from perception import pvnet_baseline_training as training
from perception import train_crops
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels, label_crops
from perception.posenets import CropKeypoints
from perception.pvnet import PVNet
from perception.pvnet_baseline_net import Pvnets
from perception.pvnet_baseline_training import PvnetConfig, pvnet_step, score_crops, score_pvnet, train_pvnet
from perception.train_crops import CropSource
from perception.weight_files import load_weights, save_weights

TABLE = FaceTable.load(["inserted", "top"])
FACES = np.array([0, 1, 4, 6, -1, 2])
T_CAM_BOARD = transform(rotation_x(np.pi), [0.0, 0.0, 0.7])


def crops_and_labels(turn: float = 0.0) -> tuple[CropSet, CropLabels]:
    """Six crops in the middle of the frame; ``turn`` is added to the yaw of every part."""
    window = BASLER.crop(2736 - 128, 1824 - 128, 256, 256).downscaled(2)
    faces = [TABLE[f] if f >= 0 else None for f in FACES]
    poses = [
        T_CAM_BOARD @ planar(0, 0, 0.7 * i + turn) @ f.stable_pose.T_table_part if f else np.eye(4)
        for i, f in enumerate(faces)
    ]
    crops = CropSet(
        images=np.random.default_rng(0).integers(0, 255, (6, 128, 128, 3), dtype=np.uint8),
        obj_id=np.array([f.part.obj_id if f else 0 for f in faces]),
        stable_pose=np.array([f.stable_pose.index if f else -1 for f in faces]),
        T_cam_part=np.stack(poses),
        T_cam_board=np.tile(T_CAM_BOARD, (6, 1, 1)),
        K=np.tile(window.matrix, (6, 1, 1)),
        packed_masks=np.full((6, 128, 16), 255, np.uint8),
    )
    return crops, label_crops(TABLE, crops)


def votes_of(monkeypatch: pytest.MonkeyPatch, labels: CropLabels) -> None:
    """Lets the networks place the keypoints of these labels, whatever the crop."""
    left = [labels.keypoints[i, 0] for i in np.argsort(TABLE.part_of_face[FACES], kind="stable") if FACES[i] >= 0]

    def votes(nets: Any, part: str, images: Any, rays: Any, rng: Any) -> list[CropKeypoints]:
        mine = [left.pop(0) for _ in images]
        return [
            CropKeypoints(pixels=p, covariances=np.tile(np.eye(2), (8, 1, 1)), mask=np.ones((64, 64))) for p in mine
        ]

    monkeypatch.setattr(training, "vote_keypoints", votes)


def test_true_keypoints_score_full_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    crops, labels = crops_and_labels()
    votes_of(monkeypatch, labels)
    nets: Any = None
    figures = score_pvnet(nets, crops, labels, TABLE)
    assert figures["branch_right"] == figures["mask_iou"] == 1.0 and figures["flipped"] == 0.0
    for name in ("keypoint_px", "raw_e_x_mm", "refined_e_y_mm", "refined_e_z_mm", "refined_e_theta_deg"):
        assert figures[name] == pytest.approx(0.0, abs=1e-3), name


def test_keypoints_of_the_opposite_yaw_are_flips(monkeypatch: pytest.MonkeyPatch) -> None:
    crops, labels = crops_and_labels()
    votes_of(monkeypatch, crops_and_labels(np.pi)[1])
    nets: Any = None
    scores = score_crops(nets, crops, labels, TABLE)
    assert scores.part.tolist() == [0, 0, 0, 1, 1]
    assert not scores.branch_right.any() and scores.figures()["flipped"] == 1.0
    assert np.degrees(scores.refined[:, 3]) == pytest.approx(180.0, abs=0.1)
    assert scores.keypoints_px.max() > 60 and scores.refined[:, 2].max() < 1e-5


def test_where_no_pose_is_found_errors_are_infinite_and_the_branch_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    crops, labels = crops_and_labels()
    votes_of(monkeypatch, labels)

    def fails(*_: Any) -> Any:
        raise training.PnpError("no pose")

    monkeypatch.setattr(training, "pose_from_keypoints", fails)
    nets: Any = None
    scores = score_crops(nets, crops, labels, TABLE)
    assert np.isinf(scores.raw).all() and not scores.branch_right.any()


def test_a_step_trains_every_part_on_its_own_crops(tmp_path: Path) -> None:
    crops, labels = crops_and_labels()
    config = PvnetConfig(data=(tmp_path,), val=(tmp_path,), parts=("inserted", "top"), batch=2, samples=16)
    torch.manual_seed(0)
    nets = Pvnets({"inserted": 8, "top": 8}).train()
    step = pvnet_step(nets, CropSource(crops, labels, 0), config)
    optimizer = torch.optim.AdamW(nets.parameters(), lr=3e-3)
    totals = []
    for _ in range(5):
        losses = step(np.random.default_rng(0))  # always the same batch
        totals.append(float(losses["vector"].detach()))
        optimizer.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
    assert totals[-1] < 0.9 * totals[0]


def test_training_begins_with_the_encoder_of_our_votes_or_goes_on_from_its_own_weights(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    crops, _ = crops_and_labels()
    monkeypatch.setattr(train_crops, "load_crops", lambda *paths: crops)
    monkeypatch.setattr(train_crops, "manifest_hash", lambda path: "0123")
    monkeypatch.setattr(training, "score_pvnet", lambda *_: {"branch_right": 1.0})
    votes = PVNet.for_table(TABLE)
    save_weights(tmp_path / "votes" / "keypoints.safetensors", votes.state_dict(), {"parts": {}})
    said = {"data": (tmp_path,), "val": (tmp_path,), "parts": ("inserted", "top"), "batch": 2, "samples": 16}
    said |= {"max_steps": 1, "ema_decay": 0.0}
    train_pvnet(PvnetConfig(**said, out=tmp_path / "a", learning_rate=1e-9, encoder=tmp_path / "votes"))
    first, _ = load_weights(tmp_path / "a" / "pvnet.safetensors")
    np.testing.assert_allclose(
        first["encoder.down3.0.0.weight"], votes.state_dict()["down3.0.0.weight"], rtol=2e-3, atol=1e-4
    )
    train_pvnet(PvnetConfig(**said, out=tmp_path / "b", learning_rate=1e-9, start=tmp_path / "a"))
    second, about = load_weights(tmp_path / "b" / "pvnet.safetensors")
    np.testing.assert_allclose(first["decoders.top.head.weight"], second["decoders.top.head.weight"], atol=1e-3)
    assert about["minutes_before_start"] >= 0.0
