"""Which estimate of a frame belongs to which of its parts, and the outcome rows that follow.

An estimate belongs to a part when their masks overlap by half (greedy, the best score first); what is left over
belongs to the part whose centre it puts within 2 mm of the line of sight to the true one. Estimates that say "not a
part" are on no list of instances; they only tell why a part was missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part, load_part
from cad.run_lengths import RunLengths, encode_runs, overlaps
from cad.spatial import Array
from perception.estimates import NOT_A_PART, FrameEstimate, PartEstimate
from perception.faces import FaceTable
from perception.ground_truth import FrameTruth, TruePart, centre_of
from perception.metrics import match_detections
from perception.outcomes import NO_PART, Outcome
from perception.pose_comparison import (
    as_raw,
    choice_of,
    errors_by_comparison,
    normalised_errors_squared,
    reading_right,
    same_views,
    surface_error_mm,
)

SAME_IOU = 0.5
SAME_CENTRE_M = 2e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """What all frames of a method have in common: its name, the domain and the faces of the parts that are shown.

    ``parts_dir`` is where a user's own parts are, which a method may see though none is there.
    """

    method: str
    domain: str
    table: FaceTable
    parts_dir: Path | None = None

    def part(self, name: str) -> Part:
        """The part of that name."""
        return load_part(name, self.parts_dir)

    def outcomes(self, truth: FrameTruth, image: NDArray[np.uint8], estimate: FrameEstimate) -> list[Outcome]:
        """Rows of a frame: its parts in order, then the detections that belong to none."""
        proposed = [e for e in estimate.parts if e.verdict != NOT_A_PART]
        rejected = [e for e in estimate.parts if e.verdict == NOT_A_PART]
        parts = {name: self.part(name) for name in {e.part for e in estimate.parts}}
        iou = _iou(proposed, truth)
        owner = belonging(proposed, truth, iou, parts)
        rows: list[Outcome] = []
        for g, part in enumerate(truth.parts):
            mine = np.flatnonzero(owner == g)
            if len(mine):
                d = int(mine[0])
                rows.append(self._detected(truth, part, image, proposed[d], estimate.T_cam_board, float(iou[d, g])))
            else:
                rows.append(Outcome(**self._about(truth, part, image)))
        missed = {g for g, row in enumerate(rows) if not row.detected}
        for e, g in zip(rejected, belonging(rejected, truth, _iou(rejected, truth), parts), strict=True):
            if int(g) in missed:
                rows[int(g)] = Outcome(
                    **self._about(truth, truth.parts[g], image), **_about_estimate(e), iou=0.0, detected=False
                )
        on_cut = on_ignored([runs_of(e, truth) for e in proposed], truth)
        rows += [
            self._stray(truth, image, e, parts[e.part], float(iou[d].max(initial=0.0)), whole=not on_cut[d])
            for d, e in enumerate(proposed)
            if owner[d] < 0
        ]
        return rows

    def _about(self, truth: FrameTruth, part: TruePart, image: NDArray[np.uint8]) -> dict[str, Any]:
        centre = centre_of(part.part, part.T_cam_part)
        x_mm, y_mm = truth.on_board_mm(centre)
        return {
            "method": self.method,
            "domain": self.domain,
            "image": truth.image,
            "instance": part.number,
            "part": part.part.name,
            "stable_pose": part.stable_pose,
            "visible_share": part.visible_share,
            "whole": part.whole,
            "x_board_mm": x_mm,
            "y_board_mm": y_mm,
            "brightness": truth.brightness(image, centre),
        }

    def _detected(
        self,
        truth: FrameTruth,
        part: TruePart,
        image: NDArray[np.uint8],
        estimate: PartEstimate,
        T_cam_board: Array,
        iou: float,
    ) -> Outcome:
        views = same_views(part, self.table)
        choice = choice_of(part, views, estimate, truth.T_cam_board)
        raw = as_raw(estimate)
        nees = normalised_errors_squared(part, estimate, T_cam_board) if choice.branch_right else (None, None)
        return Outcome(
            **self._about(truth, part, image),
            **_about_estimate(estimate),
            detected=True,
            iou=iou,
            class_right=choice.class_right,
            face_right=choice.face_right,
            branch_right=choice.branch_right,
            branch_right_equivalent=choice.branch_right_equivalent,
            readings=max(1, len(estimate.alternatives)),
            reading_right=reading_right(part, views, estimate, truth.T_cam_board),
            yaw_error_deg=choice.yaw_error_deg,
            errors=errors_by_comparison(part, views, estimate.part, estimate.T_cam_part),
            raw_errors=errors_by_comparison(part, views, raw.part, raw.T_cam_part) if raw is not None else None,
            mssd_mm=surface_error_mm(part, estimate),
            nees=nees[0],
            nees_planar=nees[1],
        )

    def _stray(
        self,
        truth: FrameTruth,
        image: NDArray[np.uint8],
        estimate: PartEstimate,
        part: Part,
        iou: float,
        *,
        whole: bool,
    ) -> Outcome:
        centre = centre_of(part, estimate.T_cam_part)
        x_mm, y_mm = truth.on_board_mm(centre)
        return Outcome(
            method=self.method,
            domain=self.domain,
            image=truth.image,
            instance=NO_PART,
            whole=whole,
            x_board_mm=x_mm,
            y_board_mm=y_mm,
            brightness=truth.brightness(image, centre),
            **_about_estimate(estimate),
            iou=iou,
        )


def _about_estimate(estimate: PartEstimate) -> dict[str, Any]:
    return {
        "score": float(estimate.score),
        "accepted": estimate.accepted,
        "verdict": estimate.verdict,
        "estimated_part": estimate.part,
        "estimated_stable_pose": int(estimate.stable_pose),
        "details": {name: float(value) for name, value in estimate.details.items() if np.isfinite(value)},
    }


def runs_of(estimate: PartEstimate, truth: FrameTruth) -> RunLengths:
    """The estimate's mask in the whole frame; empty when it has none."""
    shape = truth.intrinsics.height, truth.intrinsics.width
    mask = np.zeros((0, 0), bool) if estimate.mask is None else estimate.mask
    return encode_runs(mask, estimate.mask_origin, shape)


def on_ignored(runs: Sequence[RunLengths], truth: FrameTruth) -> NDArray[np.bool_]:
    """Which masks (D,) lie with half of their pixels on a part that is not whole."""
    cut = [part.runs for part in truth.parts if not part.whole]
    return np.asarray((overlaps(runs, cut, of_a=True) >= SAME_IOU).any(axis=1), np.bool_)


def _iou(estimates: Sequence[PartEstimate], truth: FrameTruth) -> Array:
    return overlaps([runs_of(e, truth) for e in estimates], [part.runs for part in truth.parts])


def belonging(
    estimates: Sequence[PartEstimate], truth: FrameTruth, iou: Array, parts: dict[str, Part]
) -> NDArray[np.int64]:
    """For each estimate (D,) the place of its part among ``truth.parts``, -1 where there is none."""
    scores = np.array([e.score for e in estimates])
    owner = match_detections(iou, scores, SAME_IOU)
    free_d, free_g = np.flatnonzero(owner < 0).tolist(), sorted(set(range(len(truth.parts))) - set(owner.tolist()))
    if not free_d or not free_g:
        return owner
    true = np.stack([centre_of(truth.parts[g].part, truth.parts[g].T_cam_part) for g in free_g])
    seen = np.stack([centre_of(parts[estimates[d].part], estimates[d].T_cam_part) for d in free_d])
    across = seen[:, None, :2] / seen[:, None, 2:] * true[None, :, 2:]  # (D, G, 2) brought to the true part's depth
    distance = np.linalg.norm(across - true[None, :, :2], axis=-1)
    near = match_detections(-distance, scores[free_d], -SAME_CENTRE_M)
    for d, k in zip(free_d, near, strict=True):
        if k >= 0:
            owner[d] = free_g[k]
    return owner
