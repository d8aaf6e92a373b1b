"""Frames that nobody rendered: grey pictures with right labels, and estimators that say what they are told."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from data_sets import Picture, write_data_set

from cad.parts import load_part, planar
from cad.spatial import BASLER, Array, rotation_x, transform
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.ground_truth import FrameTruth, TruePart, read_ground_truth
from perception.silhouette import silhouette_mask
from scenes.bop import Annotation

CAMERA = BASLER.crop(2200, 1500, 1000, 700)
T_CAM_BOARD = transform(rotation_x(np.pi - 0.01), [0.002, -0.001, 0.7])

Placed = tuple[str, int, float, float, float]
"""Part, stable pose, x and y in metres and yaw in rad, in the board's frame."""

LAYOUT: tuple[Placed, ...] = (
    ("inserted", 0, -0.015, 0.010, 0.3),
    ("main", 1, 0.010, 0.008, -2.0),
    ("main", 2, -0.012, -0.010, 1.2),
)


def pose_of(placed: Placed) -> Array:
    """``T_cam_part`` (4, 4)."""
    name, stable_pose, x, y, yaw = placed
    return T_CAM_BOARD @ planar(x, y, yaw) @ load_part(name).stable_poses[stable_pose].T_table_part


def write_frames(folder: Path, layouts: Sequence[Sequence[Placed]]) -> Path:
    """A finished data set of frames of 1000 x 700 pixels with parts lying as told, all of them visible."""
    parts = [load_part(name) for name in ("inserted", "main", "top")]
    pictures = []
    for k, layout in enumerate(layouts):
        picture = Picture(np.full((CAMERA.height, CAMERA.width, 3), 60 + 40 * k, np.uint8), CAMERA, T_CAM_BOARD)
        picture.annotations = [_annotation(placed) for placed in layout]
        pictures.append(picture)
    write_data_set(folder, "val", parts, pictures)
    about: dict[str, Any] = {
        "kind": "scene",
        "domain": "classic",
        "split": "val",
        "size": [CAMERA.width, CAMERA.height],
        "parts": {part.name: {"mesh": part.mesh_hash} for part in parts},
    }
    (folder / "dataset.json").write_text(json.dumps(about))
    return folder


def frame_of(folder: Path, layout: Sequence[Placed]) -> FrameTruth:
    """The truth of the only frame of a new data set."""
    return read_ground_truth(write_frames(folder, [layout])).frames[0]


def estimate_of(part: TruePart, T_cam_part: Array | None = None, **changes: Any) -> PartEstimate:
    """An accepted estimate of a part, right but for what is changed; its mask is the silhouette at its pose."""
    T = part.T_cam_part if T_cam_part is None else T_cam_part
    mask, origin = silhouette_mask(part.part, T, CAMERA)
    right = PartEstimate(
        part=part.part.name,
        T_cam_part=T,
        stable_pose=part.stable_pose,
        score=0.9,
        mask=mask,
        mask_origin=origin,
        raw_T_cam_part=transform(None, [0.0, 0.0, 0.02]) @ T,
    )
    return replace(right, **changes)


def moved(part: TruePart, x_m: float = 0.0, y_m: float = 0.0, yaw: float = 0.0) -> Array:
    """The part's pose shifted along the camera's axes and turned about the board's normal through its own origin."""
    T = part.T_cam_part.copy()
    R = T_CAM_BOARD[:3, :3] @ planar(0.0, 0.0, yaw)[:3, :3] @ T_CAM_BOARD[:3, :3].T
    T[:3, :3] = R @ T[:3, :3]
    T[:3, 3] += [x_m, y_m, 0.0]
    return T


def seen(*parts: PartEstimate) -> FrameEstimate:
    """A frame's estimate with the board where it is."""
    return FrameEstimate(T_cam_board=T_CAM_BOARD, parts=parts, tags_seen=20, tag_rms_px=0.1, seconds={"thinking": 0.5})


@dataclass
class Told:
    """An estimator that answers each frame, known by its grey level, by what ``answer`` makes of the truth."""

    frames: Sequence[FrameTruth]
    answer: Callable[[FrameTruth], FrameEstimate]
    calls: list[int] = field(default_factory=list)

    def estimate(self, frame: Frame) -> FrameEstimate:
        """What it was told to say."""
        (truth,) = [f for k, f in enumerate(self.frames) if 60 + 40 * k == int(frame.image[0, 0, 0])]
        self.calls.append(truth.image)
        return self.answer(truth)


def right_answer(truth: FrameTruth) -> FrameEstimate:
    """Every part as it is."""
    return seen(*(estimate_of(part) for part in truth.parts))


def _annotation(placed: Placed) -> Annotation:
    part, T = load_part(placed[0]), pose_of(placed)
    margin = 200  # pixels: a silhouette reaches beyond the image where the border cuts it
    wide = replace(
        CAMERA,
        width=CAMERA.width + 2 * margin,
        height=CAMERA.height + 2 * margin,
        cx=CAMERA.cx + margin,
        cy=CAMERA.cy + margin,
    )
    silhouette, (u, v) = silhouette_mask(part, T, wide)
    corner = u - margin, v - margin
    rows = np.arange(silhouette.shape[0])[:, None] + corner[1]
    columns = np.arange(silhouette.shape[1])[None] + corner[0]
    inside = (rows >= 0) & (rows < CAMERA.height) & (columns >= 0) & (columns < CAMERA.width)
    return Annotation(
        obj_id=part.obj_id,
        stable_pose=placed[1],
        T_cam_part=T,
        corner=corner,
        silhouette=silhouette,
        visible=silhouette & inside,
        keypoints=np.zeros((8, 3)),
    )
