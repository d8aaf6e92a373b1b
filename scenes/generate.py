"""Makes labelled data sets: chunks from their own seeds, by several workers, resumed where a run was interrupted."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from cad.parts import BUILT_IN, load_part
from cad.spatial import Intrinsics, inverse
from scenes.bop import Annotation, ChunkWriter, annotation_box, write_models
from scenes.distractors import distractor_meshes
from scenes.errors import SceneError
from scenes.randomize import LookRanges, draw_look, draw_sensor
from scenes.sensor import expose
from scenes.shots import CROP_DOWNSCALE, CROP_SIZE, WINDOW_SIZE, Shot, ShotRanges, ShotSampler
from scenes.stage import Stage, StageConfig
from scenes.textures import make_textures

Kind = Literal["crop", "fine", "scene"]
Split = Literal["train", "val"]
MANIFEST = "dataset.json"
RASTERISER_THREADS = "LP_NUM_THREADS"
"""Environment variable of Mesa's software rasteriser; 0 draws in the calling thread."""
TEXTURES = 36
TEXTURE_SEEDS: dict[str, int] = {"train": 101, "val": 202}
"""Backgrounds of the splits never coincide."""
FULL_MARGIN_PX = 80
"""A part that reaches the border of a crop may go on by at most its diameter: 10 mm are 75 px at half resolution."""
STAGES: dict[str, StageConfig] = {
    "crop": StageConfig(
        slots=4, max_size=CROP_SIZE // CROP_DOWNSCALE + 2 * FULL_MARGIN_PX, shadow_half_m=0.025, shadow_size=512
    ),
    "fine": StageConfig(
        slots=4, max_size=CROP_SIZE + 2 * CROP_DOWNSCALE * FULL_MARGIN_PX, shadow_half_m=0.025, shadow_size=1024
    ),
    "scene": StageConfig(slots=8, max_size=WINDOW_SIZE + 2 * FULL_MARGIN_PX, shadow_half_m=0.07, shadow_size=1024),
}


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """What to generate. Everything but ``jobs`` decides the images; the same settings give the same bytes.

    ``kind``: ``crop`` for 128 x 128 crops round one part, ``fine`` for the same at full resolution, 256 x 256, and
    ``scene`` for 320 x 320 windows of the quarter-size frame.
    """

    kind: Kind = "crop"
    split: Split = "train"
    count: int = 1000
    seed: int = 1
    jobs: int = 1
    chunk: int = 500
    depth: bool = False
    parts: tuple[str, ...] = ()
    parts_dir: Path | None = None
    look: LookRanges = field(default_factory=LookRanges)
    shots: ShotRanges = field(default_factory=ShotRanges)

    def __post_init__(self) -> None:
        if self.kind not in STAGES:
            raise SceneError(f"kind {self.kind!r} is not one of {', '.join(STAGES)}")
        if self.split not in TEXTURE_SEEDS:
            raise SceneError(f"split {self.split!r} is not one of {', '.join(TEXTURE_SEEDS)}")
        for name in ("count", "jobs", "chunk"):
            if getattr(self, name) < 1:
                raise SceneError(f"{name} {getattr(self, name)}: must be at least 1")
        if self.seed < 0:
            raise SceneError(f"seed {self.seed}: must not be negative")
        if self.chunk > 1000:
            raise SceneError(f"chunk {self.chunk}: BOP allows at most 1000 images a folder")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts shown: those asked for, or the built-in ones."""
        return self.parts or BUILT_IN


def generate(config: DatasetConfig, out: Path, report: Callable[[str], None] = print) -> None:
    """Write the data set ``config`` describes into ``out``; chunks that are there already are kept.

    Raises SceneError when ``out`` holds a data set made with another config or cannot be written.
    """
    split = _open_folder(config, out)
    chunks = -(-config.count // config.chunk)
    missing = [k for k in range(chunks) if not (split / f"{k:06d}").exists()]
    sizes = {k: min(config.chunk, config.count - k * config.chunk) for k in missing}
    started, done, total = time.monotonic(), 0, sum(sizes.values())
    for k in _finished_chunks(config, split, missing):
        done += sizes[k]
        rate = done / (time.monotonic() - started)
        report(f"{out.name}: {config.count - total + done} of {config.count} images, {rate:.1f} images/s")


def _open_folder(config: DatasetConfig, out: Path) -> Path:
    """Create or check the folder; returns the split's folder, free of what an interrupted run left."""
    parts = [load_part(name, config.parts_dir) for name in config.names]
    content = asdict(config) | {"parts": {p.name: p.mesh_hash for p in parts}}
    content.pop("jobs")
    manifest = json.dumps(content, indent=1, default=str)
    path = out / MANIFEST
    try:
        if path.exists():
            if path.read_text() != manifest:
                raise SceneError(f"{out} holds a data set made with other settings ({path}); use another folder")
        elif out.exists() and any(out.iterdir()):
            raise SceneError(f"{out} is not empty and holds no {MANIFEST}; use another folder")
        split = out / config.split
        split.mkdir(parents=True, exist_ok=True)
        write_models(out, parts)
        path.write_text(manifest)
    except OSError as error:
        raise SceneError(f"cannot write into {out}: {error}") from error
    for leftover in split.glob(".*.partial"):
        shutil.rmtree(leftover)
    return split


def _finished_chunks(config: DatasetConfig, split: Path, missing: list[int]) -> Iterator[int]:
    tasks = [(k, split / f"{k:06d}", min(config.chunk, config.count - k * config.chunk)) for k in missing]
    if config.jobs == 1 or len(tasks) <= 1:
        worker = ChunkMaker(config)
        try:
            for task in tasks:
                yield worker.make(*task)
        finally:
            worker.close()
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(config.jobs, len(tasks)), initializer=_start_worker, initargs=(config,)) as pool:
        yield from pool.imap_unordered(_run_task, tasks)


_worker: ChunkMaker | None = None


def _start_worker(config: DatasetConfig) -> None:
    """One core a worker: neither OpenCV nor the software rasteriser starts threads of its own."""
    global _worker
    os.environ.setdefault(RASTERISER_THREADS, "0")
    cv2.setNumThreads(1)
    _worker = ChunkMaker(config)


def _run_task(task: tuple[int, Path, int]) -> int:
    assert _worker is not None
    return _worker.make(*task)


class ChunkMaker:
    """Makes chunks of one data set; holds the compiled stage."""

    def __init__(self, config: DatasetConfig) -> None:
        self._config = config
        self._parts = {name: load_part(name, config.parts_dir) for name in config.names}
        textures = make_textures(np.random.default_rng(TEXTURE_SEEDS[config.split]), TEXTURES)
        self._stage = Stage(list(self._parts.values()), textures, STAGES[config.kind])
        radii = {n: float(np.linalg.norm(m.vertices[:, :2], axis=1).max()) for n, m in distractor_meshes().items()}
        self._sampler = ShotSampler(list(self._parts.values()), radii, config.shots)

    def make(self, index: int, folder: Path, count: int) -> int:
        """Make chunk ``index`` of ``count`` images in ``folder``; returns the index."""
        rng = np.random.default_rng([self._config.seed, index])
        writer = ChunkWriter(folder, with_depth=self._config.depth)
        for _ in range(count):
            self._add_image(writer, rng)
        writer.finish()
        return index

    def close(self) -> None:
        """Free the renderer."""
        self._stage.close()

    def _add_image(self, writer: ChunkWriter, rng: np.random.Generator) -> None:
        if self._config.kind == "scene":
            shot = self._sampler.window(rng)
        else:
            shot = self._sampler.crop(rng, CROP_DOWNSCALE if self._config.kind == "crop" else 1)
        instances = self._stage.arrange(shot)
        look = draw_look(self._config.look, TEXTURES, rng)
        self._stage.dress(shot, look, self._config.look, rng)
        drawn = self._stage.render(shot.intrinsics, ("rgb", "instances", *(("depth",) if self._config.depth else ())))
        assert drawn.rgb is not None and drawn.instances is not None
        brightest = float(np.percentile(drawn.rgb[::4, ::4], 98))
        sensor = draw_sensor(self._config.look, brightest, rng)
        image = expose(drawn.rgb, sensor, rng, shot.downscale)
        annotations = self._annotations(shot, instances, drawn.instances)
        writer.add(image, shot.intrinsics, inverse(shot.T_board_cam), annotations, drawn.depth_m)

    def _annotations(self, shot: Shot, instances: np.ndarray, seen: np.ndarray) -> list[Annotation]:
        """One for each part seen, in the shot's order; whole silhouettes come from a wider window if need be."""
        masks = [seen == instance for instance in instances]
        border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
        margin = FULL_MARGIN_PX * (CROP_DOWNSCALE if self._config.kind == "fine" else 1)
        wide = (
            self._stage.render(_widened(shot.intrinsics, margin), ("instances",)).instances
            if (border >= 0).any()
            else None
        )
        T_cam_board = inverse(shot.T_board_cam)
        annotations = []
        for placed, instance, mask in zip(shot.parts, instances, masks, strict=True):
            if not mask.any():
                continue
            full = mask if wide is None else wide == instance
            x, y, w, h = annotation_box(full)
            shift = 0 if wide is None else margin
            annotations.append(
                Annotation(
                    obj_id=self._parts[placed.name].obj_id,
                    stable_pose=placed.stable_pose,
                    T_cam_part=T_cam_board @ placed.T_board_object,
                    mask=mask,
                    full_count=int(full.sum()),
                    full_box=(x - shift, y - shift, w, h),
                )
            )
        return annotations


def _widened(intrinsics: Intrinsics, margin: int) -> Intrinsics:
    return intrinsics.crop(-margin, -margin, intrinsics.width + 2 * margin, intrinsics.height + 2 * margin)
