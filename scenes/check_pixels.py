"""Compares the pixels of one image of a BOP data set with its labels: masks, counts, boxes, run lengths, depth, models.

Rays through pixel centres are cast at the models in the poses of the labels: what they hit is the silhouette and the
depth that should be there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pycocotools import mask as run_lengths

from cad.spatial import Array
from scenes.bop import MASKS, NO_BOX, mask_box
from scenes.check_labels import Scene
from scenes.check_models import Models
from scenes.findings import Findings

RAYS = 150
"""Cast for each part."""
DEPTH_MM = 0.5
WRONG_SHARE = 0.1
"""Rays that may disagree: at edges the nearest pixel centre decides."""
REDRAW = "draw the masks again from the poses"
DEPTHS = "write depth again, with depth_scale the millimetres of its unit"
POSES = "check unit, direction and frame of the poses: they map the model to OpenCV's camera"


def check_pixels(scene: Scene, image: str, models: Models, findings: Findings) -> None:
    """Check one image."""
    if image not in scene.colours:
        return
    path = scene.colours[image]
    colours = _read(path, findings, image)
    if colours is None:
        return
    shape = colours.shape[:2]
    camera, truths, infos = scene.cameras[image], scene.truths[image], scene.infos.get(image)
    if colours.dtype != np.uint8:
        findings.add(path, f"holds {colours.dtype}, not 8 bits", "write 8 bits a colour", image)
    depth = _depth(scene, image, shape, findings)
    seen = np.zeros(shape, np.int32)
    for k, truth in enumerate(truths):
        file = f"{int(image):06d}_{k:06d}.png"
        whole, visible = (_mask(scene.folder / name / file, shape, findings, image) for name in MASKS)
        if visible is None:
            continue
        seen += visible
        where = scene.folder / "mask_visib" / file
        if whole is not None and (visible & ~whole).any():
            count = int((visible & ~whole).sum())
            findings.add(where, f"shows {count} pixels that mask/ does not", REDRAW, image)
        if infos is not None:
            _check_info(scene, image, k, infos[k], whole, visible, findings)
        if (image, k) in scene.coco:
            _check_runs(scene.folder / "scene_gt_coco.json", scene.coco[image, k], visible, findings, image)
        mesh = models.mesh(truth["obj_id"])
        if mesh is not None:
            _check_model(scene, image, k, camera, truth, mesh, whole, visible, depth, findings)
    if any("stable_pose" in truth for truth in truths) and (seen > 1).any():
        findings.add(scene.folder / "mask_visib", f"{int((seen > 1).sum())} pixels show two parts", REDRAW, image)


def _read(path: Path, findings: Findings, image: str) -> NDArray[Any] | None:
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        findings.add(path, "is no image that can be read", "write it again", image)
    return picture


def _mask(path: Path, shape: Sequence[int], findings: Findings, image: str) -> NDArray[np.bool_] | None:
    mask = _read(path, findings, image) if path.exists() else None
    if mask is None:
        return None
    if mask.shape != tuple(shape) or mask.dtype != np.uint8 or not np.isin(mask, (0, 255)).all():
        findings.add(path, f"is {mask.dtype} {mask.shape}, not 8 bits of 0 and 255 and {tuple(shape)}", REDRAW, image)
        return None
    return mask > 0


def _depth(scene: Scene, image: str, shape: Sequence[int], findings: Findings) -> Array | None:
    """Depth (H, W) in millimetres, NaN where there is none."""
    path = scene.folder / "depth" / f"{int(image):06d}.png"
    stored = _read(path, findings, image) if path.exists() else None
    if stored is None:
        return None
    if stored.dtype != np.uint16 or stored.shape != tuple(shape):
        findings.add(path, f"is {stored.dtype} {stored.shape}, not 16 bits of {tuple(shape)}", DEPTHS, image)
        return None
    return np.where(stored > 0, stored * float(scene.cameras[image].get("depth_scale", 1.0)), np.nan)


def _check_info(
    scene: Scene,
    image: str,
    k: int,
    info: dict[str, Any],
    whole: NDArray[np.bool_] | None,
    visible: NDArray[np.bool_],
    findings: Findings,
) -> None:
    """Counts and boxes; a box's width may count its last column, as BOP's toolkit does not."""
    path = scene.folder / "scene_gt_info.json"
    if info["px_count_visib"] != visible.sum():
        findings.add(path, f"object {k}: px_count_visib {info['px_count_visib']}, mask {visible.sum()}", REDRAW, image)
    box = np.array(mask_box(visible))
    if not _same_box(np.array(info["bbox_visib"]), box):
        findings.add(path, f"object {k}: bbox_visib {info['bbox_visib']}, mask {box.tolist()}", REDRAW, image)
    if whole is None:
        return
    if info["px_count_all"] < whole.sum():
        findings.add(path, f"object {k}: px_count_all {info['px_count_all']}, mask {whole.sum()}", REDRAW, image)
    inside, told = np.array(mask_box(whole)), np.array(info["bbox_obj"])
    if inside[0] < 0 or told[0] == NO_BOX[0] == told[2]:
        return
    last = np.array(whole.shape[::-1]) - 1
    cut = (told[:2] < 0).any() or (told[:2] + told[2:] > last).any()
    holds = (told[:2] <= inside[:2]).all() and (told[:2] + told[2:] >= inside[:2] + inside[2:]).all()
    if not (holds if cut else _same_box(told, inside)):
        findings.add(path, f"object {k}: bbox_obj {told.tolist()}, mask {inside.tolist()}", REDRAW, image)


def _same_box(told: NDArray[Any], box: NDArray[Any]) -> bool:
    return bool((told[:2] == box[:2]).all() and np.isin(told[2:] - box[2:], (0, 1)).all())


def _check_runs(path: Path, entry: dict[str, Any], visible: NDArray[np.bool_], findings: Findings, image: str) -> None:
    runs = entry["segmentation"]
    if isinstance(runs["counts"], list):
        runs = run_lengths.frPyObjects(runs, *runs["size"])
    if not np.array_equal(run_lengths.decode(runs).astype(bool), visible):
        findings.add(path, f"annotation {entry['id']}: its runs are not mask_visib", REDRAW, image)


def _check_model(
    scene: Scene,
    image: str,
    k: int,
    camera: dict[str, Any],
    truth: dict[str, Any],
    mesh: trimesh.Trimesh,
    whole: NDArray[np.bool_] | None,
    visible: NDArray[np.bool_],
    depth: Array | None,
    findings: Findings,
) -> None:
    """Whether the model in its pose covers the mask and is where depth is."""
    mask = visible if whole is None else whole
    x, y, w, h = mask_box(mask)
    if w < 4 or h < 4:
        return
    rng = np.random.default_rng(k)
    low, high = np.maximum([x - 3, y - 3], 0), np.minimum([x + w + 4, y + h + 4], mask.shape[::-1])
    pixels = rng.integers(low, high, (RAYS, 2))
    z = model_depth(mesh, truth, camera, pixels)
    u, v = pixels.T
    edges = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    inner = ~edges[v, u]
    if whole is not None and inner.any():
        wrong = float((np.isfinite(z) != mask[v, u])[inner].mean())
        if wrong > WRONG_SHARE:
            where = scene.folder / "mask" / f"{int(image):06d}_{k:06d}.png"
            findings.add(where, f"object {k} in its pose disagrees in {wrong:.0%} of the pixels", POSES, image)
    if depth is None:
        return
    compared = visible[v, u] & np.isfinite(z) & np.isfinite(depth[v, u]) & inner
    if compared.sum() < 10:
        return
    measured, expected = depth[v, u][compared], z[compared]
    wrong = float((np.abs(measured - expected) > DEPTH_MM).mean())
    if wrong > WRONG_SHARE:
        where = scene.folder / "depth" / f"{int(image):06d}.png"
        ratio = float(np.median(measured / expected))
        hint = f", {ratio:.3g} times as far" if not 0.9 < ratio < 1.1 else ""
        miss = float(np.median(measured - expected))
        findings.add(where, f"object {k} is {miss:+.2f} mm from where its pose has it{hint}", DEPTHS, image)


def model_depth(mesh: trimesh.Trimesh, truth: dict[str, Any], camera: dict[str, Any], pixels: NDArray[Any]) -> Array:
    """Depth (N,) in mm of a model (mm) in a label's pose at pixels (N, 2), NaN where they miss it."""
    K = np.reshape(camera["cam_K"], (3, 3)).astype(np.float64)
    distortion = np.asarray(camera.get("cam_dist", np.zeros(4)), np.float64)
    points = pixels.astype(np.float64)[:, None]
    ideal = cv2.undistortPoints(points, K, distortion)[:, 0]
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    R, t = np.reshape(truth["cam_R_m2c"], (3, 3)), np.asarray(truth["cam_t_m2c"], np.float64)
    origins = np.tile(-R.T @ t, (len(rays), 1))
    hit, ray, _ = mesh.ray.intersects_location(origins, rays @ R, multiple_hits=True)
    z = np.full(len(rays), np.inf)
    np.minimum.at(z, ray, np.reshape(hit, (-1, 3)) @ R[2] + t[2])
    return np.where(np.isfinite(z), z, np.nan)
