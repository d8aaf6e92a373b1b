"""Small data sets on disk, written as the generator writes them but of whatever a test asks for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cad.parts import Part
from cad.spatial import Array, Intrinsics
from scenes.bop import Annotation, ShardWriter, write_models


@dataclass
class Picture:
    """What is given to the writer for one image."""

    rgb: NDArray[np.uint8]
    intrinsics: Intrinsics
    T_cam_board: Array
    annotations: list[Annotation] = field(default_factory=list)
    depth_m: NDArray[np.float32] | None = None
    distortion: Array | None = None


def write_data_set(
    folder: Path, split: str, parts: Sequence[Part], pictures: Sequence[Picture], jpeg: int | None = None
) -> Path:
    """A finished data set of one shard."""
    shard = folder / split / "000000"
    writer = ShardWriter(shard, 0, parts, with_depth=any(p.depth_m is not None for p in pictures), jpeg=jpeg)
    for p in pictures:
        writer.add(p.rgb, p.intrinsics, p.T_cam_board, p.annotations, p.depth_m, p.distortion)
    writer.finish()
    write_models(folder, parts)
    (folder / "dataset.json").write_text(json.dumps({"split": split}))
    (folder / "manifest.json").write_text(json.dumps({"images": len(pictures)}))
    return folder


def patch(obj_id: int, stable_pose: int, T_cam_part: Array, x: int, y: int, size: int = 5) -> Annotation:
    """A part that is seen as a square of ``size`` pixels with its top left one at (x, y)."""
    square = np.ones((size, size), bool)
    return Annotation(
        obj_id=obj_id,
        stable_pose=stable_pose,
        T_cam_part=T_cam_part,
        corner=(x, y),
        silhouette=square,
        visible=square,
        keypoints=np.zeros((8, 3)),
    )
