"""Training and scores of the published baseline's networks: ``python -m perception.train pvnet --data DIR --val DIR``.

They see the crops that our own networks see, turned and varied in the same way; each part's decoder sees that part's
crops only. Every batch has as many crops of each part, so that one run, one checkpoint and one file hold all of them.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, Intrinsics
from perception.calibration import table_from_board
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.metrics import mask_iou, pose_error
from perception.planar import PlanarError
from perception.pnp import PnpError
from perception.posenets import CropKeypoints
from perception.pvnet import sample_cells
from perception.pvnet_baseline_net import Pvnets, baseline_loss, vote_keypoints
from perception.pvnet_baseline_pose import pose_from_keypoints
from perception.score_crops import BATCH, FULL_RESOLUTION
from perception.train_crops import CropSource, CropTrainingConfig, train_on_crops
from perception.training import Step, TrainingResult
from perception.weight_files import load_weights

SAME_BRANCH = np.radians(6.0)


@dataclass(frozen=True, kw_only=True)
class PvnetConfig(CropTrainingConfig):
    """``batch`` crops of each part a step; ``samples`` cells of each mask enter the loss. ``encoder`` is the folder of
    the weights of our own votes, whose encoder a training without ``start`` begins with.
    """

    minutes: float = 30.0
    learning_rate: float = 2e-3
    ema_decay: float = 0.995
    batch: int = 8
    samples: int = 192
    seed: int = 3
    validate: int = 150
    validate_s: float = 600.0
    encoder: Path | None = None


def pvnet_step(nets: Pvnets, source: CropSource, config: PvnetConfig) -> Step:
    """One step of all parts' networks."""
    table = config.table
    part_of = np.where(source.labels.has_part, table.part_of_face[source.labels.face], -1)
    rows = [np.flatnonzero(part_of == i) for i in range(len(table.parts))]
    starts = range(0, config.batch * len(rows), config.batch)
    mine = {part.name: slice(at, at + config.batch) for part, at in zip(table.parts, starts, strict=True)}

    def step(rng: np.random.Generator) -> dict[str, torch.Tensor]:
        chosen = np.concatenate([rng.choice(own, config.batch) for own in rows])
        images, labels, masks = source.draw(len(chosen), rng, with_masks=True, rows=chosen)
        return baseline_loss(
            nets,
            mine,
            source.photometric(images, labels.ray, rng),
            torch.from_numpy(masks.astype(np.float32)),
            torch.from_numpy(labels.keypoints[:, 0].astype(np.float32)),
            torch.from_numpy(sample_cells(masks, config.samples, rng)),
        )

    return step


def train_pvnet(config: PvnetConfig) -> TrainingResult:
    """Train the networks of all parts and write ``pvnet.safetensors``."""

    def build(table: FaceTable) -> Pvnets:
        nets = Pvnets({part.name: len(part.keypoints) for part in table.parts})
        if config.encoder is not None:
            nets.start_from(load_weights(config.encoder / "keypoints.safetensors", config.parts_dir)[0])
        return nets

    return train_on_crops("pvnet", config, build, pvnet_step, score_pvnet)


@dataclass(frozen=True, kw_only=True, eq=False)
class CropScores:
    """What came of N crops: ``part`` (N,) index, distance in camera pixels of each keypoint (N, K), overlap of the mask
    (N,), errors e_x, e_y, e_z in metres and e_theta in rad of the raw and of the refined pose (N, 4), infinite where
    there is none, and whether the branch (stable pose and yaw) is right (N,).
    """

    part: NDArray[np.int64]
    keypoints_px: Array
    overlap: Array
    raw: Array
    refined: Array
    branch_right: NDArray[np.bool_]

    def figures(self) -> dict[str, float]:
        """Medians, shares of wrong branches and of flips (turned by over 90 degrees), and the same errors as reports
        give them.
        """
        out = {
            "keypoint_px": float(np.median(self.keypoints_px)),
            "mask_iou": float(self.overlap.mean()),
            "branch_right": float(self.branch_right.mean()),
            "flipped": float((self.refined[:, 3] > np.pi / 2).mean()),
        }
        for row, errors in (("raw", self.raw), ("refined", self.refined)):
            e_x, e_y, e_z, e_theta = np.median(errors, axis=0)
            out |= {f"{row}_e_x_mm": 1e3 * e_x, f"{row}_e_y_mm": 1e3 * e_y, f"{row}_e_z_mm": 1e3 * e_z}
            out[f"{row}_e_theta_deg"] = float(np.degrees(e_theta))
        return {name: float(value) for name, value in out.items()}


def score_crops(nets: Pvnets, crops: CropSet, labels: CropLabels, table: FaceTable) -> CropScores:
    """Keypoints, masks and poses of all crops with a part, each from the network of its true class."""
    rng = np.random.default_rng(0)
    part_of = np.where(labels.has_part, table.part_of_face[labels.face], -1)
    rows_done, keypoints_px, overlap, raw, refined, branch = [], [], [], [], [], []
    for index, part in enumerate(table.parts):
        rows = np.flatnonzero(part_of == index)
        for start in range(0, len(rows), BATCH):
            batch = rows[start : start + BATCH]
            masks = crops.masks(batch)[:, ::2, ::2]
            found = vote_keypoints(nets, part.name, crops.images[batch], labels.ray[batch], rng)
            for row, mask, voted in zip(batch, masks, found, strict=True):
                rows_done.append(index)
                keypoints_px.append(FULL_RESOLUTION * np.linalg.norm(voted.pixels - labels.keypoints[row, 0], axis=-1))
                overlap.append(mask_iou(voted.mask > 0.5, mask))
                errors, right = _pose_errors(part, voted, crops, int(row))
                raw.append(errors[0])
                refined.append(errors[1])
                branch.append(right)
    return CropScores(
        part=np.array(rows_done),
        keypoints_px=np.array(keypoints_px),
        overlap=np.array(overlap),
        raw=np.array(raw),
        refined=np.array(refined),
        branch_right=np.array(branch),
    )


def score_pvnet(nets: Pvnets, crops: CropSet, labels: CropLabels, table: FaceTable) -> dict[str, float]:
    """Figures over all crops with a part: see ``CropScores.figures``."""
    return score_crops(nets, crops, labels, table).figures()


def _pose_errors(part: Part, voted: CropKeypoints, crops: CropSet, row: int) -> tuple[Array, bool]:
    """Errors (2, 4) of the raw and refined pose of a crop, and whether the branch is right."""
    K, size = crops.K[row], crops.images.shape[2]
    camera = Intrinsics(width=size, height=size, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    try:
        pose = pose_from_keypoints(part, voted, camera, table_from_board(crops.T_cam_board[row]))
    except (PnpError, PlanarError):
        return np.full((2, 4), np.inf), False
    errors = [
        astuple(pose_error(crops.T_cam_part[row], T, part.symmetries)) for T in (pose.raw_T_cam_part, pose.T_cam_part)
    ]
    right = pose.stable_pose == crops.stable_pose[row] and errors[1][3] < SAME_BRANCH
    return np.array(errors), bool(right)
