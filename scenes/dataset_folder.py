"""The folder of a data set: what it is, that one run at a time writes into it, and what it holds when it is done.

``dataset.json`` is written before anything else and says what decides the bytes; a run that would make others is
refused. ``manifest.json`` is written when everything is there, after a test set's list of targets. ``.lock`` is held,
not merely present, while a run goes on, so one that was killed leaves nothing that has to be cleared away by hand.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from cad.parts import Part, hash_file
from scenes.bop import write_camera, write_models
from scenes.dataset_config import DatasetConfig
from scenes.errors import SceneError
from scenes.path_traced import GROUND_SAMPLES, LARGE_PX, REFLECTANCE_SAMPLES, SAMPLES
from scenes.rests import RestPool
from scenes.shards import clear_partial, images_in, shard_digest, shard_path
from scenes.targets import TARGETS, targets_in

GENERATOR = 1
"""Raise it with every change of the code that changes the bytes of any data set."""
DATASET, MANIFEST, MODELS, LOCK = "dataset.json", "manifest.json", "models", ".lock"
GOALS = ("count", "instances")
"""How far a data set goes; image ``i`` is the same in a longer one, so a data set may grow."""
LIBRARIES = ("mujoco", "numpy", "opencv-python-headless")
PART_FILES = ("part", "symmetries", "keypoints", "stable_poses")
SHOWN_DIFFERENCES = 6


def identity(config: DatasetConfig) -> dict[str, Any]:
    """All that decides the bytes of a data set: config, parts, this generator's version and its libraries'."""
    content: dict[str, Any] = {"generator": GENERATOR} | asdict(config)
    del content["parts_dir"]
    content |= {"look": asdict(config.look_ranges), "shots": asdict(config.shot_ranges)}
    if config.shot_ranges.empty_beside_px is None:  # as in data sets that were made before there was such a range
        del content["shots"]["empty_beside_px"]
    content |= {"view": asdict(config.view_ranges)}
    content |= {"size": config.pixels, "downscale": config.scale_down, "shard": config.shard_size}
    content["parts"] = {part.name: _part_identity(part) for part in config.load_parts()}
    if config.domain == "mitsuba" and config.pixels[0] * config.pixels[1] > LARGE_PX:
        content["samples"] = {"near_things": SAMPLES, "ground": GROUND_SAMPLES, "reflectance": REFLECTANCE_SAMPLES}
    libraries = (*LIBRARIES, "mitsuba") if config.domain == "mitsuba" else LIBRARIES
    content["libraries"] = {name: _version(name) for name in libraries}
    return json.loads(json.dumps(content))


def differences(there: dict[str, Any], wanted: dict[str, Any]) -> list[str]:
    """The fields in which two identities differ, with both values; nested fields are joined by dots."""
    if list(there.get("parts", {})) != list(wanted["parts"]):  # their names say it
        there, wanted = ({**content, "parts": ", ".join(content.get("parts", {}))} for content in (there, wanted))
    old, new = _flat(there), _flat(wanted)
    names = [name for name in {**new, **old} if old.get(name) != new.get(name)]
    return [f"{name} {_short(old.get(name))}, not {_short(new.get(name))}" for name in names]


@contextmanager
def opened(config: DatasetConfig, out: Path) -> Iterator[Path]:
    """Create or check the folder of a data set and hold its lock; yields the folder of its split.

    How parts rest is made once, for all workers. What interrupted runs left is removed, and the last shard of a data
    set that grows, where it has to become longer. Raises SceneError when another run holds the folder, it holds other
    data or cannot be written.
    """
    wanted = identity(config)
    _refuse_foreign(out)
    with ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            stack.enter_context(_locked(out))
            split = _prepare(config, wanted, out)
        except OSError as error:
            raise SceneError(f"cannot write into {out}: {error}; choose another folder with --out") from error
        yield split


def write_manifest(config: DatasetConfig, out: Path, shards: dict[int, Counter[int]]) -> dict[str, Any]:
    """Say what a finished data set holds, from its shards' instances by ``obj_id``; returns what was written.

    That of a test set stands beside BOP's list of what is to be found in each image. Raises SceneError when it cannot
    be written.
    """
    names = {part.obj_id: part.name for part in config.load_parts()}
    listed, instances = {}, Counter({name: 0 for name in names.values()})
    for index, counts in sorted(shards.items()):
        shard = out / config.split / f"{index:06d}"
        listed[shard.name] = {"images": images_in(shard), "sha256": shard_digest(shard)}
        instances.update({names[obj_id]: n for obj_id, n in counts.items()})
    content = {
        "images": sum(entry["images"] for entry in listed.values()),
        "instances": dict(instances),
        "shards": listed,
    }
    try:
        if config.split == "test":
            _write_json(out / TARGETS, targets_in(out / config.split / name for name in listed))
        _write_json(out / MANIFEST, content)
    except OSError as error:
        raise SceneError(f"cannot write {out / MANIFEST}: {error}; the same command goes on from there") from error
    return content


def read_identity(out: Path) -> dict[str, Any]:
    """What ``dataset.json`` says; raises SceneError when it is missing or broken."""
    path = out / DATASET
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SceneError(f"{path} cannot be read: {error}; {out} is no data set, choose another folder") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} holds no JSON object; {out} is no data set, choose another folder")
    return content


def _refuse_foreign(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise SceneError(f"{out} is a file; choose another folder with --out")
    ours = {LOCK, f".{DATASET}.partial"}
    if out.is_dir() and not (out / DATASET).exists() and any(path.name not in ours for path in out.iterdir()):
        raise SceneError(f"{out} is not empty and holds no {DATASET}; choose another folder with --out")


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder's lock; a file that the last holder removed meanwhile does not count."""
    path = out / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            raise SceneError(
                f"another run{holder and f' ({holder})'} writes into {out}; wait for it or stop it"
            ) from error
        if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
            break
        os.close(descriptor)
    try:
        os.truncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _prepare(config: DatasetConfig, wanted: dict[str, Any], out: Path) -> Path:
    split = out / config.split
    there = read_identity(out) if (out / DATASET).exists() else None
    if there is None:
        _write_json(out / DATASET, wanted)
    elif there != wanted:
        _compare(there, wanted, out)
        for name in (MANIFEST, TARGETS):
            (out / name).unlink(missing_ok=True)
        short = shard_path(split, (there["count"] or 0) // config.shard_size)
        if (there["count"] or 0) % config.shard_size and short.exists():
            shutil.rmtree(short)
        _write_json(out / DATASET, wanted)
    if not (out / MODELS).is_dir():
        _write_models(config, out)
    RestPool.load_or_make(config.load_parts(), out)
    split.mkdir(exist_ok=True)
    clear_partial(split)
    return split


def _write_models(config: DatasetConfig, out: Path) -> None:
    aside = out / f".{MODELS}.partial"
    shutil.rmtree(aside, ignore_errors=True)
    write_models(aside, config.load_parts())
    write_camera(aside, config.frame)
    for path in sorted(aside.iterdir()):  # camera.json, then models
        path.rename(out / path.name)
    aside.rmdir()


def _compare(there: dict[str, Any], wanted: dict[str, Any], out: Path) -> None:
    """Raise SceneError unless both are the same data set, or the wanted one only goes farther."""
    grows = [name for name in GOALS if there.get(name) and wanted[name] and there[name] < wanted[name]]
    differing = differences({**there, **{name: wanted[name] for name in grows}}, wanted)
    if not differing:
        return
    shown, more = differing[:SHOWN_DIFFERENCES], len(differing) - SHOWN_DIFFERENCES
    if more > 0:
        shown.append(f"and {more} more")
    if any(there.get(name) and wanted[name] and there[name] > wanted[name] for name in GOALS):
        shown.append("a data set can grow but not shrink")
    raise SceneError(
        f"{out} holds another data set, made with {'; '.join(shown)}. Choose another folder with --out, or go on with "
        f"the settings in {out / DATASET}"
    )


def _part_identity(part: Part) -> dict[str, str]:
    files = {name: part.folder / f"{name}.json" for name in PART_FILES}
    return {"mesh": part.mesh_hash} | {name: hash_file(path) for name, path in files.items() if path.exists()}


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "unknown"


def _flat(content: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(content, dict):
        return {prefix: content}
    return {k: v for name, value in content.items() for k, v in _flat(value, f"{prefix}.{name}".strip(".")).items()}


def _short(value: Any) -> str:
    text = "none" if value is None else value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _write_json(path: Path, content: Any) -> None:
    aside = path.with_name(f".{path.name}.partial")
    aside.write_text(json.dumps(content, indent=1))
    aside.replace(path)
