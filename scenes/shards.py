"""One shard on disk: a folder of images that is written aside, summed up, and only then given its name.

``SHA256SUMS`` is written last, in the form that ``sha256sum -c`` reads. A folder under a shard's name is therefore
complete, and whether it is still as it was written can be told.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scenes.errors import SceneError

SUMS = "SHA256SUMS"
PARTIAL = ".*.partial"
"""Pattern of the folders that interrupted runs leave behind."""
SHARD = "[0-9]" * 6
"""Pattern of the shards' names."""
VISIBLE = 0.1
"""Share of its silhouette that must be seen of a part for it to count as an instance, as BOP counts its targets."""


def shard_path(split: Path, index: int) -> Path:
    """Folder of shard ``index`` in the folder of its split."""
    return split / f"{index:06d}"


@contextmanager
def written_aside(final: Path) -> Iterator[Path]:
    """A new folder to write a shard into; it becomes ``final``, with its sums, unless an exception leaves the block.

    Its name is used once only, so that no two writers meet in it. Where ``final`` has come into being meanwhile, that
    shard stays: both hold the same bytes.
    """
    aside = final.with_name(f".{final.name}.{uuid.uuid4().hex[:12]}.partial")
    try:
        aside.mkdir()
        yield aside
        write_sums(aside)
        try:
            aside.rename(final)
        except OSError:
            if not (final / SUMS).is_file():
                raise
    finally:
        if aside.exists():
            shutil.rmtree(aside, ignore_errors=True)


def clear_partial(split: Path) -> None:
    """Remove what killed workers have left of their shards."""
    for leftover in split.glob(PARTIAL):
        shutil.rmtree(leftover, ignore_errors=True)


def write_sums(folder: Path) -> None:
    """Write the SHA-256 sums of all files below a folder, sorted by name, into its ``SHA256SUMS``."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    (folder / SUMS).write_text("".join(f"{_sum(folder / name)}  {name}\n" for name in names if name != SUMS))


def read_sums(shard: Path) -> dict[str, str]:
    """SHA-256 sums of a shard's files by their names; raises SceneError when they cannot be read."""
    try:
        lines = (shard / SUMS).read_text().splitlines()
        return {name: digest for digest, name in (line.split("  ", 1) for line in lines)}
    except (OSError, ValueError) as error:
        raise SceneError(f"{shard} is no complete shard ({SUMS}: {error}); {remedy(shard)}") from error


def shard_digest(shard: Path) -> str:
    """SHA-256 sum of a shard's ``SHA256SUMS``: it stands for every byte of the shard."""
    return _sum(shard / SUMS)


def images_in(shard: Path) -> int:
    """How many images a shard holds."""
    return sum(name.startswith("rgb/") for name in read_sums(shard))


def seen_in(shard: Path) -> list[tuple[int, int]]:
    """Image and ``obj_id`` of every instance that a shard shows, at least VISIBLE of each; raises SceneError."""
    try:
        truths, infos = (json.loads((shard / f"{n}.json").read_text()) for n in ("scene_gt", "scene_gt_info"))
        return [
            (int(image), truth["obj_id"])
            for image, listed in truths.items()
            for truth, info in zip(listed, infos[image], strict=True)
            if info["visib_fract"] >= VISIBLE
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"the labels of {shard} cannot be read ({error}); {remedy(shard)}") from error


def instances_in(shard: Path) -> Counter[int]:
    """How many instances of each ``obj_id`` a shard shows, at least VISIBLE of each; raises SceneError."""
    return Counter(obj_id for _, obj_id in seen_in(shard))


def shard_problems(shard: Path) -> list[str]:
    """What is not as it was written, a line each: missing, changed and strange files; empty when all is well."""
    try:
        sums = read_sums(shard)
    except SceneError as error:
        return [str(error)]
    there = {path.relative_to(shard).as_posix() for path in shard.rglob("*") if path.is_file()} - {SUMS}
    problems = [f"{shard / name} is missing" for name in sorted(set(sums) - there)]
    problems += [f"{shard / name} was not made with the shard" for name in sorted(there - set(sums))]
    problems += [
        f"{shard / name} was changed: its SHA-256 sum is not the one in {SUMS}"
        for name in sorted(there & set(sums))
        if _sum(shard / name) != sums[name]
    ]
    return [f"{problem}; {remedy(shard)}" for problem in problems]


def remedy(shard: Path) -> str:
    """What mends a damaged shard."""
    return f"to mend it delete {shard} and render again with the same command"


def _sum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
