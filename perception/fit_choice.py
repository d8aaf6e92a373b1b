"""Fits the choice among hypotheses and its gate on full-resolution validation crops with ground truth.

The crops are split in two: the choice is fitted on one part, the gate and its threshold on the other, so that the gate
sees winners as they come on data that the choice was not fitted on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array, Intrinsics
from perception.bop_files import manifest_hash
from perception.choice import (
    FEATURES,
    GATE_FEATURES,
    ChoiceWeights,
    fit_choice_weights,
    fit_gate,
    gate_evidence,
    threshold_for,
)
from perception.crop_poses import CROP_PX, Candidate, CropPoseConfig, CropSolver
from perception.dataset import CropSet, Labels, load_crops
from perception.estimates import PerceptionError
from perception.posenets import PoseNets

NEUTRAL = ChoiceWeights(
    choice=dict.fromkeys(FEATURES, 0.0) | {"classifier": 1.0, "verifier": 1.0, "matched_fraction": 3.0},
    gate=dict.fromkeys(GATE_FEATURES, 0.0),
    accept_above=0.5,
)
"""Stand-ins while evidence is collected: they only order hypotheses."""

RIGHT_YAW = np.radians(6.0)
RIGHT_PLACE_M = 1.5e-4
"""What the choice is to find: the right face and yaw, in the right place among rims and shadows."""
USABLE_PLACE_M = 3e-4
"""What the gate is to predict: a pose good enough for placing a part."""
BATCH = 32


@dataclass(frozen=True, kw_only=True)
class ChoiceFitConfig:
    """``data`` is a data set of full-resolution crops (256 x 256), ``out`` the folder with the networks' weights, to
    which ``choice.json`` is written. ``choice_share`` of the crops are for the choice, the others for the gate.

    ``wanted_right`` is the share of usable ones that the gate asks of accepted estimates; ``refined`` and ``nats`` are
    as in CropPoseConfig.
    """

    data: Path
    out: Path
    choice_share: float = 0.6
    wanted_right: float = 0.98
    refined: int = 3
    nats: float = 6.0

    def __post_init__(self) -> None:
        for name in ("choice_share", "wanted_right"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be between 0 and 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class CropEvidence:
    """One crop's hypotheses: evidence (H, F), which are right, and which are usable (H,).

    ``not_a_part`` is the networks' probability that there is none, ``has_part`` the truth.
    """

    evidence: Array
    right: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    not_a_part: float
    has_part: bool


def collect_evidence(solver: CropSolver, crops: CropSet, report: Callable[[str], None] = print) -> list[CropEvidence]:
    """Evidence for all refined hypotheses of full-resolution crops, judged by their ground truth."""
    if crops.images.shape[1:3] != (CROP_PX, CROP_PX):
        raise PerceptionError(
            f"crops of {crops.images.shape[2]} x {crops.images.shape[1]} pixels; the choice is fitted on "
            f"full-resolution crops of {CROP_PX} x {CROP_PX}: render them with `tagcell render --recipe val_fine`"
        )
    truth = crops.labels(solver.nets.table.parts)
    out: list[CropEvidence] = []
    for start in range(0, len(crops), BATCH):
        rows = range(start, min(start + BATCH, len(crops)))
        cameras = [_camera(crops.K[i]) for i in rows]
        tables = [truth.T_cam_table[i] for i in rows]
        for i, pose in zip(rows, solver.solve(crops.images[start : rows.stop], cameras, tables), strict=True):
            out.append(
                CropEvidence(
                    evidence=np.stack([c.evidence for c in pose.candidates]),
                    right=np.array([_is_right(solver, crops, truth, i, c, RIGHT_PLACE_M) for c in pose.candidates]),
                    usable=np.array([_is_right(solver, crops, truth, i, c, USABLE_PLACE_M) for c in pose.candidates]),
                    not_a_part=pose.not_a_part,
                    has_part=bool(truth.part_index[i] >= 0),
                )
            )
        report(f"choice: {rows.stop} of {len(crops)} crops")
    return out


def _is_right(solver: CropSolver, crops: CropSet, truth: Labels, i: int, candidate: Candidate, within_m: float) -> bool:
    """Whether a candidate is the crop's target, or looks exactly like it, and lies where it is."""
    if truth.part_index[i] < 0:
        return False
    table = solver.nets.table
    face = table.index_of(table.parts[truth.part_index[i]].name, int(crops.stable_pose[i]))
    r = candidate.refinement
    near = np.hypot(r.x - truth.x[i], r.y - truth.y[i]) < within_m
    return bool(near and table.same_view(face, float(truth.yaw[i]), candidate.face.index, r.yaw, RIGHT_YAW))


def _camera(K: Array) -> Intrinsics:
    return Intrinsics(width=CROP_PX, height=CROP_PX, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])


def fit_weights(found: list[CropEvidence], config: ChoiceFitConfig) -> tuple[ChoiceWeights, dict[str, float]]:
    """Choice and gate from the evidence of crops, and figures on those that the choice was not fitted on."""
    split = int(len(found) * config.choice_share)
    first, second = found[:split], found[split:]
    choice = fit_choice_weights([e.evidence for e in first], [e.right for e in first])
    weights = replace(NEUTRAL, choice=choice)
    winners, usable = _winners(second, weights)
    weights = replace(weights, gate=fit_gate(winners, usable))
    probability = weights.probability_right(winners)
    weights = replace(weights, accept_above=threshold_for(probability, usable, config.wanted_right))
    accepted = (probability > weights.accept_above) & np.array([e.not_a_part <= 0.5 for e in second])
    has = np.array([e.has_part for e in second])
    figures = {
        "crops": float(len(second)),
        "usable": float(usable[has].mean()),
        "best_possible": float(np.mean([e.usable.any() for e in second if e.has_part])),
        "accepted_share": float(accepted[has].mean()),
        "usable_of_accepted": float(usable[accepted].mean()) if accepted.any() else 0.0,
        "empty_accepted": float(accepted[~has].mean()) if (~has).any() else 0.0,
    }
    return weights, figures


def _winners(found: list[CropEvidence], weights: ChoiceWeights) -> tuple[Array, NDArray[np.bool_]]:
    """The gate's evidence of each crop's winner (N, G), and whether it is usable (N,)."""
    rows, usable = [], []
    for e in found:
        scores = weights.scores(e.evidence)
        best = int(scores.argmax())
        rows.append(gate_evidence(scores, e.evidence, best, e.not_a_part))
        usable.append(bool(e.usable[best]))
    return np.stack(rows), np.array(usable)


def fit_choice(config: ChoiceFitConfig) -> Path:
    """Fit on the data set and write ``choice.json`` beside the networks' weights; returns its path."""
    solver_config = CropPoseConfig(refined=config.refined, nats=config.nats)
    solver = CropSolver(PoseNets.load(config.out), NEUTRAL, solver_config)
    found = collect_evidence(solver, load_crops(config.data))
    weights, figures = fit_weights(found, config)
    summary = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
    path = config.out / "choice.json"
    replace(weights, fitted_on=f"{config.data.name} ({manifest_hash(config.data)}): {summary}").save(path)
    print(f"{path}: {summary}")
    return path
