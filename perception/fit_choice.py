"""Fits the choice among hypotheses, its gate, its prediction set and the noise of poses on whole validation frames.

The frames go through the pipeline itself, so that the gate sees real detections, false ones too. They are dealt into
folds. For every fold the choice is fitted on one half of the other folds and the gate on the other half; what they say
of the fold is said of frames that neither has seen, and on all of that the threshold is set. What is kept is then
fitted on all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array
from perception.alternatives import likely_readings, reading_probabilities
from perception.bop_files import manifest_hash
from perception.choice import NEUTRAL, ChoiceWeights
from perception.choice_errors import errors_in_folds, normalised_errors
from perception.choice_evidence import CropFindings, FrameFindings, collect, winner_of
from perception.choice_models import (
    cautious_threshold,
    fit_choice_weights,
    fit_gate,
    fit_part,
    fit_temperature,
    wrong_share_bound,
)
from perception.covariance import (
    fit_noise,
)
from perception.estimates import PerceptionError
from perception.estimator import CHOICE_FILE, EstimatorConfig
from perception.risk import risk_coverage


@dataclass(frozen=True, kw_only=True)
class ChoiceFitConfig:
    """``data`` are data sets of whole frames with ground truth, of any domains, ``out`` the folder with the networks'
    weights, to which ``choice.json`` is written. Findings are kept in ``cache``, by default beside it.

    Of accepted estimates ``wanted_right`` are to have the right branch and ``wanted_usable`` to be good enough for
    placing as well: so that the Clopper-Pearson bounds with ``confidence`` of the shares that are not stay below the
    rest. ``covered`` is how often the prediction set is to
    hold the right reading. ``jobs`` processes run with one thread each.
    """

    data: tuple[Path, ...]
    out: Path
    cache: Path | None = None
    wanted_right: float = 0.9925
    wanted_usable: float = 0.98
    confidence: float = 0.5
    covered: float = 0.99
    folds: int = 5
    jobs: int = 2
    parts_dir: Path | None = None

    def __post_init__(self) -> None:
        for name in ("wanted_right", "wanted_usable", "confidence", "covered"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} = {getattr(self, name)}: must be between 0 and 1")
        if self.folds < 3 or self.jobs < 1:
            raise ValueError(f"folds {self.folds} must be at least 3, jobs {self.jobs} at least 1")


@dataclass(frozen=True, kw_only=True, eq=False)
class Winners:
    """The winners of N crops: the gate's evidence (N, G), which have the right branch, which are usable too, which
    crops show a part (N,), and the probabilities (N,) of the latter two by models that have not seen their frames.
    """

    evidence: Array
    right: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    has_part: NDArray[np.bool_]
    probability: Array = field(default_factory=lambda: np.zeros(0))
    part_probability: Array = field(default_factory=lambda: np.zeros(0))


def choice_of(crops: Sequence[CropFindings]) -> dict[str, float]:
    """Weights of the choice."""
    shown = [c for c in crops if c.part]
    return fit_choice_weights([np.array(c.evidence) for c in shown], [np.array(c.right) for c in shown])


def winners_of(crops: Sequence[CropFindings], weights: ChoiceWeights) -> Winners:
    """The winners under the weights of a choice."""
    found = [winner_of(crop, weights) for crop in crops]
    return Winners(
        evidence=np.stack([gate for *_, gate in found]),
        right=np.array([crop.right_reading[best] for crop, (best, *_) in zip(crops, found, strict=True)]),
        usable=np.array([crop.usable[best] for crop, (best, *_) in zip(crops, found, strict=True)]),
        has_part=np.array([bool(crop.part) for crop in crops]),
    )


def cross_fitted(frames: Sequence[Sequence[CropFindings]], folds: int) -> tuple[Winners, list[Array]]:
    """All crops' winners with the probabilities and scores of models that have not seen their frames.

    Of the frames that are not in a fold every other one is for the choice, the rest for gate and part.
    """
    parts, scores = [], []
    for fold in range(folds):
        rest = [frame for i, frame in enumerate(frames) if i % folds != fold]
        mine = [crop for frame in frames[fold::folds] for crop in frame]
        weights = replace(NEUTRAL, choice=choice_of([crop for frame in rest[::2] for crop in frame]))
        seen = winners_of([crop for frame in rest[1::2] for crop in frame], weights)
        gate, rivalry = fit_gate(seen.evidence, seen.usable)
        weights = replace(weights, gate=gate, rivalry=rivalry, part=fit_part(seen.evidence, seen.has_part))
        new = winners_of(mine, weights)
        parts.append(
            replace(
                new,
                probability=weights.probability_right(new.evidence),
                part_probability=weights.probability_part(new.evidence),
            )
        )
        scores += [winner_of(crop, weights)[1] for crop in mine]
    joined = {name: np.concatenate([getattr(p, name) for p in parts]) for name in Winners.__dataclass_fields__}
    return Winners(**joined), scores


def fit_weights(findings: Sequence[FrameFindings], config: ChoiceFitConfig) -> tuple[ChoiceWeights, dict[str, float]]:
    """Everything from the findings in frames, and figures on frames that the models behind them have not seen."""
    frames = [[crop for crop in frame.crops if crop.whole] for frame in findings]
    frames = [frame for frame in frames if frame]
    if len(frames) < 2 * config.folds:
        raise PerceptionError(
            f"{len(frames)} frames with detections: {2 * config.folds} are needed to fit choice, gate and threshold on "
            "different ones; render more frames, or lower --folds"
        )
    ordered = [crop for fold in range(config.folds) for frame in frames[fold :: config.folds] for crop in frame]
    held_out, scores = cross_fitted(frames, config.folds)
    threshold = max(
        cautious_threshold(held_out.probability, held_out.right, config.wanted_right, config.confidence),
        cautious_threshold(held_out.probability, held_out.usable, config.wanted_usable, config.confidence),
    )
    temperature, mass = _prediction_set(ordered, scores, config.covered)

    choice = choice_of(ordered)
    winners = winners_of(ordered, replace(NEUTRAL, choice=choice))
    gate, rivalry = fit_gate(winners.evidence, winners.usable)
    weights = ChoiceWeights(
        choice=choice,
        gate=gate,
        rivalry=rivalry,
        part=fit_part(winners.evidence, winners.has_part),
        accept_above=threshold,
        temperature=temperature,
        set_mass=mass,
    )
    weights = replace(weights, noise=fit_noise(errors_in_folds(findings, weights, config.folds)))
    return weights, _figures(findings, ordered, scores, held_out, weights)


def _prediction_set(crops: Sequence[CropFindings], scores: Sequence[Array], covered: float) -> tuple[float, float]:
    """Temperature of the readings' probabilities, and the mass of a set that holds the right one as often as wanted."""
    known = [_readings(crop, s) for crop, s in zip(crops, scores, strict=True) if crop.part]
    known = [(best, right) for best, right in known if right.any()]
    if not known:
        return 1.0, 0.99
    temperature = fit_temperature([best for best, _ in known], [right for _, right in known])
    before = []
    for best, right in known:
        p = reading_probabilities(best, range(len(best)), temperature)
        order = np.argsort(-p, kind="stable")
        before.append(float(np.append(0.0, np.cumsum(p[order]))[int(np.argmax(right[order]))]))
    level = min(1.0, np.ceil((len(before) + 1) * covered) / len(before))  # split conformal prediction's quantile
    return temperature, float(np.clip(np.quantile(before, level, method="higher") + 1e-6, 0.5, 0.9999))


def _readings(crop: CropFindings, scores: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The best score (R,) of each reading that the pipeline knows, and which is right."""
    known = np.isfinite(scores)
    numbers = sorted({n for n, k in zip(crop.reading, known, strict=True) if k})
    of = [[i for i, n in enumerate(crop.reading) if n == number and known[i]] for number in numbers]
    right = np.array([any(crop.right_reading[i] for i in members) for members in of])
    return np.array([scores[members].max() for members in of]), right


def _figures(
    findings: Sequence[FrameFindings],
    crops: Sequence[CropFindings],
    scores: Sequence[Array],
    held_out: Winners,
    weights: ChoiceWeights,
) -> dict[str, float]:
    has, usable, right_branch = held_out.has_part, held_out.usable, held_out.right
    kept = held_out.part_probability >= weights.part_above
    accepted = (held_out.probability > weights.accept_above) & kept
    wrong, n = int((accepted & ~right_branch).sum()), int(accepted.sum())
    sets = [_readings(crop, s) for crop, s in zip(crops, scores, strict=True) if crop.part]
    sizes, holds = [], []
    for best, right in sets:
        chosen = likely_readings(reading_probabilities(best, range(len(best)), weights.temperature), weights.set_mass)
        sizes.append(len(chosen))
        holds.append(bool(right[chosen].any()))
    whole = sum(frame.whole_parts for frame in findings)
    return {
        "frames": len(findings),
        "parts": whole,
        "found": sum(frame.found_parts for frame in findings) / max(whole, 1),
        "branch_right": float(right_branch[has].mean()),
        "usable": float(usable[has].mean()),
        "best_possible": float(np.mean([any(crop.usable) for crop in crops if crop.part])),
        "sure": float(np.mean([crop.sure for crop in crops if crop.part])),
        "accepted": float((accepted & has).sum() / max(whole, 1)),
        "accepted_wrong": wrong,
        "accepted_unusable": int((accepted & ~usable).sum()),
        "wrong_upper_95": float(wrong_share_bound(wrong, n, 0.95)) if n else 1.0,
        "part_kept": float(kept[has].mean()),
        "empty_kept": float(kept[~has].mean()) if (~has).any() else 0.0,
        "excess_risk_area": risk_coverage(held_out.probability, ~usable).excess_area,
        "set_size": float(np.mean(sizes)),
        "set_holds": float(np.mean(holds)),
    }


def evidence_config(config: EstimatorConfig | None = None) -> EstimatorConfig:
    """The pipeline's config with all readings refined, so that the choice learns from every crop."""
    config = config or EstimatorConfig()
    short = replace(config.crop_poses.shortlist, thorough=True)
    return replace(config, crop_poses=replace(config.crop_poses, shortlist=short))


def fit_choice(config: ChoiceFitConfig) -> Path:
    """Fit on the data sets and write ``choice.json`` beside the networks' weights; returns its path."""
    cache = config.cache or config.out / "choice_evidence"
    findings = collect(config.data, config.out, cache, evidence_config(), config.jobs, config.parts_dir)
    weights, figures = fit_weights(findings, config)
    print("normalised error squared on frames it was not fitted on (3 and 6 when the covariance holds):")
    for name, row in normalised_errors(findings, weights, config.folds).items():
        slack = 1.96 * np.sqrt(np.array([6.0, 12.0]) / row["n"])
        print(
            f"  {name}: {row['planar']:.2f} of 3 +- {slack[0]:.2f}, {row['pose']:.2f} of 6 +- {slack[1]:.2f}, "
            f"{row['n']} estimates"
        )
    summary = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
    on = ", ".join(f"{data.name} ({manifest_hash(data)})" for data in config.data)
    path = config.out / CHOICE_FILE
    replace(weights, fitted_on=f"{on}: {summary}").save(path)
    print(f"{path}: {summary}")
    return path
