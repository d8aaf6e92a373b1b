"""Poses as a BOP results file: CSV with ``scene_id,im_id,obj_id,score,R,t,time``; t in millimetres, time in seconds.

``R`` is row by row and, as ``t``, space-separated; ``time`` is that of the whole image (BOP's rule), -1 where unknown.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cad.files import replacing
from cad.spatial import Array, transform
from perception.bop_files import DISTANCE_MM
from perception.estimates import PerceptionError

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True, kw_only=True, eq=False)
class BopPose:
    """One estimate: ``T_cam_part`` (4, 4) in metres, and the seconds that its whole image took."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_cam_part: Array
    time_s: float = -1.0


def bop_results_name(method: str, data_set: str, split: str) -> str:
    """File name by BOP's rule, METHOD_DATASET-SPLIT.csv; an underscore inside a name becomes a hyphen."""
    method, data_set = (name.replace("_", "-") for name in (method, data_set))
    return f"{method}_{data_set}-{split}.csv"


def write_bop_results(path: Path, poses: Iterable[BopPose]) -> None:
    """Write a results file; a number is written so that reading it gives the same one."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for p in poses:
            R = " ".join(repr(float(x)) for x in p.T_cam_part[:3, :3].ravel())
            t_mm = " ".join(repr(float(x)) for x in 1e3 * p.T_cam_part[:3, 3])
            writer.writerow([p.scene_id, p.im_id, p.obj_id, repr(float(p.score)), R, t_mm, repr(float(p.time_s))])


def read_bop_results(path: Path) -> list[BopPose]:
    """The poses of a results file.

    Raises PerceptionError naming the line that is not in BOP's form, has no rotation, is not in millimetres, or gives
    another time than its image had before.
    """
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except OSError as error:
        raise PerceptionError(f"{path} cannot be read: {error}") from error
    if not lines or tuple(lines[0]) != COLUMNS:
        raise PerceptionError(f"{path} does not begin with {','.join(COLUMNS)}: it is no BOP results file")
    poses: list[BopPose] = []
    times: dict[tuple[int, int], float] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            pose = _parsed(line)
        except ValueError as error:
            raise PerceptionError(f"line {number} of {path}: {error}") from error
        before = times.setdefault((pose.scene_id, pose.im_id), pose.time_s)
        if pose.time_s != before:
            raise PerceptionError(
                f"line {number} of {path}: time {pose.time_s:g} s, above it {before:g} s; it is that of the whole "
                "image, the same in all its lines"
            )
        poses.append(pose)
    return poses


def _parsed(line: list[str]) -> BopPose:
    if len(line) != len(COLUMNS):
        raise ValueError(f"{len(line)} columns instead of {len(COLUMNS)}")
    scene_id, im_id, obj_id, score, rotation, translation, time_s = line
    R, t_mm = (np.array(text.split(), np.float64) for text in (rotation, translation))
    if R.shape != (9,) or t_mm.shape != (3,):
        raise ValueError(f"R has {R.size} numbers and t {t_mm.size}; they must have 9 and 3")
    R = R.reshape(3, 3)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        raise ValueError("R is no rotation")
    if not DISTANCE_MM[0] <= float(np.linalg.norm(t_mm)) <= DISTANCE_MM[1]:
        raise ValueError(f"t is {np.linalg.norm(t_mm):g} long: BOP's unit is the millimetre")
    return BopPose(
        scene_id=int(scene_id),
        im_id=int(im_id),
        obj_id=int(obj_id),
        score=float(score),
        T_cam_part=transform(R, t_mm / 1e3),
        time_s=float(time_s),
    )
