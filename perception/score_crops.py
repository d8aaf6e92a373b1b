"""Scores of the crop networks on labelled crops: what training prints and what weight files say about themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array
from perception.classifier import JointAnswer, JointClassifier, classify, modes
from perception.dataset import CropSet
from perception.faces import FaceTable
from perception.labels import CropLabels
from perception.pvnet import PVNet, infer_votes
from perception.verifier import PairSampler, Verifier, score_views
from perception.voting import offset_vote, ransac_vote

YAW_TOLERANCE = np.radians(15.0)
BATCH = 50
FULL_RESOLUTION = 2.0  # camera pixels a crop pixel


def classify_all(model: JointClassifier, crops: CropSet, labels: CropLabels, quarter_turns: int = 4) -> JointAnswer:
    """J's answer for all crops, in batches."""
    answers = [
        classify(model, crops.images[i : i + BATCH], labels.ray[i : i + BATCH], quarter_turns)
        for i in range(0, len(crops), BATCH)
    ]
    return JointAnswer(
        log_probability=np.concatenate([a.log_probability for a in answers]),
        log_not_a_part=np.concatenate([a.log_not_a_part for a in answers]),
        centre=np.concatenate([a.centre for a in answers]),
    )


def score_classifier(model: JointClassifier, crops: CropSet, labels: CropLabels, table: FaceTable) -> dict[str, float]:
    """Shares of crops with a part whose face and yaw (within 15 degrees) are right, strictly, up to equal views, and
    among the four likeliest; right classes; rejection of crops without and with a part; centre error in camera px.
    """
    answer = classify_all(model, crops, labels)
    has = np.flatnonzero(labels.has_part)
    strict, equal, top4, part_right = (np.zeros(len(has), dtype=bool) for _ in range(4))
    for row, i in enumerate(has):
        face, yaw = int(labels.face[i]), float(labels.yaw[i])
        found = modes(answer.log_probability[i], 4)
        matches = [table.same_view(face, yaw, f, y, YAW_TOLERANCE) for f, y, _ in found]
        equal[row], top4[row] = matches[0], any(matches)
        strict[row] = matches[0] and found[0][0] == face and _near(found[0][1], yaw)
        mass = np.exp(answer.log_probability[i]).sum(axis=1)
        of_part = np.bincount(table.part_of_face, weights=mass, minlength=len(table.parts))
        part_right[row] = of_part.argmax() == table.part_of_face[face]
    rejected = answer.log_not_a_part > np.log(0.5)
    off = np.linalg.norm(answer.centre[has] - labels.centre[has], axis=1) * FULL_RESOLUTION
    return {
        "strict": float(strict.mean()),
        "equal_view": float(equal.mean()),
        "top4": float(top4.mean()),
        "class": float(part_right.mean()),
        "empty_rejected": float(rejected[~labels.has_part].mean()) if (~labels.has_part).any() else 1.0,
        "part_rejected": float(rejected[has].mean()),
        "centre_px": float(np.median(off)),
    }


def score_verifier(model: Verifier, crops: CropSet, labels: CropLabels, table: FaceTable) -> dict[str, float]:
    """Share of crops with a part for which V picks the right face in the right one of two rectified views, given the
    yaw's axis and the centre with J's errors; and rejection of crops without and with a part.
    """
    sampler, rng = PairSampler(table), np.random.default_rng(0)
    right, rejected = np.zeros(len(crops), dtype=bool), np.zeros(len(crops), dtype=bool)
    for i in range(0, len(crops), BATCH):
        rows = np.arange(i, min(i + BATCH, len(crops)))
        views, rays, target = sampler(crops.images[rows], labels.take(rows), rng)
        for row, (log, nothing), wanted in zip(
            rows, score_views(model, views, rays, [2] * len(rows)), target, strict=True
        ):
            right[row] = wanted[int(log.argmax())] > 0
            rejected[row] = nothing > np.log(0.5)
    has = labels.has_part
    return {
        "equal_view": float(right[has].mean()),
        "empty_rejected": float(rejected[~has].mean()) if (~has).any() else 1.0,
        "part_rejected": float(rejected[has].mean()),
    }


def score_keypoints(model: PVNet, crops: CropSet, labels: CropLabels, table: FaceTable) -> dict[str, float]:
    """Median distance in camera pixels of the keypoints of the true face, by offset votes and by PVNet's RANSAC, and
    the mean overlap (IoU) of the masks.
    """
    has, rng = np.flatnonzero(labels.has_part), np.random.default_rng(0)
    errors: dict[str, list[float]] = {"offset_px": [], "ransac_px": []}
    overlaps: list[float] = []
    for i in range(0, len(has), BATCH):
        rows = has[i : i + BATCH]
        masks = crops.masks(rows)[:, ::2, ::2]
        for row, mask, votes in zip(
            rows, masks, infer_votes(model, crops.images[rows], labels.ray[rows], labels.face[rows]), strict=True
        ):
            by_offset, _ = offset_vote(votes["pixels"], votes["offset"], votes["log_scale"])
            by_ransac, _ = ransac_vote(votes["pixels"], votes["unit"], rng)
            errors["offset_px"] += _distances(by_offset, labels.keypoints[row]).tolist()
            errors["ransac_px"] += _distances(by_ransac, labels.keypoints[row]).tolist()
            overlaps.append(_overlap(votes["mask"] > 0.5, mask))
    return {name: float(np.median(e)) for name, e in errors.items()} | {"mask_iou": float(np.mean(overlaps))}


def _near(a: float, b: float) -> bool:
    return bool(abs((a - b + np.pi) % (2 * np.pi) - np.pi) <= YAW_TOLERANCE)


def _distances(keypoints: Array, alternatives: Array) -> Array:
    """Camera pixels (K,) between keypoints and those of the alternative (A, K, 2) that fits best."""
    all_off = np.linalg.norm(keypoints - alternatives, axis=-1) * FULL_RESOLUTION
    return all_off[all_off.mean(axis=1).argmin()]


def _overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))
