"""Data sets on disk in BOP's layout (bop.felk.cvut.cz): folders of images with their labels, and the models.

World = ``board``. BOP stores millimetres; ``cam_R_m2c`` and ``cam_t_m2c`` are ``T_cam_part``. Boxes are as BOP's
toolkit computes them: width and height are the differences between the last and the first column and row. Two keys are
our own in ``scene_camera.json``, written only where they say something: ``cam_dist``, OpenCV's distortion coefficients,
and ``gamma``, the camera's; one in ``scene_gt.json``: ``stable_pose``, the index of the face that the part rests on.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cad.equivalence import symmetries_to_json
from cad.parts import Part
from cad.spatial import Array, Intrinsics
from scenes.coco import CocoScene
from scenes.errors import SceneError
from scenes.png import encode_png

DEPTH_SCALE = 0.02
"""Millimetres a unit of the 16-bit depth images: steps of 20 um up to 1.3 m."""
DEPTH_REACH_M = 65535 * DEPTH_SCALE / 1e3
"""What is farther than this has no depth in the images."""
MASKS = ("mask", "mask_visib")
NO_BOX = (-1, -1, -1, -1)
PART_SIZE_M = (5e-4, 1.0)
"""What a part's diameter can be: anything else was read in the wrong unit."""

Box = tuple[int, int, int, int]


@dataclass(frozen=True, kw_only=True, eq=False)
class Annotation:
    """One part in one image.

    ``silhouette`` (h, w) bool is all of it, as if nothing hid it, in a window whose top left pixel is ``corner`` (x, y)
    of the image and which may reach beyond it; ``visible`` (h, w) bool are the pixels that show it. ``keypoints``
    (K, 3): pixel u, v, and 2 where it is seen, 1 where something hides it or it is beyond the image. ``stable_pose``
    is the face that it rests on, -1 when it leans.
    """

    obj_id: int
    stable_pose: int
    T_cam_part: Array
    corner: tuple[int, int]
    silhouette: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    keypoints: Array = field(default_factory=lambda: np.empty((0, 3)))

    def mask(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The silhouette within an image of ``shape`` (H, W)."""
        return self._placed(self.silhouette, shape)

    def mask_visible(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """The visible pixels in an image of ``shape`` (H, W)."""
        return self._placed(self.visible, shape)

    def _placed(self, window: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
        (x, y), (h, w), out = self.corner, window.shape, np.zeros(shape, bool)
        inside = window[max(0, -y) : max(0, shape[0] - y), max(0, -x) : max(0, shape[1] - x)]
        if inside.size:
            out[max(0, y) : y + h, max(0, x) : x + w] = inside
        return out


class ShardWriter:
    """Writes the images of one folder as they come, and its JSON files with ``finish``.

    ``scene_id`` is the folder's number; ``jpeg`` the quality of the colour files, None for PNG. Raises SceneError when
    the folder cannot be written.
    """

    def __init__(
        self, folder: Path, scene_id: int, parts: Sequence[Part], *, with_depth: bool = False, jpeg: int | None = None
    ) -> None:
        self._folder, self._jpeg, self._with_depth = folder, jpeg, with_depth
        self._cameras: dict[str, Any] = {}
        self._truths: dict[str, Any] = {}
        self._infos: dict[str, Any] = {}
        self._coco = CocoScene(scene_id, parts)
        try:
            for name in ("rgb", *MASKS, *(("depth",) if with_depth else ())):
                (folder / name).mkdir(parents=True)
        except OSError as error:
            raise SceneError(f"cannot write into {folder}: {error}") from error

    def add(
        self,
        rgb: NDArray[np.uint8],
        intrinsics: Intrinsics,
        T_cam_board: Array,
        annotations: Sequence[Annotation],
        depth_m: NDArray[np.float32] | None = None,
        distortion: ArrayLike = (),
        gamma: float = 1.0,
    ) -> None:
        """Append an image (H, W, 3) with its camera and its parts in order.

        ``distortion`` are OpenCV's coefficients k1, k2, p1, p2; grey levels go with the light to the power ``gamma``.
        """
        image = len(self._cameras)
        shape = rgb.shape[:2]
        units = None if depth_m is None else depth_units(depth_m)
        name = f"rgb/{image:06d}.{'png' if self._jpeg is None else 'jpg'}"
        self._write(name, encode_png(rgb) if self._jpeg is None else _jpeg(rgb, self._jpeg))
        if self._with_depth:
            assert units is not None
            self._write(f"depth/{image:06d}.png", encode_png(units))
        self._coco.add_image(image, name, shape)
        infos = []
        for k, annotation in enumerate(annotations):
            whole, visible = annotation.mask(shape), annotation.mask_visible(shape)
            encoded = encode_png(visible)
            same = np.array_equal(annotation.silhouette, annotation.visible)
            self._write(f"mask_visib/{image:06d}_{k:06d}.png", encoded)
            self._write(f"mask/{image:06d}_{k:06d}.png", encoded if same else encode_png(whole))
            info = _info(annotation, int(np.count_nonzero(whole if units is None else whole & (units > 0))))
            infos.append(info)
            if info["px_count_visib"]:
                self._coco.add_part(
                    image,
                    k,
                    obj_id=annotation.obj_id,
                    visible=annotation.visible,
                    corner=annotation.corner,
                    box=_closed(mask_box(whole)),
                    visib_fract=info["visib_fract"],
                    keypoints=annotation.keypoints,
                )
        self._cameras[str(image)] = _camera(intrinsics, T_cam_board, distortion, gamma)
        self._truths[str(image)] = [_truth(a) for a in annotations]
        self._infos[str(image)] = infos

    def finish(self) -> None:
        """Write the JSON files."""
        for name, content in (
            ("scene_camera", self._cameras),
            ("scene_gt", self._truths),
            ("scene_gt_info", self._infos),
            ("scene_gt_coco", self._coco.content()),
        ):
            self._write(f"{name}.json", json.dumps(content).encode())

    def _write(self, name: str, content: bytes) -> None:
        try:
            (self._folder / name).write_bytes(content)
        except OSError as error:
            raise SceneError(f"cannot write {self._folder / name}: {error}") from error


def write_models(folder: Path, parts: Sequence[Part]) -> None:
    """Write BOP's ``models`` folder in millimetres: meshes, ``models_info.json`` with the parts' symmetries, keypoints.

    Raises SceneError for a part whose size says that its mesh is not in metres.
    """
    models = folder / "models"
    models.mkdir(parents=True, exist_ok=True)
    infos, keypoints = {}, {}
    for part in parts:
        check_part_size(part)
        mesh = part.mesh.copy()
        mesh.apply_scale(1e3)
        mesh.export(models / f"obj_{part.obj_id:06d}.ply", vertex_normal=True, encoding="ascii")
        low, size = mesh.bounds[0], mesh.extents
        info: dict[str, Any] = {"diameter": round(part.diameter_m * 1e3, 6)}
        info |= {f"min_{axis}": round(float(low[i]), 6) for i, axis in enumerate("xyz")}
        info |= {f"size_{axis}": round(float(size[i]), 6) for i, axis in enumerate("xyz")}
        info |= {key: value for key, value in symmetries_to_json(part.symmetries).items() if value}
        infos[str(part.obj_id)] = info
        keypoints[str(part.obj_id)] = {"name": part.name, "keypoints": (part.keypoints * 1e3).round(6).tolist()}
    (models / "models_info.json").write_text(json.dumps(infos, indent=1))
    (models / "keypoints.json").write_text(json.dumps(keypoints, indent=1))


def write_camera(folder: Path, intrinsics: Intrinsics) -> None:
    """Write BOP's ``camera.json``: the whole frame's camera; what counts for an image is its ``scene_camera`` entry."""
    content = {"cx": intrinsics.cx, "cy": intrinsics.cy, "fx": intrinsics.fx, "fy": intrinsics.fy}
    content |= {"width": intrinsics.width, "height": intrinsics.height, "depth_scale": DEPTH_SCALE}
    (folder / "camera.json").write_text(json.dumps(content, indent=1))


def check_part_size(part: Part) -> None:
    """Raise SceneError unless a part is as large as a part in metres can be."""
    if not PART_SIZE_M[0] <= part.diameter_m <= PART_SIZE_M[1]:
        unit = "millimetres" if part.diameter_m > PART_SIZE_M[1] else "metres taken for millimetres"
        raise SceneError(
            f"part {part.name!r} measures {part.diameter_m:g} m, outside {PART_SIZE_M[0]:g} to {PART_SIZE_M[1]:g} m: "
            f"its mesh seems to be in {unit}; take the part in again with the right unit"
        )


def depth_units(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """16-bit depth (H, W) in steps of DEPTH_SCALE mm; 0, which is no measurement, where it is too far to be told."""
    units = depth_m * np.float32(1e3 / DEPTH_SCALE)
    np.rint(units, out=units)
    units[units >= 65536] = 0
    return units.astype(np.uint16)


def mask_box(mask: NDArray[np.bool_], corner: tuple[int, int] = (0, 0)) -> Box:
    """BOP's box (x, y, w, h) round the true pixels of a mask whose top left pixel is ``corner``; all -1 if none is."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(columns):
        return NO_BOX
    x, y = int(columns[0]), int(rows[0])
    return x + corner[0], y + corner[1], int(columns[-1]) - x, int(rows[-1]) - y


def _camera(intrinsics: Intrinsics, T_cam_board: Array, distortion: ArrayLike, gamma: float) -> dict[str, Any]:
    camera = {
        "cam_K": intrinsics.matrix.ravel().tolist(),
        "depth_scale": DEPTH_SCALE,
        "cam_R_w2c": T_cam_board[:3, :3].ravel().tolist(),
        "cam_t_w2c": (T_cam_board[:3, 3] * 1e3).tolist(),
    }
    if np.any(distortion):
        camera["cam_dist"] = np.asarray(distortion, np.float64).ravel().tolist()
    if gamma != 1.0:
        camera["gamma"] = gamma
    return camera


def _truth(annotation: Annotation) -> dict[str, Any]:
    return {
        "cam_R_m2c": annotation.T_cam_part[:3, :3].ravel().tolist(),
        "cam_t_m2c": (annotation.T_cam_part[:3, 3] * 1e3).tolist(),
        "obj_id": annotation.obj_id,
        "stable_pose": annotation.stable_pose,
    }


def _info(annotation: Annotation, valid: int) -> dict[str, Any]:
    """Boxes and counts; a part that nothing is seen of has no box, as BOP's toolkit has it."""
    visible, whole = int(annotation.visible.sum()), int(annotation.silhouette.sum())
    return {
        "bbox_obj": list(mask_box(annotation.silhouette, annotation.corner) if visible else NO_BOX),
        "bbox_visib": list(mask_box(annotation.visible, annotation.corner)),
        "px_count_all": whole,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / max(whole, 1),
    }


def _closed(box: Box) -> Box:
    """COCO's box, which counts the last column and row, from BOP's."""
    return box[0], box[1], box[2] + 1, box[3] + 1


def _jpeg(rgb: NDArray[np.uint8], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()
