"""How fast labelled images are made, and what data sets cost: python -m benchmarks.render [--blender PYTHON].

Every case makes images as ``tagcell render`` does, all the way to files on disk: colours, masks, visible masks, depth,
keypoints, COCO and BOP labels, checksums. Rates are those of so many workers together once each has made its first
image; what starting costs is measured apart, and both count in what is projected for whole data sets. Beside it one
scene is drawn in every domain, and by Blender's Cycles under an interpreter that has bpy.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import cv2
import tyro

from benchmarks.render_domains import Drawn, compare, overlap, strip
from benchmarks.render_rates import Rate, measure_rate, stages
from benchmarks.tables import Section, show
from scenes.dataset_config import DatasetConfig, Kind
from scenes.domains import Domain, domain_problem
from scenes.ranges import LookRanges

Name = Literal[
    "crop-shadow",
    "crop-plain",
    "crop",
    "crop-filament",
    "crop-mitsuba",
    "frame",
    "frame-filament",
    "frame-mitsuba",
    "full",
    "compare",
]
ONE_SHADOW = LookRanges(default_look=0.0, lamps=(1, 3), shadow_share=1.0)
STRIP_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 90)
NO_SHADOW = LookRanges(default_look=0.0, shadow_share=0.0)
PLANS: dict[str, dict[Name, int]] = {
    "10,000 frames + 60,000 crops, classic": {"frame": 10_000, "crop": 60_000},
    "10,000 classic frames + 60,000 filament crops": {"frame": 10_000, "crop-filament": 60_000},
    "10,000 frames + 60,000 crops, filament": {"frame-filament": 10_000, "crop-filament": 60_000},
    "10 million crops, classic": {"crop": 10_000_000},
    "10 million crops, filament": {"crop-filament": 10_000_000},
    "10 million crops, mitsuba": {"crop-mitsuba": 10_000_000},
}
"""Data sets that the rates are projected to; the first is as large as the published one: 14 h + 17 h on two GPUs."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row: what is made, and the images/s that are asked for (None: only reported)."""

    what: str
    config: DatasetConfig
    target: float | None = None


def _config(kind: Kind, domain: Domain, shard: int, **settings: object) -> DatasetConfig:
    return replace(DatasetConfig(kind=kind, domain=domain, shard=shard, count=10_000_000, seed=1), **settings)


CASES: dict[Name, Case] = {
    "crop-shadow": Case(
        what="classic, one lamp casts shadows", config=_config("crop", "classic", 50, look=ONE_SHADOW), target=60
    ),
    "crop-plain": Case(what="classic, no shadows", config=_config("crop", "classic", 50, look=NO_SHADOW), target=150),
    "crop": Case(what="classic, as generated", config=_config("crop", "classic", 50)),
    "crop-filament": Case(what="filament", config=_config("crop", "filament", 25), target=25),
    "crop-mitsuba": Case(what="mitsuba", config=_config("crop", "mitsuba", 1)),
    "frame": Case(what="classic", config=_config("scene", "classic", 2), target=2),
    "frame-filament": Case(what="filament", config=_config("scene", "filament", 1)),
    "frame-mitsuba": Case(what="mitsuba", config=_config("scene", "mitsuba", 1)),
    "full": Case(what="classic", config=_config("scene", "classic", 1, size=(5472, 3648))),
}


@dataclass(frozen=True, kw_only=True)
class RenderBenchmark:
    """Options of the benchmark."""

    only: tuple[Name, ...] = (*CASES, "compare")
    """Rows to measure."""
    seconds: float = 20.0
    """Time for each row; at least one shard a worker is made."""
    workers: int = 2
    """Processes that make images at the same time."""
    images: int = 20
    """Pictures of the scene that all domains share."""
    out: Path | None = None
    """Folder on the disk that images are written to; the system's temporary one by default."""
    blender: Path | None = None
    """A Python interpreter that has bpy, to draw that scene with Cycles too."""
    strip: Path | None = None
    """File for that scene's pictures side by side."""
    json: bool = False
    """Print JSON instead of tables."""

    def __post_init__(self) -> None:
        if self.seconds <= 0 or self.workers < 1 or self.images < 1:
            raise ValueError(
                f"seconds {self.seconds} must be positive, workers {self.workers} and images {self.images} at least 1"
            )


def rates_section(rates: dict[Name, Rate]) -> Section:
    """Images/s beside what is asked for."""
    rows = [
        (
            f"{case.config.pixels[0]} x {case.config.pixels[1]}",
            case.what,
            f"{rate.rate:.3g}",
            "" if case.target is None else f">= {case.target:g}",
            f"{rate.cpu_ms:.4g}",
            f"{1e3 * rate.workers / rate.cpu_ms:.3g}",
            f"{rate.start_s:.1f}",
            f"{rate.memory_mb:.0f}",
            f"{rate.kilobytes:.0f}",
            f"{rate.images}",
        )
        for case, rate in ((CASES[name], rate) for name, rate in rates.items())
    ]
    columns = ("size", "domain", "images/s", "target", "CPU ms", "so at most", "start s", "MB", "kB an image", "images")
    workers = next(iter(rates.values())).workers
    return Section(title=f"Labelled images to disk, {workers} workers", columns=columns, rows=rows)


def stages_section(found: dict[Name, dict[str, float]]) -> Section:
    """CPU time by stage."""
    names = next(iter(found.values())).keys()
    rows = [(stage, *(f"{found[case][stage]:.2f}" for case in found)) for stage in names]
    rows.append(("all", *(f"{sum(stages.values()):.1f}" for stages in found.values())))
    return Section(title="CPU ms of one labelled image, one worker alone", columns=("stage", *found), rows=rows)


def projection_section(rates: dict[Name, Rate]) -> Section:
    """Hours for whole data sets at the measured rates, starting included."""
    rows = []
    for label, counts in PLANS.items():
        if counts.keys() <= rates.keys():
            took = [(count / rates[name].rate + rates[name].start_s) / 3600 for name, count in counts.items()]
            cores = sum(hours * rates[name].workers for hours, name in zip(took, counts, strict=True))
            size = sum(count * rates[name].kilobytes for name, count in counts.items()) / 1e6
            parts = " + ".join(f"{hours:.2f}" for hours in took)
            rows.append((label, parts, f"{sum(took):.2f}", f"{cores:.1f}", f"{size:.3g}"))
    return Section(title="Data sets", columns=("data set", "hours", "in all", "core hours", "GB"), rows=rows)


def compare_section(drawn: list[Drawn]) -> Section:
    """One scene by every renderer."""
    rows = [
        (
            one.name,
            f"{one.cpu_ms:.4g}",
            f"{one.rate:.3g}",
            f"{one.cpu_ms / drawn[0].cpu_ms:.1f}",
            f"{one.first_s:.1f}",
            f"{overlap(one.mask, drawn[0].mask):.4f}",
        )
        for one in drawn
    ]
    columns = ("renderer", "CPU ms", "images/s on two cores", "times classic", "first s", "mask IoU with classic")
    return Section(title="One scene of 256 x 256, drawn only", columns=columns, rows=rows)


def main(options: RenderBenchmark) -> None:
    """Measure and print."""
    asked: list[Name] = [name for name in CASES if name in options.only]
    chosen: list[Name] = [name for name in asked if not domain_problem(CASES[name].config.domain)]
    with TemporaryDirectory(prefix="tagcell-render-", dir=options.out) as temporary:
        rates, found = _measure(chosen, options, Path(temporary))
    sections = [rates_section(rates), stages_section(found), projection_section(rates)] if rates else []
    if "compare" in options.only:
        drawn = compare(options.images, options.blender)
        sections.append(compare_section(drawn))
        if options.strip is not None:
            cv2.imwrite(str(options.strip), cv2.cvtColor(strip(drawn), cv2.COLOR_RGB2BGR), STRIP_QUALITY)
    missing: list[Domain] = sorted({CASES[name].config.domain for name in asked if name not in chosen})
    notes = [f"{options.workers} workers, {options.seconds:g} s a row", f"load {os.getloadavg()[0]:.1f}"]
    notes += [f"no {domain}: {domain_problem(domain)}" for domain in missing]
    show(sections, "; ".join(notes), as_json=options.json)


def _measure(
    names: list[Name], options: RenderBenchmark, out: Path
) -> tuple[dict[Name, Rate], dict[Name, dict[str, float]]]:
    """Rates and stages. All files stay until the end: where many were deleted, ext4 is slow to make new ones."""
    rates: dict[Name, Rate] = {}
    found: dict[Name, dict[str, float]] = {}
    for name in names:
        config = CASES[name].config
        rates[name] = measure_rate(config, out / name, options.workers, options.seconds)
        found[name] = stages(config, out / f"{name}-stages", _few(rates[name], options.seconds))
    return rates, found


def _few(rate: Rate, seconds: float) -> int:
    """Images that a single worker makes in about a third of the time."""
    return max(1, min(200, round(rate.rate / rate.workers * seconds / 3)))


if __name__ == "__main__":
    main(tyro.cli(RenderBenchmark))
