"""Data sets on disk in BOP's layout: one folder a chunk of images, written aside and renamed when complete.

World = ``board``. BOP stores millimetres; ``cam_R_m2c`` and ``cam_t_m2c`` are ``T_cam_part``. Each annotation carries
one key more than BOP's own: ``stable_pose``, the index of the face that the part rests on.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cad.equivalence import symmetries_to_json
from cad.parts import Part
from cad.spatial import Array, Intrinsics
from scenes.errors import SceneError
from scenes.png import encode_png

DEPTH_SCALE = 0.02
"""Millimetres a unit of the 16-bit depth images: steps of 20 um up to 1.3 m."""
MASKS = ("mask", "mask_visib")


@dataclass(frozen=True, kw_only=True)
class Annotation:
    """One part in one image.

    ``mask`` (H, W) bool: its visible pixels. ``full_count`` and ``full_box`` (x, y, w, h): pixels and box of its whole
    silhouette, which may reach beyond the image.
    """

    obj_id: int
    stable_pose: int
    T_cam_part: Array
    mask: NDArray[np.bool_]
    full_count: int
    full_box: tuple[int, int, int, int]


class ChunkWriter:
    """Writes one chunk; nothing is visible under its final name before ``finish``."""

    def __init__(self, folder: Path, *, with_depth: bool = False) -> None:
        self._folder = folder
        self._aside = folder.with_name(f".{folder.name}.partial")
        shutil.rmtree(self._aside, ignore_errors=True)
        for name in ("rgb", *MASKS, *(("depth",) if with_depth else ())):
            (self._aside / name).mkdir(parents=True)
        self._cameras: dict[str, Any] = {}
        self._truths: dict[str, Any] = {}
        self._infos: dict[str, Any] = {}

    def add(
        self,
        rgb: NDArray[np.uint8],
        intrinsics: Intrinsics,
        T_cam_board: Array,
        annotations: Sequence[Annotation],
        depth_m: NDArray[np.float32] | None = None,
    ) -> None:
        """Append an image (H, W, 3) with its camera and its parts in order."""
        image = len(self._cameras)
        _write(self._aside / "rgb" / f"{image:06d}.png", rgb)
        if depth_m is not None:
            units = np.rint(depth_m * (1e3 / DEPTH_SCALE))
            _write(self._aside / "depth" / f"{image:06d}.png", np.where(units < 65536, units, 0).astype(np.uint16))
        for k, annotation in enumerate(annotations):
            encoded = encode_png(annotation.mask)
            for name in MASKS:
                (self._aside / name / f"{image:06d}_{k:06d}.png").write_bytes(encoded)
        self._cameras[str(image)] = {
            "cam_K": intrinsics.matrix.ravel().tolist(),
            "depth_scale": DEPTH_SCALE,
            "cam_R_w2c": T_cam_board[:3, :3].ravel().tolist(),
            "cam_t_w2c": (T_cam_board[:3, 3] * 1e3).tolist(),
        }
        self._truths[str(image)] = [_truth(a) for a in annotations]
        self._infos[str(image)] = [_info(a) for a in annotations]

    def finish(self) -> None:
        """Write the JSON files and give the chunk its name."""
        for name, content in (
            ("scene_camera", self._cameras),
            ("scene_gt", self._truths),
            ("scene_gt_info", self._infos),
        ):
            (self._aside / f"{name}.json").write_text(json.dumps(content))
        self._aside.rename(self._folder)


def write_models(folder: Path, parts: Sequence[Part]) -> None:
    """Write BOP's ``models`` folder: meshes in millimetres and ``models_info.json`` with the parts' symmetries."""
    models = folder / "models"
    models.mkdir(parents=True, exist_ok=True)
    infos = {}
    for part in parts:
        mesh = part.mesh.copy()
        mesh.apply_scale(1e3)
        mesh.export(models / f"obj_{part.obj_id:06d}.ply")
        low, size = mesh.bounds[0], mesh.extents
        info: dict[str, Any] = {"diameter": part.diameter_m * 1e3}
        info |= {f"min_{axis}": float(low[i]) for i, axis in enumerate("xyz")}
        info |= {f"size_{axis}": float(size[i]) for i, axis in enumerate("xyz")}
        info |= {key: value for key, value in symmetries_to_json(part.symmetries).items() if value}
        infos[str(part.obj_id)] = info
    (models / "models_info.json").write_text(json.dumps(infos, indent=1))


def annotation_box(mask: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """Smallest box (x, y, w, h) round the true pixels of a mask, (-1, -1, -1, -1) when there is none."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return -1, -1, -1, -1
    return int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)


def T_from_bop(R: Sequence[float], t_mm: Sequence[float]) -> Array:
    """(4, 4) in metres from BOP's nine row-major rotation entries and translation in millimetres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(R, (3, 3)), np.asarray(t_mm) / 1e3
    return T


def _truth(annotation: Annotation) -> dict[str, Any]:
    return {
        "cam_R_m2c": annotation.T_cam_part[:3, :3].ravel().tolist(),
        "cam_t_m2c": (annotation.T_cam_part[:3, 3] * 1e3).tolist(),
        "obj_id": annotation.obj_id,
        "stable_pose": annotation.stable_pose,
    }


def _info(annotation: Annotation) -> dict[str, Any]:
    visible = int(annotation.mask.sum())
    return {
        "bbox_obj": list(annotation.full_box),
        "bbox_visib": list(annotation_box(annotation.mask)),
        "px_count_all": annotation.full_count,
        "px_count_valid": visible,
        "px_count_visib": visible,
        "visib_fract": visible / max(annotation.full_count, 1),
    }


def _write(path: Path, image: NDArray[Any]) -> None:
    try:
        path.write_bytes(encode_png(image))
    except OSError as error:
        raise SceneError(f"cannot write {path}: {error}") from error
