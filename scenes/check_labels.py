"""Checks one folder of a BOP data set: its JSON files against BOP's format, units, and the image files they name."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenes.bop import DEPTH_SCALE, NO_BOX
from scenes.check_models import Models, is_rigid, numbers
from scenes.coco import LARGEST
from scenes.findings import Findings

DISTANCE_MM = (5.0, 1e5)
"""From the camera to an object: outside of this the numbers are in another unit."""
FORMAT = "write it as BOP's format has it (docs/data.md)"
UNITS = "write translations in millimetres"
COLOURS = ("rgb", "gray")
IMAGE_TYPES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_COUNTS = ("px_count_all", "px_count_valid", "px_count_visib")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A folder's JSON entries that are well formed, by image id; ``infos``, ``colours`` and ``coco`` may lack some.

    ``colours`` are the files that images are in, ``coco`` the annotations by image id and number of the object.
    """

    folder: Path
    cameras: dict[str, dict[str, Any]]
    truths: dict[str, list[dict[str, Any]]]
    infos: dict[str, list[dict[str, Any]]]
    colours: dict[str, Path]
    coco: dict[tuple[str, int], dict[str, Any]] = field(default_factory=dict)


def check_scene(folder: Path, models: Models, findings: Findings) -> Scene | None:
    """Check a folder and return what of it can be used, None where its JSON files cannot be read."""
    cameras = findings.read_json(folder / "scene_camera.json", FORMAT)
    truths = findings.read_json(folder / "scene_gt.json", FORMAT)
    if cameras is None or truths is None:
        return None
    has_infos = (folder / "scene_gt_info.json").exists() or (findings.root / "dataset.json").exists()
    infos = findings.read_json(folder / "scene_gt_info.json", FORMAT) if has_infos else None
    if len(cameras) > LARGEST:
        findings.add(folder / "scene_camera.json", f"{len(cameras)} images: BOP has at most {LARGEST} a folder", FORMAT)
    for name, content in (("scene_gt", truths), ("scene_gt_info", infos)):
        for image in sorted(set(cameras) ^ set(content if content is not None else cameras)):
            lacking = name if image in cameras else "scene_camera"
            findings.add(folder / f"{lacking}.json", "has no entry for an image that others have", FORMAT, image)
    good = [i for i in cameras if i in truths and _good_camera(folder, i, cameras[i], findings)]
    scene = Scene(
        folder=folder,
        cameras={i: cameras[i] for i in good},
        truths={i: truths[i] for i in good if _good_truths(folder, i, truths[i], models, findings)},
        infos={},
        colours=_check_files(folder, sorted(cameras, key=_number), truths, findings),
    )
    for i in scene.truths:
        if infos is not None and i in infos and _good_infos(folder, i, infos[i], len(scene.truths[i]), findings):
            scene.infos[i] = infos[i]
    for i in set(scene.cameras) - set(scene.truths):
        del scene.cameras[i]
    return scene


def _good_camera(folder: Path, image: str, camera: Any, findings: Findings) -> bool:
    path = folder / "scene_camera.json"
    if not image.isdigit() or not isinstance(camera, dict):
        findings.add(path, "is no image id with its camera", FORMAT, image)
        return False
    K = numbers(camera.get("cam_K"), 9)
    if K is None or not (K[0] > 0 and K[4] > 0) or K[[3, 6, 7]].any() or K[8] != 1:
        findings.add(path, "cam_K is no camera matrix of 9 numbers, row by row", FORMAT, image)
        return False
    scale = camera.get("depth_scale", 1.0)
    if not isinstance(scale, int | float) or not 1e-4 <= scale <= 100:
        findings.add(
            path, f"depth_scale {scale!r} is not the millimetres of a unit of depth, like {DEPTH_SCALE}", FORMAT, image
        )
        return False
    if ("cam_R_w2c" in camera) != ("cam_t_w2c" in camera):
        findings.add(path, "has one of cam_R_w2c and cam_t_w2c without the other", FORMAT, image)
    elif "cam_R_w2c" in camera:
        _pose_is_good(path, image, camera, "cam_R_w2c", "cam_t_w2c", findings)
    if "cam_dist" in camera and not any(numbers(camera["cam_dist"], n) is not None for n in (4, 5)):
        findings.add(path, "cam_dist is not 4 or 5 numbers (k1, k2, p1, p2, k3)", FORMAT, image)
        return False
    return True


def _good_truths(folder: Path, image: str, truths: Any, models: Models, findings: Findings) -> bool:
    path, good = folder / "scene_gt.json", True
    if not isinstance(truths, list) or not all(isinstance(truth, dict) for truth in truths):
        findings.add(path, "is no list of objects", FORMAT, image)
        return False
    for truth in truths:
        obj_id = truth.get("obj_id")
        if not isinstance(obj_id, int):
            findings.add(path, f"obj_id {obj_id!r} is no whole number", FORMAT, image)
            good = False
        elif obj_id not in models.diameters:
            known = ", ".join(map(str, models.diameters)) or "none"
            findings.add(path, f"obj_id {obj_id} is none of the models ({known})", "add its model", image)
        if not _pose_is_good(path, image, truth, "cam_R_m2c", "cam_t_m2c", findings):
            good = False
        elif truth["cam_t_m2c"][2] <= 0:
            findings.add(path, f"cam_t_m2c {truth['cam_t_m2c']} is behind the camera", FORMAT, image)
        elif np.linalg.norm(truth["cam_t_m2c"]) < models.diameters.get(obj_id, 0.0) / 2:
            findings.add(path, f"object {obj_id} is larger than its distance from the camera", UNITS, image)
        face = truth.get("stable_pose", 0)
        if not isinstance(face, int) or face < -1:
            findings.add(path, f"stable_pose {face!r} is no face, nor -1 for none", FORMAT, image)
    return good


def _pose_is_good(
    path: Path, image: str, entry: dict[str, Any], rotation: str, translation: str, findings: Findings
) -> bool:
    R, t = numbers(entry.get(rotation), 9), numbers(entry.get(translation), 3)
    if R is None or t is None:
        findings.add(path, f"{rotation} and {translation} are not 9 and 3 numbers", FORMAT, image)
        return False
    if not is_rigid(R.reshape(3, 3)):
        findings.add(path, f"{rotation} is no rotation: not orthonormal, or mirrored", FORMAT, image)
    distance = float(np.linalg.norm(t))
    if not DISTANCE_MM[0] <= distance <= DISTANCE_MM[1]:
        unit = "metres" if distance < DISTANCE_MM[0] else "micrometres"
        findings.add(path, f"{translation} is {distance:.4g} mm long: it seems to be in {unit}", UNITS, image)
    return True


def _good_infos(folder: Path, image: str, infos: Any, expected: int, findings: Findings) -> bool:
    path = folder / "scene_gt_info.json"
    if not isinstance(infos, list) or len(infos) != expected or not all(isinstance(info, dict) for info in infos):
        findings.add(path, f"is not the facts of the {expected} objects that scene_gt.json lists", FORMAT, image)
        return False
    for k, info in enumerate(infos):
        counts = [info.get(name) for name in _COUNTS]
        boxes = [numbers(info.get(name), 4) for name in ("bbox_obj", "bbox_visib")]
        share = info.get("visib_fract")
        if not all(isinstance(c, int) and c >= 0 for c in counts) or not isinstance(share, int | float):
            findings.add(path, f"object {k} lacks {', '.join(_COUNTS)} (whole numbers) or visib_fract", FORMAT, image)
            return False
        if any(box is None for box in boxes):
            findings.add(path, f"object {k} lacks bbox_obj or bbox_visib of 4 numbers", FORMAT, image)
            return False
        whole, valid, visible = counts
        if visible > whole or valid > whole:
            findings.add(path, f"object {k}: {visible} visible or {valid} valid of {whole} pixels", FORMAT, image)
        if abs(share - visible / max(whole, 1)) > 2e-3:
            findings.add(path, f"object {k}: visib_fract {share:.4f} is not {visible} / {whole}", FORMAT, image)
        if (visible == 0) != (tuple(info["bbox_visib"]) == NO_BOX):
            findings.add(
                path, f"object {k}: bbox_visib {info['bbox_visib']} with {visible} visible pixels", FORMAT, image
            )
    return True


def _check_files(folder: Path, images: list[str], truths: dict[str, Any], findings: Findings) -> dict[str, Path]:
    """Whether there is one file for each image and each mask, and none besides; returns the images' files."""
    colours: dict[str, Path] = {}
    places = [folder / name for name in COLOURS if (folder / name).is_dir()]
    if not places:
        findings.add(folder / "rgb", "is missing", "add the images")
    counts = {i: len(truths[i]) if isinstance(truths.get(i), list) else 0 for i in images}
    masks = {f"{_number(i):06d}_{k:06d}" for i in images for k in range(counts[i])}
    stems = {f"{_number(i):06d}": i for i in images}
    for name in (*COLOURS, "depth", "mask", "mask_visib"):
        if not (folder / name).is_dir():
            continue
        expected = masks if name.startswith("mask") else set(stems)
        there = {path.stem: path for path in (folder / name).iterdir()}
        for stem in sorted(expected - set(there)):
            findings.add(folder / name, f"{stem} is missing", "add the file, or leave the label out", stem[:6])
        for stem in sorted(set(there) - expected):
            findings.add(folder / name, f"{there[stem].name} belongs to no label", "delete the file", stem[:6])
        for stem in sorted(stem for stem in expected & set(there) if there[stem].suffix not in IMAGE_TYPES):
            findings.add(there[stem], "is no image file", f"use one of {', '.join(IMAGE_TYPES)}", stem[:6])
        if name in COLOURS:
            colours |= {stems[stem]: path for stem, path in there.items() if stem in stems}
    return colours


def _number(image: str) -> int:
    return int(image) if image.isdigit() else -1
