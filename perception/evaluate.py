"""Runs pose estimators on the frames of a finished data set and keeps what became of every part.

Each frame and method gives one file, ``OUT/estimates/METHOD/NNNNNN.json``, which appears whole or not at all: a run
that was stopped goes on where it was. A file that was made from other data or by another version is made again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cad.files import write_json
from cad.spatial import Array, transform
from perception.bop_files import read_json
from perception.bop_results import BopPose
from perception.coco_results import CocoResult, frame_results
from perception.estimates import NOT_A_PART, Frame, FrameEstimate, PerceptionError, PoseEstimator
from perception.faces import FaceTable
from perception.frame_outcomes import Judge
from perception.ground_truth import IMAGES_A_SCENE, FrameTruth, GroundTruth
from perception.outcomes import Outcome, outcome_from_json, outcome_to_json
from perception.pose_comparison import as_raw

FOLDER = "estimates"
WHOLE_FRAMES = "scene"
"""``kind`` in ``dataset.json`` of whole frames, in which the tags are seen."""
TOTAL = "total"
"""Key in ``FrameRecord.seconds`` of the wall time from frame to poses."""

Progress = Callable[[int, int, str], None]
"""Called with the number of frames done, of all frames, and what is being done."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """A pose in a record: class, score, ``T_cam_part`` (4, 4) in metres."""

    obj_id: int
    score: float
    T_cam_part: Array


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """What one method made of one image: its outcome rows, instances in COCO's form, poses, the seconds that each stage
    took, and why the whole image could not be used, if so.
    """

    method: str
    image: int
    made_from: str
    outcomes: tuple[Outcome, ...]
    detections: tuple[CocoResult, ...] = ()
    poses: tuple[Found, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    note: str = ""

    def bop_poses(self) -> list[BopPose]:
        """The poses as BOP lists them."""
        scene_id, im_id = divmod(self.image, IMAGES_A_SCENE)
        return [
            BopPose(
                scene_id=scene_id,
                im_id=im_id,
                obj_id=pose.obj_id,
                score=pose.score,
                T_cam_part=pose.T_cam_part,
                time_s=self.seconds.get(TOTAL, -1.0),
            )
            for pose in self.poses
        ]


def evaluate(
    truth: GroundTruth,
    estimators: Mapping[str, PoseEstimator],
    out: Path,
    *,
    raw_names: Mapping[str, str] | None = None,
    versions: Mapping[str, str] | None = None,
    parts_dir: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, list[FrameRecord]]:
    """Records by method, a list in the order of the frames; frames that are done are read instead.

    ``raw_names`` maps a method to the name under which its poses before refinement are judged as a method of their own.
    ``versions`` say what a method is, such as the hashes of its weights. Raises PerceptionError when the data set does
    not hold whole frames.
    """
    if truth.dataset["kind"] != WHOLE_FRAMES:
        raise PerceptionError(
            f"the data set holds images of kind {truth.dataset['kind']!r}; poses are evaluated on whole frames, kind "
            f"{WHOLE_FRAMES!r}, which show the tags: render such a one"
        )
    table = FaceTable(truth.parts)
    raw_names = dict(raw_names or {})
    judges = {name: Judge(method=name, domain=truth.domain, table=table) for name in [*estimators, *raw_names.values()]}
    records: dict[str, list[FrameRecord]] = {name: [] for name in judges}
    for k, frame_truth in enumerate(truth.frames):
        frame: Frame | None = None
        for name, estimator in estimators.items():
            if progress:
                progress(k, len(truth.frames), name)
            rows = [name, *([raw_names[name]] if name in raw_names else [])]
            made_from = _made_from(truth, name, versions)
            done = [_read_if_made_from(record_path(out, row, frame_truth.image), made_from) for row in rows]
            if any(record is None for record in done):
                frame = frame or frame_truth.frame()
                estimate, note = _estimate(estimator, frame, frame_truth)
                views = [estimate, _raw(estimate)]
                done = [
                    _record(judges[row], frame_truth, frame, view, made_from, note)
                    for row, view in zip(rows, views, strict=False)
                ]
                for record in done:
                    write_json(record_path(out, record.method, record.image), _to_json(record))
            for row, record in zip(rows, done, strict=True):
                assert record is not None
                records[row].append(record)
    if progress:
        progress(len(truth.frames), len(truth.frames), "done")
    return records


def kept_frames(
    truth: GroundTruth, methods: Iterable[str], out: Path, versions: Mapping[str, str] | None = None
) -> int:
    """Of how many frames ``evaluate`` would read the records of all ``methods`` instead of running them."""
    expected = [(method, _made_from(truth, method, versions)) for method in methods]
    return sum(
        all(_read_if_made_from(record_path(out, method, frame.image), made) for method, made in expected)
        for frame in truth.frames
    )


def record_path(out: Path, method: str, image: int) -> Path:
    """Where the record of an image is."""
    return out / FOLDER / method / f"{image:06d}.json"


def read_records(out: Path, method: str) -> list[FrameRecord]:
    """All records of a method in the order of the images; raises PerceptionError when there are none."""
    paths = sorted((out / FOLDER / method).glob("[0-9]*.json"))
    if not paths:
        known = ", ".join(sorted(p.name for p in (out / FOLDER).glob("*") if p.is_dir())) or "none"
        raise PerceptionError(f"no estimates of {method!r} in {out / FOLDER}; methods there are: {known}; evaluate it")
    return [_from_json(read_json(path)) for path in paths]


def outcomes_of(records: Sequence[FrameRecord]) -> list[Outcome]:
    """All rows of some records."""
    return [outcome for record in records for outcome in record.outcomes]


def _estimate(estimator: PoseEstimator, frame: Frame, truth: FrameTruth) -> tuple[FrameEstimate, str]:
    """The estimate with the total time among its seconds; nothing found, and why, where the frame cannot be used.

    It gets a frame of its own, so that no method finds work done that another one had to do.
    """
    own = replace(frame)
    started = time.perf_counter()
    try:
        estimate, note = estimator.estimate(own), ""
    except PerceptionError as error:
        note = str(error)
        estimate = FrameEstimate(T_cam_board=truth.T_cam_board, parts=(), tags_seen=0, tag_rms_px=float("nan"))
    return replace(estimate, seconds=estimate.seconds | {TOTAL: time.perf_counter() - started}), note


def _raw(estimate: FrameEstimate) -> FrameEstimate:
    """The poses before refinement; parts without one are left out."""
    return replace(estimate, parts=tuple(raw for part in estimate.parts if (raw := as_raw(part)) is not None))


def _record(
    judge: Judge, truth: FrameTruth, frame: Frame, estimate: FrameEstimate, made_from: str, note: str
) -> FrameRecord:
    proposed = [part for part in estimate.parts if part.verdict != NOT_A_PART]
    obj_ids = {name: judge.part(name).obj_id for name in {part.part for part in estimate.parts}}
    return FrameRecord(
        method=judge.method,
        image=truth.image,
        made_from=made_from,
        outcomes=tuple(judge.outcomes(truth, frame.image, estimate)),
        detections=tuple(frame_results(estimate, truth, obj_ids)),
        poses=tuple(Found(obj_id=obj_ids[p.part], score=p.score, T_cam_part=p.T_cam_part) for p in proposed),
        seconds={stage: float(s) for stage, s in estimate.seconds.items()},
        note=note,
    )


def _made_from(truth: GroundTruth, method: str, versions: Mapping[str, str] | None) -> str:
    return f"{truth.manifest} {(versions or {}).get(method, '')}".strip()


def _read_if_made_from(path: Path, made_from: str) -> FrameRecord | None:
    if not path.exists():
        return None
    content = read_json(path)
    return _from_json(content) if content.get("made_from") == made_from else None


def _to_json(record: FrameRecord) -> dict[str, Any]:
    return {
        "method": record.method,
        "image": record.image,
        "made_from": record.made_from,
        "note": record.note,
        "seconds": record.seconds,
        "outcomes": [outcome_to_json(o) for o in record.outcomes],
        "detections": list(record.detections),
        "poses": [
            {
                "obj_id": p.obj_id,
                "score": p.score,
                "R_cam_part": p.T_cam_part[:3, :3].ravel().tolist(),
                "t_cam_part_m": p.T_cam_part[:3, 3].tolist(),
            }
            for p in record.poses
        ],
    }


def _from_json(content: Mapping[str, Any]) -> FrameRecord:
    return FrameRecord(
        method=content["method"],
        image=content["image"],
        made_from=content["made_from"],
        note=content["note"],
        seconds=content["seconds"],
        outcomes=tuple(outcome_from_json(row) for row in content["outcomes"]),
        detections=tuple(content["detections"]),
        poses=tuple(
            Found(
                obj_id=p["obj_id"],
                score=p["score"],
                T_cam_part=transform(np.reshape(p["R_cam_part"], (3, 3)), p["t_cam_part_m"]),
            )
            for p in content["poses"]
        ),
    )
