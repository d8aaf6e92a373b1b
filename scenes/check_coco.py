"""Checks ``scene_gt_coco.json``: what COCO's tools rely on, agreement with BOP's files, ids that are unique."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenes.check_labels import Scene
from scenes.check_models import Models, numbers
from scenes.findings import Findings

FORMAT = "write it as COCO's format has it (docs/data.md)"
UNIQUE = "number images and annotations through the whole data set"
_LISTS = ("images", "annotations", "categories")


def check_coco(scenes: Sequence[Scene], models: Models, findings: Findings) -> None:
    """Check the COCO files of the folders of one split; folders without one are as BOP allows."""
    used: dict[tuple[str, int], Path] = {}
    for scene in scenes:
        path = scene.folder / "scene_gt_coco.json"
        if not path.exists() and not (findings.root / "dataset.json").exists():
            continue
        content = findings.read_json(path, FORMAT)
        if content is None:
            continue
        missing = [name for name in _LISTS if not isinstance(content.get(name), list)]
        if missing:
            findings.add(path, f"lacks the lists {', '.join(missing)}", FORMAT)
            continue
        everything = [entry for name in _LISTS for entry in content[name]]
        if not all(isinstance(entry, dict) and type(entry.get("id")) is int for entry in everything):
            findings.add(path, "lists things that are no objects with a whole number as id", FORMAT)
            continue
        ours = (findings.root / "dataset.json").exists()
        for name in ("images", "annotations"):
            ids = [entry.get("id") for entry in content[name]]
            if len(set(ids)) != len(ids):
                findings.add(path, f"the ids of {name} are not all different", UNIQUE)
                continue
            again = [i for i in ids if (name, i) in used] if ours else []
            if again:
                findings.add(path, f"{name} {again[0]} has the id of one in {used[name, again[0]]}", UNIQUE)
            used.update({(name, i): path for i in ids})
        _check_entries(path, content, scene, models, findings)


def _check_entries(path: Path, content: dict[str, Any], scene: Scene, models: Models, findings: Findings) -> None:
    images = {entry.get("id"): entry for entry in content["images"]}
    by_file = {file.resolve(): image for image, file in scene.colours.items()}
    names: dict[Any, str] = {}
    for key, entry in images.items():
        file = (scene.folder / str(entry.get("file_name"))).resolve()
        if file not in by_file:
            findings.add(path, f"image {key} names {entry.get('file_name')!r}, which is no image here", FORMAT)
            continue
        names[key] = by_file[file]
    categories = {entry.get("id"): entry for entry in content["categories"]}
    for unknown in sorted(set(categories) - set(models.diameters), key=str):
        findings.add(path, f"category {unknown} is none of the models", FORMAT)
    for entry in content["annotations"]:
        image = names.get(entry["image_id"]) if type(entry.get("image_id")) is int else None
        if image is None:
            findings.add(path, f"annotation {entry.get('id')} is of no image: {entry.get('image_id')}", FORMAT)
            continue
        wrong = _wrong(entry, categories, images[entry["image_id"]])
        if wrong:
            findings.add(path, f"annotation {entry.get('id')}: {wrong}", FORMAT, image)
        elif "gt_id" in entry:
            scene.coco[image, entry["gt_id"]] = entry
            _compare(path, image, entry, scene, findings)
    if "gt_id" in (content["annotations"] or [{}])[0]:
        found = {(names.get(entry.get("image_id")), entry.get("gt_id")) for entry in content["annotations"]}
        for image, infos in scene.infos.items():
            for k, info in enumerate(infos):
                if info["px_count_visib"] and (image, k) not in found:
                    findings.add(path, f"object {k} is visible but has no annotation", FORMAT, image)


def _wrong(entry: dict[str, Any], categories: dict[Any, dict[str, Any]], image: dict[str, Any]) -> str:
    """What is wrong with an annotation by itself, empty when nothing is."""
    if type(entry.get("category_id")) is not int or entry["category_id"] not in categories:
        return f"category {entry.get('category_id')} is not listed"
    if numbers(entry.get("bbox"), 4) is None or not isinstance(entry.get("area"), int | float):
        return "bbox or area is not of numbers"
    if entry.get("iscrowd") not in (0, 1) or type(entry.get("gt_id", 0)) is not int:
        return f"iscrowd is {entry.get('iscrowd')!r}, gt_id {entry.get('gt_id')!r}"
    runs = entry.get("segmentation")
    if not isinstance(runs, dict) or runs.get("size") != [image.get("height"), image.get("width")]:
        return "segmentation is no run-length code of the image's size"
    points, names = entry.get("keypoints"), categories[entry["category_id"]].get("keypoints")
    if points is None:
        return ""
    if not isinstance(names, list) or numbers(points, 3 * len(names)) is None:
        return "keypoints are not u, v, v for each of its category's"
    if not all(flag in (0, 1, 2) for flag in points[2::3]):
        return "a keypoint's flag is not 0, 1 or 2"
    if entry.get("num_keypoints") != sum(flag > 0 for flag in points[2::3]):
        return f"num_keypoints is {entry.get('num_keypoints')!r}, not the number of flags above 0"
    return ""


def _compare(path: Path, image: str, entry: dict[str, Any], scene: Scene, findings: Findings) -> None:
    """Whether one of our annotations says what BOP's files say."""
    k, truths, infos = entry["gt_id"], scene.truths.get(image, []), scene.infos.get(image)
    if not 0 <= k < len(truths):
        findings.add(path, f"annotation {entry['id']}: gt_id {k} is not among {len(truths)} objects", FORMAT, image)
    elif truths[k]["obj_id"] != entry["category_id"]:
        told = f"category {entry['category_id']}, scene_gt.json has obj_id {truths[k]['obj_id']}"
        findings.add(path, f"annotation {entry['id']}: {told}", FORMAT, image)
    elif infos is not None and infos[k]["px_count_visib"] != entry["area"]:
        told = f"area {entry['area']}, scene_gt_info.json has {infos[k]['px_count_visib']} visible pixels"
        findings.add(path, f"annotation {entry['id']}: {told}", FORMAT, image)
