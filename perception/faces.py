"""Faces: every stable pose of every part in one flat list, and which of them no overhead view can tell apart.

A *face* is the pair (part, stable pose) that the crop networks classify. Which placements look the same from above is
stored with a part's stable poses (``perception.view_equivalence`` finds it). Labels are spread over such equivalents in
training, and evaluation counts them as right where it says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.parts import BUILT_IN, Part, StablePose, load_part
from cad.spatial import apply, rotation_angle, wrap_angle
from perception.estimates import PerceptionError

_SAME_REST = np.radians(0.5)


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
        """For every face the placements that look the same as it at yaw 0, itself first.

        Raises PerceptionError naming the command when a part's folder does not say which.
        """
        out: list[tuple[Equivalent, ...]] = []
        for part in self.parts:
            offset = len(out)
            for pose in part.stable_poses:
                if pose.view_equivalents is None:
                    raise PerceptionError(
                        f"{part.folder / 'stable_poses.json'} does not say which poses look alike; run "
                        f"`tagcell part stable-poses {part.name} --write`"
                    )
                same = Equivalent(face=len(out), yaw=0.0, shift_m=(0.0, 0.0))
                others = (
                    Equivalent(face=offset + e.stable_pose, yaw=e.yaw, shift_m=e.shift_m) for e in pose.view_equivalents
                )
                out.append((same, *others))
        return tuple(out)

    def same_view(self, face_a: int, yaw_a: float, face_b: int, yaw_b: float, tolerance: float) -> bool:
        """Whether face b at yaw b looks like face a at yaw a, yaw within ``tolerance`` rad."""
        return any(
            e.face == face_b and abs(float(wrap_angle(yaw_a + e.yaw - yaw_b))) <= tolerance
            for e in self.equivalents[face_a]
        )
