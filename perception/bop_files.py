"""Reads the files of a rendered data set: BOP layout, millimetres on disk, metres and OpenCV's camera in memory.

A data set is a folder with ``dataset.json``, which says how it was made and which split it is, ``manifest.json``,
which says that it is complete and how many images it has, and shards of images ``SPLIT/NNNNNN/``. What would be read
wrongly is refused: metres taken for millimetres, a lens that distorts, images that are missing.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cad.parts import hash_file
from cad.spatial import Array, transform
from perception.estimates import PerceptionError

DATASET, MANIFEST = "dataset.json", "manifest.json"
DISTANCE_MM = (5.0, 1e5)
"""From the camera to a part or to the board: outside of this the numbers are in another unit."""
DIAMETER_MM = (0.5, 1e3)
"""Of a part."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One image of a shard and what its JSON files say about it.

    ``instances`` are the entries of ``scene_gt.json`` of the parts of which something is seen, ``infos`` those of
    ``scene_gt_info.json``, ``places`` their numbers among all parts of the image, which name their masks.
    """

    shard: Path
    image_id: int
    camera: dict[str, Any]
    instances: list[dict[str, Any]]
    places: list[int]
    infos: list[dict[str, Any]]

    @property
    def K(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.reshape(self.camera["cam_K"], (3, 3)).astype(np.float64)

    @property
    def T_cam_board(self) -> Array:
        """(4, 4), metres."""
        return self._pose(self.camera, "cam_R_w2c", "cam_t_w2c")

    def T_cam_part(self, instance: int) -> Array:
        """(4, 4) of one of the ``instances``, metres."""
        return self._pose(self.instances[instance], "cam_R_m2c", "cam_t_m2c")

    def image(self) -> NDArray[np.uint8]:
        """Colours (H, W, 3) in the order red, green, blue, from a PNG or JPEG file."""
        for suffix in (".png", ".jpg"):
            path = self.shard / "rgb" / f"{self.image_id:06d}{suffix}"
            if path.exists():
                return _read_image(path, cv2.IMREAD_COLOR)[..., ::-1]
        raise PerceptionError(f"no image {self.image_id:06d}.png or .jpg in {self.shard / 'rgb'}")

    def mask(self, instance: int) -> NDArray[np.bool_]:
        """Visible pixels (H, W) of one of the ``instances``."""
        name = f"{self.image_id:06d}_{self.places[instance]:06d}.png"
        return _read_image(self.shard / "mask_visib" / name, cv2.IMREAD_GRAYSCALE) > 0

    def _pose(self, entry: dict[str, Any], rotation: str, translation: str) -> Array:
        t_mm = np.asarray(entry[translation], np.float64)
        distance = float(np.linalg.norm(t_mm))
        if not DISTANCE_MM[0] <= distance <= DISTANCE_MM[1]:
            unit = "metres" if distance < DISTANCE_MM[0] else "micrometres, or was scaled twice"
            raise PerceptionError(
                f"image {self.image_id} of {self.shard}: {translation} is {distance:g} mm long, outside "
                f"{DISTANCE_MM[0]:g} to {DISTANCE_MM[1]:g} mm; it seems to be in {unit}: BOP's unit is the millimetre"
            )
        return transform(np.reshape(entry[rotation], (3, 3)), t_mm / 1e3)


def manifest_hash(data_dir: Path) -> str:
    """Hash of a finished data set's manifest, which names the data in caches and weight files.

    Raises PerceptionError when the folder holds no data set or one that is not complete.
    """
    if not (data_dir / DATASET).exists():
        raise PerceptionError(f"no {DATASET} in {data_dir}: it is no rendered data set; render one there first")
    if not (data_dir / MANIFEST).exists():
        raise PerceptionError(f"no {MANIFEST} in {data_dir}: its rendering did not finish; run the same command again")
    return hash_file(data_dir / MANIFEST)


def read_entries(data_dir: Path) -> list[Entry]:
    """All images of a data set, in order.

    Raises PerceptionError when some are missing, or what the files say would be read wrongly.
    """
    manifest_hash(data_dir)
    dataset, manifest = read_json(data_dir / DATASET), read_json(data_dir / MANIFEST)
    _check_models(data_dir / "models" / "models_info.json")
    split = data_dir / dataset["split"]
    entries = [
        entry for shard in sorted(split.glob("*")) if re.fullmatch(r"\d{6}", shard.name) for entry in _read(shard)
    ]
    if len(entries) != manifest["images"]:
        raise PerceptionError(
            f"{split} holds {len(entries)} of the {manifest['images']} images that {MANIFEST} lists; render it again"
        )
    return entries


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; raises PerceptionError naming the file when it cannot be read."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise PerceptionError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise PerceptionError(f"{path} holds no JSON object; render the data set again")
    return content


def _read(shard: Path) -> list[Entry]:
    cameras, truths, infos = (
        read_json(shard / f"{name}.json") for name in ("scene_camera", "scene_gt", "scene_gt_info")
    )
    if not set(cameras) == set(truths) == set(infos):
        raise PerceptionError(
            f"{shard}: scene_camera.json has {len(cameras)} images, scene_gt.json {len(truths)}, scene_gt_info.json "
            f"{len(infos)}"
        )
    entries = []
    for image in sorted(cameras, key=int):
        if np.any(cameras[image].get("cam_dist", 0.0)):
            raise PerceptionError(
                f"image {image} of {shard} was taken through a lens that distorts (cam_dist): render without distortion"
            )
        if any("stable_pose" not in truth for truth in truths[image]):
            raise PerceptionError(
                f"image {image} of {shard} has parts with no stable_pose: only data sets that Tagcell made can be read"
            )
        places = [k for k, info in enumerate(infos[image]) if info["px_count_visib"] > 0]
        truth, info = ([of[image][k] for k in places] for of in (truths, infos))
        entries.append(Entry(shard, int(image), cameras[image], truth, places, info))
    return entries


def _check_models(path: Path) -> None:
    if not path.exists():
        return
    for obj_id, info in read_json(path).items():
        if not DIAMETER_MM[0] <= info["diameter"] <= DIAMETER_MM[1]:
            raise PerceptionError(
                f"{path}: the diameter of part {obj_id} is {info['diameter']:g}, outside {DIAMETER_MM[0]:g} to "
                f"{DIAMETER_MM[1]:g} mm: BOP's unit is the millimetre; write the models again"
            )


def _read_image(path: Path, flags: int) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise PerceptionError(f"{path} is missing or is no image")
    return np.asarray(image, np.uint8)
