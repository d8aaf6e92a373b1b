"""What the crop networks are to say about a crop: face, yaw, footprint centre and keypoints, from its ground truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from cad.parts import planar
from cad.spatial import Array, Intrinsics, apply
from perception.augment import CROP_CENTRE, image_turn
from perception.dataset import CropSet
from perception.faces import Equivalent, Face, FaceTable

NO_FACE = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class CropLabels:
    """Labels of N crops, in pixels of the crop and rad.

    ``face`` (N,) index into the face table, -1 where there is no part; ``yaw`` (N,); ``centre`` (N, 2) pixel of the
    footprint's centre at the part's middle height; ``ray`` (N, 2) direction x/z, y/z in ``cam`` of the crop's centre;
    ``keypoints`` (N, A, K, 2), one alternative for each yaw at which the same face looks the same (the true one first,
    repeated where there are fewer than A).
    """

    face: NDArray[np.int64]
    yaw: Array
    centre: Array
    ray: Array
    keypoints: Array

    def __len__(self) -> int:
        return len(self.face)

    @property
    def has_part(self) -> NDArray[np.bool_]:
        """(N,) whether there is a part to find."""
        return self.face != NO_FACE

    def take(self, rows: NDArray[np.int64]) -> CropLabels:
        """The labels of some crops."""
        return CropLabels(
            face=self.face[rows],
            yaw=self.yaw[rows],
            centre=self.centre[rows],
            ray=self.ray[rows],
            keypoints=self.keypoints[rows],
        )

    def warped(self, warps: Array, angles: Array) -> CropLabels:
        """The labels after crop i was moved by ``warps[i]`` (2, 3), which turns it by ``angles[i]``.

        A shift of a few pixels changes the ray by less than 0.001, which is left out.
        """
        turns = np.stack([image_turn(a) for a in angles]) if len(angles) else np.zeros((0, 2, 2))
        return CropLabels(
            face=self.face,
            yaw=self.yaw + angles,
            centre=np.einsum("nij,nj->ni", warps[:, :, :2], self.centre) + warps[:, :, 2],
            ray=np.einsum("nij,nj->ni", turns, self.ray),
            keypoints=np.einsum("nij,nakj->naki", warps[:, :, :2], self.keypoints) + warps[:, None, None, :, 2],
        )


def ray_of_crop(intrinsics: Intrinsics) -> Array:
    """Direction (2,) x/z, y/z in ``cam`` through the centre of the crop with these ``intrinsics``."""
    return intrinsics.rays([CROP_CENTRE, CROP_CENTRE])[:2]


def alternatives(table: FaceTable, face: int) -> list[Equivalent]:
    """The placements of the same face that look the same, itself first."""
    return [e for e in table.equivalents[face] if e.face == face]


def keypoint_pixels(
    face: Face, x: float, y: float, yaw: float, equivalent: Equivalent, T_cam_table: Array, intrinsics: Intrinsics
) -> Array:
    """Pixels (K, 2) of the keypoints of the placement that looks like ``face`` at (x, y, yaw)."""
    placed = planar(x, y, yaw) @ planar(*equivalent.shift_m, equivalent.yaw) @ face.stable_pose.T_table_part
    return intrinsics.project(apply(T_cam_table @ placed, face.part.keypoints))


def label_crops(table: FaceTable, crops: CropSet) -> CropLabels:
    """Labels of rendered crops from their ground truth.

    Raises PerceptionError for an obj_id or a stable pose that is none of the table's.
    """
    truth = crops.labels(table.parts)
    n, size = len(crops), crops.images.shape[2]
    choices = [alternatives(table, face) for face in range(len(table))]
    most, n_keypoints = max(map(len, choices)), len(table.parts[0].keypoints)
    face, keypoints, ray = np.full(n, NO_FACE, dtype=np.int64), np.zeros((n, most, n_keypoints, 2)), np.zeros((n, 2))
    for i, K in enumerate(crops.K):
        camera = Intrinsics(width=size, height=size, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
        ray[i] = ray_of_crop(camera)
        if truth.part_index[i] < 0:
            continue
        face[i] = table.index_of(table.parts[truth.part_index[i]].name, int(crops.stable_pose[i]))
        resting = float(truth.x[i]), float(truth.y[i]), float(truth.yaw[i])
        same = choices[face[i]]
        for a in range(most):
            alternative = same[a] if a < len(same) else same[0]
            keypoints[i, a] = keypoint_pixels(table[int(face[i])], *resting, alternative, truth.T_cam_table[i], camera)
    return CropLabels(
        face=face,
        yaw=np.where(face >= 0, truth.yaw, 0.0),
        centre=np.where((face >= 0)[:, None], truth.body_px, CROP_CENTRE),
        ray=ray,
        keypoints=keypoints,
    )


def take_crops(crops: CropSet, rows: NDArray[np.int64]) -> CropSet:
    """Some of the crops."""
    return CropSet(**{f.name: getattr(crops, f.name)[rows] for f in fields(CropSet)})
