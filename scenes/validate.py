"""Checks a data set in BOP layout, one of ours or anybody's: files, JSON, units, masks, depth, models, checksums.

The JSON files are read completely; pictures, masks and depth of a sample of the images are compared with the models in
the poses of their labels. Where there is a ``dataset.json`` the set is one of ours: it must be complete and as written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scenes.check_coco import check_coco
from scenes.check_labels import Scene, check_scene
from scenes.check_models import Models, check_models
from scenes.check_pixels import check_pixels
from scenes.errors import SceneError
from scenes.findings import Findings, Report
from scenes.shards import shard_digest, shard_problems
from scenes.targets import TARGETS, check_targets

SAMPLE = 100
"""Images whose pixels are compared."""
OURS = {"dataset.json", "manifest.json", "camera.json", "models", "rests.npz", "cache", TARGETS}
SPLITS = ("train", "val", "test")
AGAIN = "render the data set again with the same command: what is there is kept"


def validate(folder: Path, *, sample: int = SAMPLE) -> Report:
    """Check the data set in ``folder``; ``sample`` images are looked at pixel by pixel, spread evenly.

    Raises SceneError when there is no data set at all.
    """
    splits = [path for path in sorted(folder.glob("*")) if path.is_dir() and _scenes(path)]
    if not splits:
        raise SceneError(
            f"{folder} holds no images in BOP layout; name a folder with {', '.join(SPLITS)} (and so on) in it, and "
            "numbered folders in those"
        )
    findings, ours = Findings(root=folder), (folder / "dataset.json").exists()
    if ours:
        _check_completeness(folder, findings)
    models = check_models(folder, findings)
    scenes = [scene for split in splits for path in _scenes(split) if (scene := check_scene(path, models, findings))]
    for split in splits:
        check_coco([scene for scene in scenes if scene.folder.parent == split], models, findings)
    if (folder / TARGETS).exists() or (ours and splits[0].name == "test"):
        tested = [scene for scene in scenes if scene.folder.parent.name.startswith("test")]
        check_targets(folder / TARGETS, tested, findings, exact=ours)
    _check_sample(scenes, models, findings, sample)
    counts = {
        "folders": len(scenes),
        "images": sum(len(scene.cameras) for scene in scenes),
        "parts": sum(len(listed) for scene in scenes for listed in scene.truths.values()),
        **findings.counts,
    }
    return Report(folder=folder, problems=tuple(findings.told()), counts=counts)


def _listed(path: Path, manifest: dict[str, Any], findings: Findings) -> dict[str, dict[str, Any]]:
    """The shards that a manifest lists."""
    shards = manifest.get("shards", {})
    entries = list(shards.values()) if isinstance(shards, dict) else [None]
    good = [isinstance(e, dict) and type(e.get("images")) is int and isinstance(e.get("sha256"), str) for e in entries]
    if not all(good):
        findings.add(path, "shards are not listed with their images and SHA-256 sums", AGAIN)
        return {}
    return shards


def _scenes(split: Path) -> list[Path]:
    return [path for path in sorted(split.glob("*")) if re.fullmatch(r"\d{6}", path.name) and path.is_dir()]


def _check_sample(scenes: Sequence[Scene], models: Models, findings: Findings, sample: int) -> None:
    everything = [(scene, image) for scene in scenes for image in sorted(scene.cameras, key=int)]
    chosen = np.unique(np.linspace(0, len(everything) - 1, min(sample, len(everything))).round().astype(int))
    for k in chosen.tolist() if everything else []:
        scene, image = everything[k]
        check_pixels(scene, image, models, findings)
    findings.counts["images compared with their labels"] = len(chosen) if everything else 0


def _check_completeness(folder: Path, findings: Findings) -> None:
    """Whether one of our data sets holds what its manifest lists, every byte of it, and nothing else."""
    dataset = findings.read_json(folder / "dataset.json", "use another folder and render again")
    split = folder / str((dataset or {}).get("split", "train"))
    for path in sorted(folder.iterdir()):
        if path.name not in OURS | {split.name} and not path.name.startswith("."):
            findings.add(path, "was not made with the data set", "move it elsewhere")
    if not (folder / "manifest.json").exists():
        findings.add(folder / "manifest.json", "is missing: the data set is not finished", AGAIN)
    manifest = findings.read_json(folder / "manifest.json", AGAIN) if (folder / "manifest.json").exists() else None
    listed = _listed(folder / "manifest.json", manifest or {}, findings)
    for path in sorted(split.iterdir()) if split.is_dir() else []:
        if not re.fullmatch(r"\d{6}", path.name):
            findings.add(path, "is no part of the data set", "delete it")
            continue
        for problem in shard_problems(path):
            what, _, remedy = problem.rpartition("; ")
            findings.add(path, what, remedy)
        if manifest is None or not (path / "SHA256SUMS").exists():
            continue
        if path.name not in listed:
            findings.add(path, "is not listed in manifest.json", "delete it")
        elif shard_digest(path) != listed[path.name]["sha256"]:
            findings.add(path, "SHA256SUMS is not the one that manifest.json lists", f"delete {path} and {AGAIN}")
    for name in sorted(set(listed) - {path.name for path in split.glob("*")}):
        findings.add(split / name, "is missing though manifest.json lists it", AGAIN)
    if manifest is not None and manifest.get("images") != sum(shard["images"] for shard in listed.values()):
        findings.add(folder / "manifest.json", f"its shards do not add up to {manifest.get('images')} images", AGAIN)
