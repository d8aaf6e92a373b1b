"""Which of the networks' hypotheses for a crop are worth refining: one where all agree, more where they do not.

Refining takes most of a frame's time, and a reading that is not refined cannot be chosen. So where anything speaks
against the first reading, those that the usual mistakes would hide are tested too: the part the other way round, and
the best reading of another class. A part that was given the wrong class shows by its contour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cad.spatial import Array, Intrinsics, apply, wrap_angle
from perception.faces import FaceTable
from perception.planar import PlanarError, solve_planar
from perception.posenets import CropKeypoints, CropReading, Hypothesis
from perception.sighting import Sighting


@dataclass(frozen=True, kw_only=True)
class ShortlistConfig:
    """``refined`` hypotheses at most within ``nats`` of the best network score are refined by their rank, ``most`` in
    all; one when the networks agree and lead by ``sure_nats``; none when no part is likelier than ``nothing``.

    Classes with less than ``class_share`` of the probability, of J and of the segmenter, are not tested. Yaws nearer
    than ``same_yaw`` rad are one hypothesis. ``thorough`` refines as if nothing were ever sure.
    """

    refined: int = 3
    most: int = 5
    nats: float = 6.0
    sure_nats: float = 6.0
    nothing: float = 0.95
    class_share: float = 0.005
    same_yaw: float = float(np.radians(12.0))
    thorough: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.refined <= self.most:
            raise ValueError(f"refined {self.refined}, most {self.most}: must be at least 1, and refined at most most")
        if min(self.nats, self.sure_nats, self.same_yaw) <= 0:
            raise ValueError(f"nats {self.nats}, sure_nats {self.sure_nats}, same_yaw {self.same_yaw}: must be above 0")


@dataclass(frozen=True, kw_only=True)
class Shortlist:
    """Hypotheses ``wanted`` for refinement, best first; ``sure`` that the first one is right, so that ``others`` (the
    first one included) are wanted only if its contour says otherwise.
    """

    wanted: tuple[Hypothesis, ...]
    others: tuple[Hypothesis, ...]
    sure: bool


def shortlist(reading: CropReading, sighting: Sighting, table: FaceTable, config: ShortlistConfig) -> Shortlist:
    """What to refine of a crop's reading that V has checked; nothing when the networks see no part."""
    best = reading.hypotheses[0]
    if reading.not_a_part > config.nothing:
        return Shortlist(wanted=(), others=(), sure=False)
    likely = [h for h in reading.hypotheses if best.log_probability - h.log_probability < config.nats]
    chosen = likely[: config.refined]
    for extra in (*_other_classes(reading, sighting, config), *_turned_round(reading, table, config)):
        if extra not in chosen and len(chosen) < config.most:
            chosen.append(extra)
    sure = _sure(reading, sighting, table, config)
    everything = tuple(chosen)
    return Shortlist(wanted=(best,) if sure and not config.thorough else everything, others=everything, sure=sure)


def _sure(reading: CropReading, sighting: Sighting, table: FaceTable, config: ShortlistConfig) -> bool:
    """Whether J, V and the segmenter agree on the first hypothesis, and no other reading comes near it."""
    best = reading.hypotheses[0]
    face = table.index_of(best.part, best.stable_pose)
    rivals = [
        h
        for h in reading.hypotheses[1:]
        if not table.same_view(face, best.yaw, table.index_of(h.part, h.stable_pose), h.yaw, config.same_yaw)
    ]
    return (
        reading.not_a_part < 0.5
        and max(sighting.class_probabilities, key=lambda name: sighting.class_probabilities[name]) == best.part
        and all(h.classifier < best.classifier and h.verifier <= best.verifier for h in rivals)
        and all(best.log_probability - h.log_probability > config.sure_nats for h in rivals)
    )


def _other_classes(reading: CropReading, sighting: Sighting, config: ShortlistConfig) -> list[Hypothesis]:
    """The best hypothesis of each other class that J or the segmenter thinks possible, likeliest first."""
    best = reading.hypotheses[0]
    share = {
        part: max(p, sighting.class_probabilities.get(part, 0.0))
        for part, p in reading.class_probabilities.items()
        if part != best.part
    }
    possible = sorted((part for part in share if share[part] > config.class_share), key=lambda part: -share[part])
    first = {h.part: h for h in reversed(reading.hypotheses)}
    return [first[part] for part in possible if part in first]


def _turned_round(reading: CropReading, table: FaceTable, config: ShortlistConfig) -> list[Hypothesis]:
    """The first hypothesis with the opposite yaw, as the networks score it; none where it looks the same."""
    best = reading.hypotheses[0]
    face, yaw = table.index_of(best.part, best.stable_pose), float(wrap_angle(best.yaw + np.pi))
    if table.same_view(face, best.yaw, face, yaw, config.same_yaw):
        return []
    for h in reading.hypotheses[1:]:
        if (h.part, h.stable_pose) == (best.part, best.stable_pose) and _near(h.yaw, yaw, config.same_yaw):
            return [h]
    return [_below_all(best, reading.hypotheses, yaw, best.centre_px)]


def turned_by_keypoints(
    hypotheses: Sequence[Hypothesis],
    votes: Mapping[tuple[str, int], CropKeypoints],
    table: FaceTable,
    small: Intrinsics,
    T_cam_table: Array,
    same_yaw: float,
) -> list[Hypothesis]:
    """What the keypoints of the first hypothesis's face say, when that is a yaw that none of the hypotheses has.

    ``small`` is the camera of the networks' crop.
    """
    best = hypotheses[0]
    keypoints = votes.get((best.part, best.stable_pose))
    if keypoints is None:
        return []
    face = table[table.index_of(best.part, best.stable_pose)]
    try:
        solved = solve_planar(
            face.part.keypoints, keypoints.pixels, keypoints.covariances, face.stable_pose, small, T_cam_table
        )
    except PlanarError:
        return []
    if any(
        _near(solved.yaw, h.yaw, same_yaw)
        for h in hypotheses
        if (h.part, h.stable_pose) == (best.part, best.stable_pose)
    ):
        return []
    u, v = small.project(apply(T_cam_table, [solved.x, solved.y, face.middle_m]))
    return [_below_all(best, hypotheses, solved.yaw, (float(u), float(v)))]


def _near(yaw: float, other: float, within: float) -> bool:
    return abs(float(wrap_angle(yaw - other))) < within


def _below_all(
    like: Hypothesis, hypotheses: Sequence[Hypothesis], yaw: float, centre_px: tuple[float, float]
) -> Hypothesis:
    """A hypothesis that the networks did not propose: they give it less than any that they did."""
    return replace(
        like,
        yaw=yaw,
        centre_px=centre_px,
        classifier=min(h.classifier for h in hypotheses) - 1.0,
        verifier=min(h.verifier for h in hypotheses) - 1.0,
    )
