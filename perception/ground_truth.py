"""What a rendered frame really shows, for evaluation: its parts' poses, visible masks and places on the board."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import Part, load_part
from cad.run_lengths import RunLengths
from cad.spatial import Array, Intrinsics, apply, inverse
from perception.bop_files import DATASET, Entry, manifest_hash, read_entries, read_json
from perception.estimates import Frame, PerceptionError
from perception.outcomes import WHOLE_SHARE

COCO_FILE = "scene_gt_coco.json"
IMAGES_A_SCENE = 1000
"""BOP's number of images a folder: an image's number in a data set is 1000 times its folder's plus its own."""
_SURROUNDINGS_PX = 256


def centre_of(part: Part, T: Array) -> Array:
    """Centre (3,) of the part's bounding box in the frame that ``T`` (4, 4) maps the part to."""
    return apply(T, part.mesh.bounds.mean(axis=0))


@dataclass(frozen=True, kw_only=True, eq=False)
class TruePart:
    """A part in a frame: its number there, pose, visible pixels, share of its silhouette that is visible, and whether
    it is whole: at least 60 % visible and not cut by the image's border.
    """

    number: int
    part: Part
    stable_pose: int
    T_cam_part: Array
    runs: RunLengths
    visible_share: float
    whole: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameTruth:
    """An image of a data set: its number there, folder and number in the folder, camera and parts."""

    image: int
    entry: Entry
    intrinsics: Intrinsics
    parts: tuple[TruePart, ...]

    @cached_property
    def T_cam_board(self) -> Array:
        """(4, 4), as rendered."""
        return self.entry.T_cam_board

    def frame(self) -> Frame:
        """The image as a camera gives it."""
        return Frame(image=np.ascontiguousarray(self.entry.image()), intrinsics=self.intrinsics, time_s=0.0)

    def on_board_mm(self, point_cam: Array) -> tuple[float, float]:
        """Where a point (3,) of ``cam`` is on the board, x and y in mm."""
        x, y, _ = 1e3 * apply(inverse(self.T_cam_board), point_cam)
        return float(x), float(y)

    def brightness(self, image: NDArray[np.uint8], point_cam: Array) -> float:
        """Mean grey level of the 256 x 256 pixels of ``image`` (H, W, 3) round the picture of a point (3,) of ``cam``,
        or of those nearest to it when some lie outside of the image.
        """
        corner = np.round(self.intrinsics.project(point_cam)) - _SURROUNDINGS_PX // 2
        u, v = np.clip(corner, 0, np.maximum(np.array(image.shape[1::-1]) - _SURROUNDINGS_PX, 0)).astype(int)
        window = image[v : v + _SURROUNDINGS_PX, u : u + _SURROUNDINGS_PX]
        return float(cv2.cvtColor(window, cv2.COLOR_RGB2GRAY).mean())


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundTruth:
    """A finished data set of frames or windows: how it was made (``dataset.json``), the hash of its manifest, the parts
    that may be in it and its frames in order.
    """

    dataset: Mapping[str, Any]
    manifest: str
    parts: tuple[Part, ...]
    frames: tuple[FrameTruth, ...]

    @property
    def domain(self) -> str:
        """classic, filament or mitsuba."""
        return str(self.dataset["domain"])

    @property
    def n_parts(self) -> int:
        """Parts that are whole: those that count."""
        return sum(part.whole for frame in self.frames for part in frame.parts)


def read_ground_truth(data_dir: Path, parts_dir: Path | None = None) -> GroundTruth:
    """The images of a finished data set.

    Raises PerceptionError when it is not finished, or was rendered with other meshes than the parts have now.
    """
    entries = read_entries(data_dir)
    dataset = read_json(data_dir / DATASET)
    parts = tuple(load_part(name, parts_dir) for name in dataset["parts"])
    for part in parts:
        rendered = dataset["parts"][part.name]["mesh"]
        if rendered != part.mesh_hash:
            raise PerceptionError(
                f"{data_dir} was rendered with mesh {rendered} of {part.name}, the part now has {part.mesh_hash}: "
                "render the data set again"
            )
    by_id = {part.obj_id: part for part in parts}
    size = (int(dataset["size"][0]), int(dataset["size"][1]))
    runs = {shard: _visible_runs(shard) for shard in {entry.shard for entry in entries}}
    frames = tuple(_frame(entry, by_id, size, runs[entry.shard]) for entry in entries)
    return GroundTruth(
        dataset=dataset,
        manifest=manifest_hash(data_dir),
        parts=parts,
        frames=frames,
    )


def cut_by_border(bbox: list[int], width: int, height: int) -> bool:
    """Whether a silhouette with BOP's box (x, y, last x - x, last y - y) touches the border of the image, or passes."""
    x, y, w, h = bbox
    return x <= 0 or y <= 0 or x + w >= width - 1 or y + h >= height - 1


def _visible_runs(shard: Path) -> dict[tuple[int, int], RunLengths]:
    """Visible masks by (image's number in the folder, part's number in the image)."""
    content = read_json(shard / COCO_FILE)
    return {(a["image_id"] % IMAGES_A_SCENE, a["gt_id"]): a["segmentation"] for a in content["annotations"]}


def _frame(
    entry: Entry, parts: Mapping[int, Part], size: tuple[int, int], runs: Mapping[tuple[int, int], RunLengths]
) -> FrameTruth:
    width, height = size
    K = entry.K
    found = []
    for k, (number, truth, info) in enumerate(zip(entry.places, entry.instances, entry.infos, strict=True)):
        if truth["obj_id"] not in parts:
            raise PerceptionError(
                f"image {entry.image_id} of {entry.shard} shows obj_id {truth['obj_id']}, which dataset.json does not "
                "list: render the data set again"
            )
        if (entry.image_id, number) not in runs:
            raise PerceptionError(
                f"{entry.shard / COCO_FILE} lacks part {number} of image {entry.image_id}: render the data set again"
            )
        share = float(info["visib_fract"])
        found.append(
            TruePart(
                number=number,
                part=parts[truth["obj_id"]],
                stable_pose=int(truth["stable_pose"]),
                T_cam_part=entry.T_cam_part(k),
                runs=runs[entry.image_id, number],
                visible_share=share,
                whole=share >= WHOLE_SHARE and not cut_by_border(info["bbox_obj"], width, height),
            )
        )
    return FrameTruth(
        image=int(entry.shard.name) * IMAGES_A_SCENE + entry.image_id,
        entry=entry,
        intrinsics=Intrinsics(width=width, height=height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]),
        parts=tuple(found),
    )
