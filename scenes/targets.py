"""What methods are tested on: BOP's ``test_targets_bop19.json``, which lists the objects that each image shows.

An entry says how many instances of an object are to be found in an image: ``scene_id`` is the folder's number,
``im_id`` the image's, ``inst_count`` counts the instances of ``obj_id`` of which at least a tenth is visible.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

from scenes.check_labels import Scene
from scenes.findings import Findings
from scenes.shards import VISIBLE, seen_in

TARGETS = "test_targets_bop19.json"
KEYS = ("scene_id", "im_id", "obj_id", "inst_count")
REMEDY = "render the data set again with the same command, which lists them anew"


def targets_in(shards: Iterable[Path]) -> list[dict[str, int]]:
    """The targets of finished shards, sorted by shard, image and object; raises SceneError for unreadable labels."""
    return _listed((int(shard.name), *seen) for shard in shards for seen in seen_in(shard))


def check_targets(path: Path, scenes: Sequence[Scene], findings: Findings, *, exact: bool) -> None:
    """Check a file of targets against the labels of its ``scenes``.

    ``exact``: it must list all that the labels show. Otherwise any of it, as data sets have it that are tested on some
    of their images only.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        findings.add(path, f"cannot be read: {error}", REMEDY)
        return
    if not isinstance(content, list) or not all(map(_is_target, content)):
        findings.add(path, f"is no list of objects with the whole numbers {', '.join(KEYS)}", REMEDY)
        return
    if exact:
        wanted = _listed(seen for scene in scenes for seen in _seen(scene))
        for k, (entry, target) in enumerate(zip_longest(content, wanted)):
            if entry != target:
                findings.add(path, f"entry {k} is {entry}, the labels say {target}", REMEDY)
                break
        return
    there = Counter(
        (int(scene.folder.name), int(image), truth["obj_id"])
        for scene in scenes
        for image, truths in scene.truths.items()
        for truth in truths
    )
    for entry in content:
        scene_id, image, obj_id, count = (entry[key] for key in KEYS)
        if not 1 <= count <= there[scene_id, image, obj_id]:
            told = f"lists {count} instances of object {obj_id}, the labels {there[scene_id, image, obj_id]}"
            findings.add(path, f"scene {scene_id} {told}", REMEDY, image)


def _listed(seen: Iterable[tuple[int, int, int]]) -> list[dict[str, int]]:
    """Targets from the scene, image and object of every instance."""
    return [dict(zip(KEYS, (*where, n), strict=True)) for where, n in sorted(Counter(seen).items())]


def _seen(scene: Scene) -> Iterable[tuple[int, int, int]]:
    for image, infos in scene.infos.items():
        for truth, info in zip(scene.truths[image], infos, strict=True):
            if info["visib_fract"] >= VISIBLE:
                yield int(scene.folder.name), int(image), truth["obj_id"]


def _is_target(entry: Any) -> bool:
    return isinstance(entry, dict) and all(type(entry.get(key)) is int for key in KEYS)
