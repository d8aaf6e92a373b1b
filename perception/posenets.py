"""The trained crop networks together: crops in, hypotheses with their log-probabilities and keypoints out.

J proposes (part, stable pose, yaw), V checks the proposals on rectified crops, the voting network places keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from cad.spatial import Array, wrap_angle
from perception.augment import CROP
from perception.classifier import JointClassifier, classify, modes
from perception.estimates import PerceptionError
from perception.faces import FaceTable
from perception.pvnet import PVNet, infer_votes
from perception.verifier import Verifier, rectify, score_views
from perception.voting import offset_vote, ransac_vote
from perception.weight_files import load_weights

PROPOSALS = 6
AXES = 2
"""Yaw axes (a yaw and its opposite) that V looks at; the prototype's right answer was on the first two in 99.9 %."""

_SAME_AXIS = np.radians(15.0)
_SAME_YAW = np.radians(20.0)
_UNSEEN = -8.0  # log-probability that V gives to a hypothesis at whose yaw it did not look


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """One reading of a crop: which part, on which stable pose, at which ``yaw`` (rad, table frame seen by the camera).

    ``centre_px`` is the crop pixel of the footprint's centre at the part's middle height. ``classifier`` and
    ``verifier`` are natural log-probabilities of the two networks (``verifier`` is 0 until verified), and
    ``log_probability`` is their sum: a score to rank by, not a calibrated probability.
    """

    part: str
    stable_pose: int
    yaw: float
    centre_px: tuple[float, float]
    classifier: float
    verifier: float = 0.0

    @property
    def log_probability(self) -> float:
        """Sum of both networks' log-probabilities."""
        return self.classifier + self.verifier


@dataclass(frozen=True, kw_only=True)
class CropReading:
    """What the networks say of one crop: hypotheses, best first, the probability that it shows no part, and those of
    the parts given that it shows one.
    """

    hypotheses: tuple[Hypothesis, ...]
    not_a_part: float
    class_probabilities: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class CropKeypoints:
    """Keypoints (K, 2) in crop pixels with covariances (K, 2, 2), and the mask's probability (64, 64), a cell of which
    is two by two crop pixels.
    """

    pixels: Array
    covariances: Array
    mask: Array


class PoseNets:
    """J, V and the keypoint votes with trained weights."""

    def __init__(self, table: FaceTable, classifier: JointClassifier, verifier: Verifier, keypoints: PVNet) -> None:
        self.table = table
        self.classifier, self.verifier, self.votes = (_ready(net) for net in (classifier, verifier, keypoints))

    @classmethod
    def load(cls, weights_dir: Path, parts_dir: Path | None = None) -> PoseNets:
        """Read ``classifier``, ``verifier`` and ``keypoints`` from ``weights_dir``.

        Raises PerceptionError when a file is missing, or was trained for other meshes or stable poses.
        """
        table: FaceTable | None = None
        states: list[dict[str, Any]] = []
        for name in ("classifier", "verifier", "keypoints"):
            path = weights_dir / f"{name}.safetensors"
            state, metadata = load_weights(path, parts_dir)
            table = table or FaceTable.load(list(metadata["parts"]), parts_dir)
            table.check(metadata["faces"], path.name)
            states.append(state)
        assert table is not None
        nets = (JointClassifier(len(table)), Verifier(len(table)), PVNet.for_table(table))
        for net, state in zip(nets, states, strict=True):
            net.load_state_dict(state)
        return cls(table, *nets)

    def hypotheses(
        self, crops: NDArray[np.uint8], rays: ArrayLike, count: int = PROPOSALS, quarter_turns: int = 4
    ) -> list[CropReading]:
        """J's readings of crops (N, 128, 128, 3) with the rays (N, 2), x/z and y/z in ``cam``, to their centres."""
        images, directions = _checked(crops, rays)
        if not len(images):
            return []
        answer = classify(self.classifier, images, directions, quarter_turns)
        out: list[CropReading] = []
        for log, nothing, centre in zip(answer.log_probability, answer.log_not_a_part, answer.centre, strict=True):
            mass = np.bincount(
                self.table.part_of_face, weights=np.exp(log).sum(axis=1), minlength=len(self.table.parts)
            )
            out.append(
                CropReading(
                    hypotheses=tuple(self._hypothesis(f, y, centre, p) for f, y, p in modes(log, count)),
                    not_a_part=float(np.exp(nothing)),
                    class_probabilities={
                        part.name: float(m) for part, m in zip(self.table.parts, mass / mass.sum(), strict=True)
                    },
                )
            )
        return out

    def verify(self, crops: NDArray[np.uint8], rays: ArrayLike, readings: Sequence[CropReading]) -> list[CropReading]:
        """The readings with V's log-probabilities, sorted anew; ``not_a_part`` becomes the two networks' mean.

        V looks at the axes of the likeliest hypotheses, each both ways round; a hypothesis at another yaw gets a low
        log-probability.
        """
        images, directions = _checked(crops, rays)
        yaws = [_views_of(reading.hypotheses) for reading in readings]
        pairs = [
            rectify(image, reading.hypotheses[0].centre_px, yaw, ray)
            for image, ray, reading, views in zip(images, directions, readings, yaws, strict=True)
            for yaw in views
        ]
        if not pairs:
            return list(readings)
        scores = score_views(
            self.verifier, np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs]), [len(v) for v in yaws]
        )
        return [
            self._verified(reading, views, log, nothing)
            for reading, views, (log, nothing) in zip(readings, yaws, scores, strict=True)
        ]

    def keypoints(
        self,
        crops: NDArray[np.uint8],
        rays: ArrayLike,
        faces: Sequence[tuple[str, int]],
        rng: np.random.Generator | None = None,
    ) -> list[CropKeypoints]:
        """Keypoints of crops that show the given (part, stable pose): by confident offsets, or, when ``rng`` is given,
        by RANSAC over unit vectors as PVNet does.
        """
        images, directions = _checked(crops, rays)
        if not len(images):
            return []
        indices = np.array([self.table.index_of(*face) for face in faces], dtype=np.int64)
        out: list[CropKeypoints] = []
        for votes in infer_votes(self.votes, images, directions, indices):
            if rng is None:
                pixels, covariances = offset_vote(votes["pixels"], votes["offset"], votes["log_scale"])
            else:
                pixels, covariances = ransac_vote(votes["pixels"], votes["unit"], rng)
            out.append(CropKeypoints(pixels=pixels, covariances=covariances, mask=votes["mask"]))
        return out

    def _hypothesis(self, face: int, yaw: float, centre: Array, log_probability: float) -> Hypothesis:
        f = self.table[face]
        return Hypothesis(
            part=f.part.name,
            stable_pose=f.stable_pose.index,
            yaw=yaw,
            centre_px=(float(centre[0]), float(centre[1])),
            classifier=log_probability,
        )

    def _verified(self, reading: CropReading, views: Sequence[float], log: Array, nothing: float) -> CropReading:
        scored: list[Hypothesis] = []
        for hypothesis in reading.hypotheses:
            away = np.abs(wrap_angle(np.array(views) - hypothesis.yaw))
            view = int(away.argmin())
            face = self.table.index_of(hypothesis.part, hypothesis.stable_pose)
            score = float(log[view, face]) if away[view] < _SAME_YAW else _UNSEEN
            scored.append(replace(hypothesis, verifier=max(score, _UNSEEN)))
        scored += self._unproposed(scored, views, log)
        scored.sort(key=lambda h: -h.log_probability)
        not_a_part = 0.5 * (reading.not_a_part + float(np.exp(nothing)))
        return replace(reading, hypotheses=tuple(scored), not_a_part=not_a_part)

    def _unproposed(self, scored: Sequence[Hypothesis], views: Sequence[float], log: Array) -> list[Hypothesis]:
        """V's first reading, of log-probabilities (V, F), when J proposes nothing like it and so gives it less."""
        view, index = (int(i) for i in np.unravel_index(int(log.argmax()), log.shape))
        face, yaw = self.table[index], float(wrap_angle(views[view]))
        if any(
            (h.part, h.stable_pose) == (face.part.name, face.stable_pose.index)
            and abs(float(wrap_angle(h.yaw - yaw))) < _SAME_YAW
            for h in scored
        ):
            return []
        least = min(h.classifier for h in scored) - 1.0
        read = replace(scored[0], part=face.part.name, stable_pose=face.stable_pose.index, yaw=yaw, classifier=least)
        return [replace(read, verifier=max(float(log[view, index]), _UNSEEN))]


def _ready(net: nn.Module) -> Any:
    return net.eval().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def _checked(crops: NDArray[np.uint8], rays: ArrayLike) -> tuple[NDArray[np.uint8], Array]:
    directions = np.asarray(rays, dtype=np.float64)
    if crops.dtype != np.uint8 or crops.shape[1:] != (CROP, CROP, 3) or directions.shape != (len(crops), 2):
        raise PerceptionError(
            f"crops {crops.shape} {crops.dtype} and rays {directions.shape}: expected (N, {CROP}, {CROP}, 3) uint8 and "
            "(N, 2)"
        )
    return crops, directions


def _views_of(hypotheses: Sequence[Hypothesis]) -> list[float]:
    """The yaws that V looks at: those of the first hypotheses that differ by more than an axis, and their opposites."""
    axes: list[float] = []
    for hypothesis in hypotheses[:4]:
        turned = [abs(float(wrap_angle(2 * (hypothesis.yaw - axis)))) / 2 for axis in axes]
        if len(axes) < AXES and all(t > _SAME_AXIS for t in turned):
            axes.append(hypothesis.yaw)
    return [yaw for axis in axes for yaw in (axis, axis + np.pi)]
