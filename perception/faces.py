"""Faces: every stable pose of every part in one flat list, and which of them no overhead view can tell apart.

A *face* is the pair (part, stable pose) that the crop networks classify. Two placements look the same when their height
and normal maps, drawn from the CAD from straight above, differ over less than ``SAME_VIEW_MM2``. Labels are spread over
such equivalents in training, and evaluation counts them as right where it says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import BUILT_IN, Part, StablePose, load_part
from cad.spatial import Array, apply, rotation_angle, rotation_z, wrap_angle
from perception.estimates import PerceptionError
from perception.silhouette import rasterise, solid_of

SAME_VIEW_MM2 = 0.3
"""Area that must look different for two placements to be told apart (found by experiment at 67 um a pixel)."""

_SAME_REST = np.radians(0.5)
_PIXEL_M = 1e-4
_HEIGHT_STEP_M = 1.5e-4  # a height difference above this is seen
_NORMAL_COSINE = 0.94  # and so is a change of the surface normal by 20 degrees
_COARSE_STEP = np.radians(5.0)
_COARSE_LIMIT_MM2 = 6.0  # coarse minima above this are not worth refining: 2.5 degrees off costs about 2 mm^2


@dataclass(frozen=True, kw_only=True)
class Equivalent:
    """A placement that looks the same: face ``face`` with its yaw larger by ``yaw`` and its footprint's centre shifted
    by ``shift_m`` (2,), given in the table frame of the original at yaw 0.
    """

    face: int
    yaw: float
    shift_m: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Face:
    """One stable pose of one part. ``middle_m`` is half the height of the part at rest: labels and hypotheses speak of
    the footprint's centre at this height, because that is where the part's image is centred.
    """

    index: int
    part: Part
    stable_pose: StablePose
    middle_m: float


class FaceTable:
    """All faces of ``parts``, in the order of the parts and of their stable poses."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)
        faces: list[Face] = []
        for part in self.parts:
            if not part.stable_poses:
                raise PerceptionError(f"part {part.name!r} has no stable poses; compute stable_poses.json first")
            for pose in part.stable_poses:
                top = apply(pose.T_table_part, part.mesh.vertices)[:, 2].max()
                faces.append(Face(index=len(faces), part=part, stable_pose=pose, middle_m=float(top) / 2))
        self.faces = tuple(faces)
        self.part_of_face: NDArray[np.int64] = np.array([self.parts.index(face.part) for face in faces])
        self._index = {(face.part.name, face.stable_pose.index): face.index for face in faces}

    @classmethod
    def load(cls, names: Sequence[str] | None = None, parts_dir: Path | None = None) -> FaceTable:
        """The faces of the parts called ``names``, of the built-in ones by default."""
        return cls([load_part(name, parts_dir) for name in (names or BUILT_IN)])

    def __len__(self) -> int:
        return len(self.faces)

    def __getitem__(self, index: int) -> Face:
        return self.faces[index]

    def index_of(self, part: str, stable_pose: int) -> int:
        """Index of a face; raises PerceptionError with the faces there are."""
        if (part, stable_pose) not in self._index:
            known = ", ".join(f"{p.name} 0..{len(p.stable_poses) - 1}" for p in self.parts)
            raise PerceptionError(f"no face {part!r} with stable pose {stable_pose}; faces there are: {known}")
        return self._index[part, stable_pose]

    def describe(self) -> list[dict[str, Any]]:
        """What weight files say about the faces, so that ``check`` can tell whether they are still the same."""
        return [
            {
                "part": f.part.name,
                "stable_pose": f.stable_pose.index,
                "R_table_part": f.stable_pose.R_table_part.tolist(),
            }
            for f in self.faces
        ]

    def check(self, described: Sequence[dict[str, Any]], what: str) -> None:
        """Raise PerceptionError when ``described``, from the weight file ``what``, are not these faces."""
        ours = [(f.part.name, f.stable_pose.index) for f in self.faces]
        theirs = [(str(d["part"]), int(d["stable_pose"])) for d in described]
        same = ours == theirs and all(
            rotation_angle(f.stable_pose.R_table_part, np.array(d["R_table_part"])) < _SAME_REST
            for f, d in zip(self.faces, described, strict=True)
        )
        if not same:
            raise PerceptionError(
                f"{what} was trained for the faces {theirs}, the parts' stable poses now are {ours} or are turned "
                "otherwise: train again"
            )

    @cached_property
    def equivalents(self) -> tuple[tuple[Equivalent, ...], ...]:
        """For every face the placements that look the same as it at yaw 0, itself first; computed once from the CAD."""
        out: list[tuple[Equivalent, ...]] = []
        for part in self.parts:
            offset = len(out)
            for found in _part_equivalents(part):
                same = Equivalent(face=len(out), yaw=0.0, shift_m=(0.0, 0.0))
                others = (Equivalent(face=offset + e.face, yaw=e.yaw, shift_m=e.shift_m) for e in found)
                out.append((same, *others))
        return tuple(out)

    def same_view(self, face_a: int, yaw_a: float, face_b: int, yaw_b: float, tolerance: float) -> bool:
        """Whether face b at yaw b looks like face a at yaw a, yaw within ``tolerance`` rad."""
        return any(
            e.face == face_b and abs(float(wrap_angle(yaw_a + e.yaw - yaw_b))) <= tolerance
            for e in self.equivalents[face_a]
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class TopView:
    """Height (N, N) in metres (minus infinity off the part) and unit normal (N, N, 3) seen from straight above, rows
    along +y, columns along +x, centred on ``centroid`` (2,), the centroid of the silhouette.
    """

    height: Array
    normal: Array
    centroid: Array

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where the part is, (N, N)."""
        return np.isfinite(self.height)


def top_view(part: Part, pose: StablePose, size: int) -> TopView:
    """Orthographic view of a resting part, ``size`` pixels of 0.1 mm wide."""
    solid = solid_of(part)
    vertices = apply(pose.T_table_part, solid.vertices)
    normals = solid.normals @ pose.R_table_part.T
    up = np.flatnonzero(normals[:, 2] > 0.02)

    def draw(centre: Array) -> tuple[Array, NDArray[np.int64]]:
        uv = (vertices[:, :2] - centre) / _PIXEL_M + (size - 1) / 2
        return rasterise(uv, vertices[:, 2], solid.faces[up], size, size)

    _, seen = draw(np.zeros(2))
    rows, columns = np.nonzero(seen >= 0)
    centroid = (np.array([columns.mean(), rows.mean()]) - (size - 1) / 2) * _PIXEL_M
    height, seen = draw(centroid)
    normal = np.where((seen >= 0)[..., None], normals[up[np.maximum(seen, 0)]], 0.0)
    return TopView(height=height, normal=normal, centroid=centroid)


def view_difference_mm2(a: TopView, b: TopView, yaw: float) -> float:
    """Area that looks different between ``a`` and ``b`` turned by ``yaw`` rad about its centroid.

    Strips thinner than two pixels are left out: they come from sampling.
    """
    size = a.height.shape[0]
    grid = np.stack(np.meshgrid(*[np.arange(size) - (size - 1) / 2] * 2), axis=-1)  # (N, N, 2) as x, y
    source = grid @ rotation_z(yaw)[:2, :2] + (size - 1) / 2  # where each pixel comes from: turned back by yaw
    column, row = np.rint(source).astype(np.int64).transpose(2, 0, 1)
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    flat = np.where(inside, row * size + column, 0)
    height = np.where(inside, b.height.ravel()[flat], -np.inf)
    normal = b.normal.reshape(-1, 3)[flat] @ rotation_z(yaw).T
    mask_a, mask_b = a.mask, np.isfinite(height)
    both = mask_a & mask_b
    if not both.any():
        return float((mask_a | mask_b).sum() * _PIXEL_M**2 * 1e6)
    step = np.where(both, a.height, 0.0) - np.where(both, height, 0.0)
    step -= np.median(step[both])
    turned = (a.normal * normal).sum(axis=-1) < _NORMAL_COSINE
    differs = (mask_a ^ mask_b) | (both & ((np.abs(step) > _HEIGHT_STEP_M) | turned))
    thick = cv2.erode(differs.astype(np.uint8), np.ones((2, 2), np.uint8))
    return float(thick.sum() * _PIXEL_M**2 * 1e6)


@lru_cache(maxsize=64)
def _part_equivalents(part: Part) -> tuple[tuple[Equivalent, ...], ...]:
    """Per stable pose of ``part`` its equivalents other than itself, faces counted within the part."""
    radius = max(float(np.linalg.norm(v)) for v in part.mesh.bounding_box.vertices - part.mesh.bounds.mean(axis=0))
    size = int(np.ceil(2 * radius / _PIXEL_M)) + 8
    views = [top_view(part, pose, size) for pose in part.stable_poses]
    return tuple(
        tuple(e for j, b in enumerate(views) for e in _matches(a, b, j, same=i == j)) for i, a in enumerate(views)
    )


def _matches(a: TopView, b: TopView, face: int, same: bool) -> list[Equivalent]:
    """Yaws at which ``b`` looks like ``a``: local minima of a 5-degree sweep, refined to half a degree."""
    if abs(a.mask.sum() - b.mask.sum()) * _PIXEL_M**2 * 1e6 > _COARSE_LIMIT_MM2:
        return []
    yaws = np.arange(0.0, 2 * np.pi - 1e-9, _COARSE_STEP)
    coarse = np.array([view_difference_mm2(a, b, yaw) for yaw in yaws])
    minima = (coarse <= np.roll(coarse, 1)) & (coarse < np.roll(coarse, -1)) & (coarse < _COARSE_LIMIT_MM2)
    found: list[Equivalent] = []
    for yaw in yaws[minima]:
        near = yaw + np.radians(np.arange(-4.0, 4.1, 0.5))
        fine = np.array([view_difference_mm2(a, b, y) for y in near])
        # strips thinner than two pixels do not count, so a minimum is flat: take its middle
        best, yaw = float(fine.min()), float(near[fine == fine.min()].mean())
        if best >= SAME_VIEW_MM2 or (same and abs(float(wrap_angle(yaw))) < 2 * _COARSE_STEP):
            continue
        shift = a.centroid - rotation_z(yaw)[:2, :2] @ b.centroid
        found.append(Equivalent(face=face, yaw=float(wrap_angle(yaw)), shift_m=(float(shift[0]), float(shift[1]))))
    return found
