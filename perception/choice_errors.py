"""Errors of the winners in validation frames: what covariances are fitted on, and whether they hold on other frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cad.spatial import Array
from perception.choice import FEATURES, ChoiceWeights
from perception.choice_evidence import CropFindings, FrameFindings, winner_of
from perception.covariance import (
    QUALITIES,
    Errors,
    face_name,
    fit_noise,
    noise_of,
    normalised_squares,
    part_of,
    shortfall_of,
)


def errors_by_face(crops: Sequence[CropFindings], weights: ChoiceWeights) -> dict[str, Errors]:
    """Errors of the winners that are whole and usable, by the part's true face."""
    columns = [FEATURES.index(name) for name in QUALITIES]
    rows: dict[str, list[tuple[list[float], list[list[float]], Array, bool]]] = {}
    for crop in crops:
        best, _, gate = winner_of(crop, weights)
        error = crop.errors[best]
        if not crop.whole or error is None:
            continue
        p = float(weights.probability_right(gate))
        shortfall = shortfall_of([crop.evidence[best][k] for k in columns], p)
        rows.setdefault(face_name(crop.part, crop.stable_pose), []).append(
            (error, crop.planar[best], shortfall, p > weights.accept_above)
        )
    out = {}
    for face, found in sorted(rows.items()):
        by_cause, planar, shortfall, accepted = (np.array(column) for column in zip(*found, strict=True))
        out[face] = Errors(by_cause=by_cause, planar=planar, shortfall=shortfall, accepted=accepted)
    return out


def errors_in_folds(findings: Sequence[FrameFindings], weights: ChoiceWeights, folds: int) -> list[dict[str, Errors]]:
    """``errors_by_face`` of each fold; frame i is in fold i modulo ``folds``."""
    return [
        errors_by_face([crop for frame in findings[k::folds] for crop in frame.crops], weights) for k in range(folds)
    ]


def normalised_errors(
    findings: Sequence[FrameFindings], weights: ChoiceWeights, folds: int
) -> dict[str, dict[str, float]]:
    """How the noise fitted on the other folds holds on the accepted ones of each: by "part, domain" and by part, the
    number of estimates and the means of the normalised errors squared, ``planar`` (3 when it holds) and ``pose`` (6).
    """
    seen: dict[str, list[tuple[float, float]]] = {}
    errors = errors_in_folds(findings, weights, folds)
    for k in range(folds):
        fitted = fit_noise([fold for i, fold in enumerate(errors) if i != k])
        for frame in findings[k::folds]:
            for face, every in errors_by_face(frame.crops, weights).items():
                own, part = every.take(every.accepted), part_of(face)
                noise = noise_of(fitted, face)
                if noise is not None and len(own):
                    for pair in zip(*normalised_squares(own, noise), strict=True):
                        for name in (f"{part}, {frame.domain}", part):
                            seen.setdefault(name, []).append(pair)
    return {
        name: {"n": len(pairs), "planar": float(np.mean(pairs, axis=0)[0]), "pose": float(np.mean(pairs, axis=0)[1])}
        for name, pairs in sorted(seen.items())
    }
