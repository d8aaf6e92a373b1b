"""Chooses among the refined hypotheses of one crop, and says how sure the choice is.

Three logistic models with a handful of weights each, fitted on validation frames. The *choice* is listwise: the score
of a hypothesis is a weighted sum of its evidence, and scores of one crop's hypotheses are compared by softmax. The
*gate* says how probable it is that the winner is right and good enough to act on: that its own evidence is good, times
that its lead over its rivals is no accident. The *part* model turns the same evidence into the probability that there
is a part at all.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.spatial import Array
from perception.covariance import NoiseModel, face_name, noise_of
from perception.estimates import PerceptionError

FEATURES = (
    "classifier",
    "verifier",
    "matched_fraction",
    "matched_outline",
    "correlation",
    "explained",
    "region_fit",
    "region_unexplained",
    "keypoints",
    "segmenter_class",
    "overlap",
)
"""Evidence for a hypothesis: natural log-probabilities of J and V, scores of the contour and of the region, minus the
distance between voted and refined keypoints in pixels, the segmenter's log-probability of its class, and the overlap
(IoU) of its silhouette with the segmenter's mask."""

AGAINST = ("region_unexplained",)
"""Evidence that speaks against a hypothesis the larger it is; all other evidence speaks for it."""

GATE_FEATURES = (
    "constant",
    "lead",
    "proposed",
    "verified",
    "is_part",
    "certainty",
    "matched_fraction",
    "matched_outline",
    "correlation",
    "explained",
    "region_fit",
    "region_unexplained",
    "keypoints",
    "overlap",
    "segmenter_score",
    "segmenter_class",
    "tags",
    "uncut",
)
"""Evidence for the winner: its lead in score; how far J and V put it below their own first readings (0 where they agree
with it); the networks' log-odds that there is a part; minus the entropy of J; its own scores; the segmenter's log-odds;
minus the tags' reprojection error in pixels; and whether the part lies inside of the frame."""

RIVALRY = ("constant", "lead")
"""Evidence that no rival of the winner is the right one."""

MAX_LEAD = 8.0
MAX_LOG_ODDS = 6.0
MAX_BEHIND = 6.0
"""Limits in nats, beyond which more is no more evidence."""


@dataclass(frozen=True, kw_only=True)
class CropContext:
    """What is known of a crop beside its hypotheses: the networks' probability of no part, J's entropy in nats, the
    segmenter's score, whether its mask touches the frame's border, and the reprojection error of the tags, pixels.
    """

    not_a_part: float
    entropy: float
    segmenter_score: float
    cut: bool
    tag_rms_px: float


@dataclass(frozen=True, kw_only=True)
class ChoiceWeights:
    """Weights by name, thresholds, the noise of poses by part and face, and what all was fitted on.

    An estimate is accepted above the probability ``accept_above`` of being right, and is none of a part below
    ``part_above``. Scores over ``temperature`` give the probabilities of the readings; the likeliest that together have
    ``set_mass`` of it are the prediction set.
    """

    choice: dict[str, float]
    gate: dict[str, float]
    rivalry: dict[str, float]
    part: dict[str, float]
    accept_above: float
    part_above: float = 0.5
    temperature: float = 1.0
    set_mass: float = 0.99
    noise: dict[str, NoiseModel] = field(default_factory=dict)
    fitted_on: str = ""

    def __post_init__(self) -> None:
        for have, want in (
            (self.choice, FEATURES),
            (self.gate, GATE_FEATURES),
            (self.rivalry, RIVALRY),
            (self.part, GATE_FEATURES),
        ):
            if set(have) != set(want):
                raise PerceptionError(f"weights for {', '.join(sorted(have))}; expected {', '.join(want)}: fit again")
        for name in ("accept_above", "part_above", "set_mass"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise PerceptionError(f"{name} = {getattr(self, name)}: must be at least 0 and below 1")
        if self.temperature <= 0.0:
            raise PerceptionError(f"temperature = {self.temperature}: must be above 0")

    @staticmethod
    def load(path: Path) -> ChoiceWeights:
        """Read a JSON file; raises PerceptionError when there is none or it does not fit this version."""
        if not path.exists():
            raise PerceptionError(f"no choice weights at {path}; fit them with `python -m perception.train choice`")
        try:
            content = json.loads(path.read_text())
            noise = {
                part: NoiseModel(**{**model, "growth": tuple(model["growth"])})
                for part, model in content.pop("noise").items()
            }
            return ChoiceWeights(**content, noise=noise)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise PerceptionError(f"{path} does not hold choice weights ({error!r}); fit them again") from error

    def save(self, path: Path) -> None:
        """Write as JSON, under a temporary name first."""
        content: dict[str, Any] = asdict(self)
        for name, order in (
            ("choice", FEATURES),
            ("gate", GATE_FEATURES),
            ("rivalry", RIVALRY),
            ("part", GATE_FEATURES),
        ):
            content[name] = {key: round(content[name][key], 5) for key in order}
        aside = path.with_name(f".{os.getpid()}.{path.name}")
        aside.write_text(json.dumps(content, indent=2) + "\n")
        os.replace(aside, path)

    def noise_of(self, part: str, stable_pose: int) -> NoiseModel:
        """How much poses of a part that rests so scatter; those of the part in any pose when that is not known, the
        usual figures for a part that nothing was fitted for.
        """
        return noise_of(self.noise, face_name(part, stable_pose)) or NoiseModel()

    def scores(self, evidence: Array) -> Array:
        """Scores (H,) in nats of hypotheses with evidence (H, len(FEATURES))."""
        return evidence @ np.array([self.choice[name] for name in FEATURES])

    def probability_right(self, gate_evidence: Array) -> Array:
        """Probability (...) that a winner with evidence (..., len(GATE_FEATURES)) is right."""
        good = _logistic(gate_evidence @ np.array([self.gate[name] for name in GATE_FEATURES]))
        lead = gate_evidence[..., GATE_FEATURES.index("lead")]
        return good * _logistic(self.rivalry["constant"] + self.rivalry["lead"] * lead)

    def probability_part(self, gate_evidence: Array) -> Array:
        """Probability (...) that a crop whose winner has evidence (..., len(GATE_FEATURES)) shows a part: at least that
        of being right, since what is right is a part, whatever the two models make of the same evidence.
        """
        seen = _logistic(gate_evidence @ np.array([self.part[name] for name in GATE_FEATURES]))
        return np.maximum(seen, self.probability_right(gate_evidence))


NEUTRAL = ChoiceWeights(
    choice=dict.fromkeys(FEATURES, 0.0) | {"classifier": 1.0, "verifier": 1.0, "matched_fraction": 3.0},
    gate=dict.fromkeys(GATE_FEATURES, 0.0),
    rivalry=dict.fromkeys(RIVALRY, 0.0),
    part=dict.fromkeys(GATE_FEATURES, 0.0),
    accept_above=0.5,
)
"""Stand-ins while evidence is collected: they only order hypotheses."""


def gate_evidence(scores: Array, evidence: Array, best: int, rivals: NDArray[np.bool_], context: CropContext) -> Array:
    """Evidence (len(GATE_FEATURES),) for hypothesis ``best`` of those with ``scores`` (H,) and ``evidence`` (H, F).

    The lead is that over the best of the ``rivals`` (H,) bool, 8 nats at most and when there is none.
    """
    others = scores[rivals]
    lead = MAX_LEAD if len(others) == 0 else float(np.clip(scores[best] - others.max(), -MAX_LEAD, MAX_LEAD))
    row = dict(zip(FEATURES, evidence[best], strict=True))
    behind = {name: max(row[name] - evidence[:, FEATURES.index(name)].max(), -MAX_BEHIND) for name in FEATURES[:2]}
    own = {name: row[name] for name in GATE_FEATURES if name in row}
    known = own | {
        "constant": 1.0,
        "lead": lead,
        "proposed": behind["classifier"],
        "verified": behind["verifier"],
        "is_part": -_log_odds(context.not_a_part),
        "certainty": -context.entropy,
        "segmenter_score": _log_odds(context.segmenter_score),
        "tags": -context.tag_rms_px,
        "uncut": 0.0 if context.cut else 1.0,
    }
    return np.array([known[name] for name in GATE_FEATURES], dtype=np.float64)


def _log_odds(p: float) -> float:
    p = float(np.clip(p, 1e-4, 1 - 1e-4))
    return float(np.clip(np.log(p / (1 - p)), -MAX_LOG_ODDS, MAX_LOG_ODDS))


def _logistic(odds: Array) -> Array:
    return 1.0 / (1.0 + np.exp(-np.clip(odds, -30.0, 30.0)))
