"""``tagcell part add``: from a CAD or mesh file to the folder that everything else reads.

The folder is made aside and renamed when it is whole: a run that fails or is stopped leaves nothing behind, and a part
that is replaced stays as it was until the new one is ready.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from cad.collision import find_collision_shapes
from cad.folders import PartFacts, write_part_folder
from cad.intake import Intake, read_part
from cad.materials import material
from cad.parts import BUILT_IN, Part, load_part, own_parts_dir, part_names
from scenes.part_preview import write_preview
from scenes.stable_poses import StablePoseConfig
from twin.grasps import write_grasps
from twin.robot import TwinError
from twin.stable_pose_report import stable_pose_report

_ASIDE, _REMOVED = ".adding", ".removed"


class NewPartError(TwinError):
    """A part that cannot be added or removed as asked."""


@dataclass(frozen=True, kw_only=True)
class NewPartConfig:
    """What to take in, and what its file does not tell."""

    file: Path
    name: str
    material: str = "steel"
    mass_g: float | None = None
    density: float | None = None
    unit: str | None = None
    accept_size: bool = False
    replace: bool = False
    parts_dir: Path | None = None
    drops: int = 2000
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise NewPartError(f"name {self.name!r}: use letters, digits and underscores, not starting with a digit")
        if self.name in BUILT_IN:
            raise NewPartError(f"{self.name!r} is a built-in part; choose another --name")
        if self.mass_g is not None and self.density is not None:
            raise NewPartError(f"--mass-g {self.mass_g} and --density {self.density}: give one of them")
        for flag, value in (("--mass-g", self.mass_g), ("--density", self.density)):
            if value is not None and not 0 < value < float("inf"):
                raise NewPartError(f"{flag} {value}: it must be positive")
        if self.seed < 0:
            raise NewPartError(f"--seed {self.seed}: it must not be negative")
        if self.drops < 1000:
            raise NewPartError(f"--drops {self.drops}: at least 1000 are needed for the probabilities")


@dataclass(frozen=True, kw_only=True, eq=False)
class AddedPart:
    """A part that was added, how its file was taken in, and how long each stage took in seconds."""

    part: Part
    intake: Intake
    seconds: dict[str, float] = field(default_factory=dict)


def add_part(config: NewPartConfig, report: Callable[[str], None] = lambda stage: None) -> AddedPart:
    """Make the part's folder; ``report`` is told of every stage as it begins.

    Raises MeshError for a file that cannot be used, MaterialError for an unknown material and NewPartError for a name
    that is taken, before anything is written; SceneError when the part comes to rest nowhere.
    """
    material(config.material)
    root = own_parts_dir(config.parts_dir)
    _check_name_is_free(config, root)
    stages = _Stages(report)
    with stages.stage(f"reading {config.file.name}"):
        intake = read_part(config.file, unit=config.unit, accept_size=config.accept_size)
    with _aside(root, config.name) as folder:
        with stages.stage("symmetries, keypoints, collision shapes"):
            shapes = find_collision_shapes(intake.mesh)
            write_part_folder(folder, intake.mesh, shapes, _facts(config, intake))
            shutil.copyfile(config.file, folder / f"source{config.file.suffix.lower()}")
        with stages.stage(f"stable poses from {config.drops} drops, and which look alike"):
            stable_pose_report(_load(folder), StablePoseConfig(drops=config.drops, seed=config.seed)).write()
        with stages.stage("grasps, each tried in physics"):
            write_grasps(_load(folder))
        with stages.stage("contact sheet"):
            write_preview(_load(folder))
        _put_in_place(folder, root)
    part = load_part(config.name, root)
    return AddedPart(part=part, intake=intake, seconds=stages.seconds)


def remove_part(name: str, parts_dir: Path | None = None) -> Path:
    """Remove one of the user's own parts; returns where it was. Raises NewPartError for any other name."""
    root = own_parts_dir(parts_dir)
    if not name.isidentifier() or not (root / name / "part.json").is_file():
        own = [n for n in part_names(parts_dir) if n not in BUILT_IN]
        why = "is built in and stays" if name in BUILT_IN else "is not among your parts"
        raise NewPartError(f"{name!r} {why}; parts that can be removed: {', '.join(own) or 'none'} (in {root})")
    _discard(root / name, root)
    return root / name


class _Stages:
    """Tells of stages as they begin and keeps their times."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report, self.seconds = report, dict[str, float]()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._report(name)
        started = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started


def _facts(config: NewPartConfig, intake: Intake) -> PartFacts:
    kind = material(config.material)
    density = kind.density_kg_m3 if config.density is None else config.density
    if config.mass_g is not None:
        density = 1e-3 * config.mass_g / float(intake.mesh.volume)
    return PartFacts(
        name=config.name,
        obj_id=_next_id(config.parts_dir),
        density_kg_m3=density,
        material=str(kind),
        rgba=(*kind.rgb, 1.0),
        metallic=kind.metallic,
        roughness=kind.roughness,
        sources=(config.file.name,),
        source_unit=f"{intake.unit} ({intake.unit_source})",
        notes=intake.notes,
    )


def _next_id(parts_dir: Path | None) -> int:
    return 1 + max(load_part(name, parts_dir).obj_id for name in part_names(parts_dir))


def _check_name_is_free(config: NewPartConfig, root: Path) -> None:
    if (root / config.name).exists() and not config.replace:
        raise NewPartError(
            f"there is a part called {config.name!r} already, in {root / config.name}; choose another --name, or "
            "--replace it"
        )


@contextmanager
def _aside(root: Path, name: str) -> Iterator[Path]:
    """A folder ``name`` inside a hidden one in ``root``; whatever is left of it in the end is removed."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        _sweep(root)
        hidden = _hidden(root, _ASIDE)
    except OSError as error:
        raise NewPartError(
            f"cannot write to {root} ({error.strerror}); choose another folder with --parts-dir"
        ) from error
    try:
        (hidden / name).mkdir()
        yield hidden / name
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def _load(folder: Path) -> Part:
    return load_part(folder.name, folder.parent)


def _put_in_place(folder: Path, root: Path) -> None:
    """Rename the finished folder into ``root``; a part of that name keeps its obj_id and makes room."""
    with open(root / ".lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        target = root / folder.name
        facts = json.loads((folder / "part.json").read_text())
        before = target / "part.json"
        facts["obj_id"] = json.loads(before.read_text())["obj_id"] if before.is_file() else _next_id(root)
        (folder / "part.json").write_text(json.dumps(facts, indent=1) + "\n")
        if target.exists():
            _discard(target, root)
        folder.rename(target)


def _discard(folder: Path, root: Path) -> None:
    """Remove a part's folder: out of sight at once and as a whole, then file by file."""
    hidden = _hidden(root, _REMOVED)
    folder.rename(hidden / folder.name)
    shutil.rmtree(hidden)


def _hidden(root: Path, what: str) -> Path:
    """A new folder whose name says which process made it."""
    return Path(tempfile.mkdtemp(prefix=f"{what}-{os.getpid()}-", dir=root))


def _sweep(root: Path) -> None:
    """Remove what processes that were killed left."""
    for folder in root.glob(".*-*-*"):
        what, process, _ = folder.name.split("-", 2)
        if what in (_ASIDE, _REMOVED) and process.isdigit() and not _is_alive(int(process)):
            shutil.rmtree(folder, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
