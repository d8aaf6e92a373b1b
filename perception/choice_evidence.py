"""What the pipeline finds in whole frames with ground truth: the evidence that choice, gate and noise are fitted on.

Every frame's findings are kept in a file of their own, so that a run that was stopped goes on where it was, and one
with other networks starts anew.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from cad.parts import hash_file
from cad.resting import as_rest
from cad.spatial import Array, inverse, rotation_angle
from perception.alternatives import SAME_YAW, Placement, readings, same_reading
from perception.choice import NEUTRAL, ChoiceWeights, CropContext, gate_evidence
from perception.covariance import inner_error
from perception.crop_poses import SAME_PLACE_M, Candidate, CropPose
from perception.estimates import PerceptionError
from perception.estimator import NETWORK_FILES, EstimatorConfig, LearnedEstimator
from perception.faces import FaceTable
from perception.ground_truth import FrameTruth, GroundTruth, TruePart, read_ground_truth
from perception.planar import on_plane, planar_of

VERSION = 2
"""Of the files; another one is collected anew."""

RIGHT_PLACE_M = 1.5e-4
"""What the choice is to find: the right face and yaw, in the right place among rims and shadows."""
USABLE_PLACE_M = 3e-4
"""What the gate is to predict: a pose good enough for placing a part."""
NEAR_PART_M = 2.5e-3
"""A detection this near to the middle of a part is of that part."""
_ABOVE_TABLE_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class CropFindings:
    """One crop: for every candidate its evidence (H, F), whether it is of the likeliest hypothesis, the right one, and
    usable, which reading it is and where (x, y); whether the pipeline would have been ``sure``; the crop's context.

    ``part`` and ``stable_pose`` are the truth, "" and -1 where there is none, and ``whole`` says that it counts. Of
    every candidate that is usable ``errors`` has (x, y, yaw, height, lean, lean), of the others None, and ``planar``
    Gauss-Newton's covariance.
    """

    evidence: list[list[float]]
    first: list[bool]
    right: list[bool]
    usable: list[bool]
    reading: list[int]
    place: list[list[float]]
    right_reading: list[bool]
    sure: bool
    context: CropContext
    part: str
    stable_pose: int
    whole: bool
    errors: list[list[float] | None]
    planar: list[list[list[float]]]


@dataclass(frozen=True, kw_only=True)
class FrameFindings:
    """One frame: where it is from, how many whole parts are in it, which of them were found, and its crops."""

    data: str
    domain: str
    image: int
    whole_parts: int
    found_parts: int
    crops: tuple[CropFindings, ...]


def collect(
    data_dirs: Sequence[Path],
    weights_dir: Path,
    cache_dir: Path,
    config: EstimatorConfig,
    jobs: int = 2,
    parts_dir: Path | None = None,
    report: Callable[[str], None] = print,
) -> list[FrameFindings]:
    """Findings in all frames of some data sets, in their order, those in ``cache_dir`` as they are there."""
    hashes = "".join(hash_file(weights_dir / name) for name in NETWORK_FILES)
    key = sha256(f"{VERSION} {hashes} {config!r}".encode()).hexdigest()[:16]
    cache_dir.mkdir(parents=True, exist_ok=True)
    (cache_dir / ".gitignore").write_text("*\n")
    wanted = []
    for data_dir in data_dirs:
        truth = read_ground_truth(data_dir, parts_dir)
        wanted += [
            (data_dir, k, cache_dir / f"{truth.manifest}_{frame.image:06d}.json")
            for k, frame in enumerate(truth.frames)
        ]
    if not wanted:
        raise PerceptionError("no frames to fit the choice on: give data sets of whole frames, --data DIR ...")
    found = {path: stored for _, _, path in wanted if (stored := _stored(path, key)) is not None}
    missing = [frame for frame in wanted if frame[2] not in found]
    report(f"choice: {len(found)} of {len(wanted)} frames are known")
    if missing:
        with ProcessPoolExecutor(min(jobs, len(missing)), get_context("spawn"), _one_thread) as pool:
            waiting = [
                pool.submit(_find, weights_dir, config, data, k, path, key, parts_dir) for data, k, path in missing
            ]
            try:
                for future in as_completed(waiting):
                    path, findings = future.result()
                    found[path] = findings
                    report(f"choice: {len(found)} of {len(wanted)} frames")
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return [found[path] for _, _, path in wanted]


def _one_thread() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@cache
def _estimator(weights_dir: Path, config: EstimatorConfig, parts_dir: Path | None) -> LearnedEstimator:
    return LearnedEstimator(weights_dir, config=config, parts_dir=parts_dir, choice=NEUTRAL)


@cache
def _truth(data_dir: Path, parts_dir: Path | None) -> GroundTruth:
    return read_ground_truth(data_dir, parts_dir)


def _find(
    weights_dir: Path, config: EstimatorConfig, data_dir: Path, k: int, path: Path, key: str, parts_dir: Path | None
) -> tuple[Path, FrameFindings]:
    truth = _truth(data_dir, parts_dir)
    estimator = _estimator(weights_dir, config, parts_dir)
    findings = findings_in(estimator, truth.frames[k], data=data_dir.name, domain=truth.domain)
    aside = path.with_name(f".{os.getpid()}.{path.name}")
    aside.write_text(json.dumps({"key": key, "findings": asdict(findings)}))
    os.replace(aside, path)
    return path, findings


def _stored(path: Path, key: str) -> FrameFindings | None:
    """What a file holds, unless it is of other networks or cannot be read."""
    try:
        content = json.loads(path.read_text())
        if content["key"] != key:
            return None
        return findings_from_json(content["findings"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def findings_from_json(content: dict[str, Any]) -> FrameFindings:
    """What ``dataclasses.asdict`` made of findings."""
    crops = tuple(CropFindings(**{**crop, "context": CropContext(**crop["context"])}) for crop in content["crops"])
    return FrameFindings(**{**content, "crops": crops})


def winner_of(crop: CropFindings, weights: ChoiceWeights) -> tuple[int, Array, Array]:
    """Index of a crop's winner, the scores (H,) and the gate's evidence for it, as the pipeline would have them: of a
    crop that it is sure of it knows the first hypothesis alone. Scores of what it does not know are minus infinity.
    """
    evidence = np.array(crop.evidence)
    known = np.array(crop.first) if crop.sure else np.ones(len(evidence), bool)
    scores = np.where(known, weights.scores(evidence), -np.inf)
    best = int(scores.argmax())
    apart = np.hypot(*(np.array(crop.place) - crop.place[best]).T) > SAME_PLACE_M
    rivals = ((np.array(crop.reading) != crop.reading[best]) | apart) & known
    return (
        best,
        scores,
        gate_evidence(scores, np.where(known[:, None], evidence, evidence[best]), best, rivals, crop.context),
    )


def findings_in(estimator: LearnedEstimator, truth: FrameTruth, data: str, domain: str) -> FrameFindings:
    """Run the pipeline on a frame up to the candidates, and judge them by the frame's ground truth."""
    frame = truth.frame()
    seen = estimator.look(frame)
    table = estimator.solver.nets.table
    parts = [_TrueRest.of(part, table, seen.T_cam_table) for part in truth.parts]
    crops, found = [], set[int]()
    for detection, pose in zip(seen.detections, seen.poses, strict=True):
        x, y = on_plane(detection.centre_px, _ABOVE_TABLE_M, frame.intrinsics, seen.T_cam_table)[:2]
        crop, number = _judged(pose, parts, (float(x), float(y)), table, seen.T_cam_table)
        crops.append(crop)
        found.add(number)
    whole = {part.number for part in truth.parts if part.whole}
    return FrameFindings(
        data=data,
        domain=domain,
        image=truth.image,
        whole_parts=len(whole),
        found_parts=len(found & whole),
        crops=tuple(crops),
    )


@dataclass(frozen=True, eq=False)
class _TrueRest:
    """A part of the truth and where it rests in the table frame that the estimator saw."""

    part: TruePart
    placement: Placement

    @staticmethod
    def of(part: TruePart, table: FaceTable, T_cam_table: Array) -> _TrueRest:
        pose = part.part.stable_poses[part.stable_pose]
        T_table_part = inverse(T_cam_table) @ part.T_cam_part
        if pose.roll is not None:
            T_table_part = as_rest(part.part, pose, T_table_part)
        x, y, yaw = planar_of(T_cam_table @ T_table_part, T_cam_table, pose)
        return _TrueRest(part, (table.index_of(part.part.name, part.stable_pose), x, y, yaw))


def _judged(
    pose: CropPose, parts: Sequence[_TrueRest], at: tuple[float, float], table: FaceTable, T_cam_table: Array
) -> tuple[CropFindings, int]:
    """One crop's findings, and the number of the part it shows, -1 where there is none."""
    placements = [candidate.placement for candidate in pose.candidates]

    def alike(part: _TrueRest, within_m: float) -> list[bool]:
        return [same_reading(table, part.placement, placement, within_m) for placement in placements]

    def distance(part: _TrueRest) -> float:
        places = [at, *((x, y) for _, x, y, _ in placements)]
        return min(float(np.hypot(x - part.placement[1], y - part.placement[2])) for x, y in places)

    nearest = min(parts, key=distance, default=None)
    if nearest is not None and distance(nearest) > NEAR_PART_M:
        nearest = None
    no = [False] * len(placements)
    usable = alike(nearest, USABLE_PLACE_M) if nearest else no
    findings = CropFindings(
        evidence=[c.evidence.tolist() for c in pose.candidates],
        first=[c.first for c in pose.candidates],
        right=alike(nearest, RIGHT_PLACE_M) if nearest else no,
        usable=usable,
        reading=readings(table, placements),
        place=[[x, y] for _, x, y, _ in placements],
        right_reading=alike(nearest, np.inf) if nearest else no,
        sure=pose.sure,
        context=pose.context,
        part=nearest.part.part.name if nearest else "",
        stable_pose=nearest.part.stable_pose if nearest else -1,
        whole=nearest is None or nearest.part.whole,
        errors=[
            _error(nearest.part, c, T_cam_table) if nearest and good else None
            for c, good in zip(pose.candidates, usable, strict=True)
        ],
        planar=[c.refinement.covariance.tolist() for c in pose.candidates],
    )
    return findings, nearest.part.number if nearest else -1


def _error(truth: TruePart, candidate: Candidate, T_cam_table: Array) -> list[float] | None:
    """The error by its causes; None when the candidate is another placement that merely looks the same."""
    if candidate.face.part.name != truth.part.name:
        return None
    T, r = candidate.T_cam_part(T_cam_table), candidate.refinement
    true = truth.part.rest_symmetries(truth.stable_pose).nearest(T, truth.T_cam_part)
    if rotation_angle(true[:3, :3], T[:3, :3]) > 2 * SAME_YAW:
        return None
    return inner_error(true, T, T_cam_table, r.x, r.y).tolist()
