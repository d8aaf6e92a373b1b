"""How long a 20 MP frame with 12 parts takes, stage by stage, from pixels to poses: python -m benchmarks.perceive.

Frames are whole ones of the camera, of the validation split, rendered on the first run and kept. Each is taken apart
by the estimator exactly as in a pick; the first, which warms caches, is not counted. Reading the file does not count.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro

from benchmarks.tables import Section, show
from cad.spatial import BASLER, Intrinsics
from perception.bop_files import Entry, read_entries
from perception.estimates import Frame, FrameEstimate
from perception.estimator import LearnedEstimator
from scenes.dataset_config import DatasetConfig
from scenes.domains import Domain
from scenes.generate import generate
from scenes.ranges import Split
from scenes.shots import SHOTS

PARTS = 12
SPLIT: Split = "val"
WANTED_S = {"p50": 1.5, "p95": 4.0}


@dataclass(frozen=True, kw_only=True)
class PerceiveBenchmark:
    """Options of the benchmark."""

    frames: int = 20
    """Frames that count."""
    domain: Domain = "classic"
    """Domain of the frames."""
    seed: int = 31
    """Seed of the frames."""
    threads: int = os.cpu_count() or 1
    """Threads of torch and OpenCV."""
    weights: Path | None = None
    """Folder with the networks' weights, by default those of the package."""
    keep: Path = Path("runs/bench_perceive")
    """Folder that the frames are kept in."""
    json: bool = False
    """Print JSON instead of tables."""


def frames_of(options: PerceiveBenchmark) -> list[Entry]:
    """The frames, rendered where they are missing; one more than count."""
    shots = replace(SHOTS[SPLIT], scene_parts=(PARTS, PARTS))
    config = DatasetConfig(
        kind="scene",
        domain=options.domain,
        split=SPLIT,
        size=(BASLER.width, BASLER.height),
        count=options.frames + 1,
        seed=options.seed,
        shard=7,
        depth=False,
        shots=shots,
    )
    out = options.keep / f"{options.domain}_{options.seed}"
    generate(config, out, jobs=os.cpu_count() or 1)
    return read_entries(out)[: options.frames + 1]


def frame_of(entry: Entry) -> Frame:
    """The image of a data set with its camera."""
    image, K = entry.image(), entry.K
    height, width = image.shape[:2]
    camera = Intrinsics(width=width, height=height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])
    return Frame(image=np.ascontiguousarray(image), intrinsics=camera, time_s=0.0)


def measure(options: PerceiveBenchmark) -> tuple[list[FrameEstimate], list[float], list[float]]:
    """Estimates of all frames that count, and their wall and processor seconds."""
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    estimator = LearnedEstimator(options.weights)
    estimates, wall, cpu = [], [], []
    for entry in frames_of(options):
        frame = frame_of(entry)
        started, spent = time.perf_counter(), time.process_time()
        estimates.append(estimator.estimate(frame))
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - spent)
    return estimates[1:], wall[1:], cpu[1:]


def main(options: PerceiveBenchmark) -> None:
    """Measure and print."""
    estimates, wall, cpu = measure(options)

    def row(name: str, values: list[float], wanted: str = "") -> tuple[str, ...]:
        return (name, *(f"{np.percentile(values, p):.3f}" for p in (50, 95)), f"{np.mean(values):.3f}", wanted)

    stages = list(dict.fromkeys(stage for estimate in estimates for stage in estimate.seconds))
    rows = [row(stage, [estimate.seconds.get(stage, 0.0) for estimate in estimates]) for stage in stages]
    wanted = f"p50 <= {WANTED_S['p50']}, p95 <= {WANTED_S['p95']}"
    rows += [row("the whole frame", wall, wanted), row("its processor time", cpu)]
    found = [len(estimate.parts) for estimate in estimates]
    accepted = [sum(part.accepted for part in estimate.parts) for estimate in estimates]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2)
    note = (
        f"{len(wall)} {options.domain} frames of {BASLER.width} x {BASLER.height} with up to {PARTS} parts; a frame: "
        f"{np.mean(found):.1f} estimates, {np.mean(accepted):.1f} accepted; {options.threads} threads; peak memory "
        f"{peak:.0f} MB"
    )
    section = Section(
        title="From pixels to poses, seconds", columns=("stage", "p50", "p95", "mean", "wanted"), rows=rows
    )
    show([section], note, as_json=options.json)


if __name__ == "__main__":
    main(tyro.cli(PerceiveBenchmark, description=__doc__))
