"""Grasps of each stable pose and what their trials in physics measured: python -m benchmarks.grasps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.tables import Section, show
from cad.parts import load_part, part_names
from scenes.workcell import CellConfig
from twin.grasps import PoseGrasps, describe_grasps, plan_grasps


@dataclass(frozen=True, kw_only=True)
class GraspBenchmark:
    """Options of the benchmark."""

    parts: tuple[str, ...] = ()
    """Names of parts; all when left out."""
    parts_dir: Path | None = None
    """Folder of your own parts; TAGCELL_PARTS_DIR or your data directory when left out."""
    plan: bool = False
    """Search and try the grasps again instead of reporting what is stored; nothing is written."""
    json: bool = False
    """Print JSON instead of tables."""


def best_of_each_pose(name: str, poses: tuple[PoseGrasps, ...]) -> list[tuple[str, ...]]:
    """A row for every stable pose: its best grasp, and the worst figures of all of its grasps."""
    rows = []
    for pose in poses:
        trials = [grasp.trial for grasp in pose.grasps if grasp.trial is not None]
        if not trials:
            rows.append((name, str(pose.stable_pose), "0", *["-"] * 6))
            continue
        best = pose.grasps[0]
        margin = trials[0].margin
        rows.append(
            (
                name,
                str(pose.stable_pose),
                str(len(pose.grasps)),
                f"{1e3 * best.width_m:.2f}",
                "lines" if best.contact.roll > 0.5 else "faces",
                f"{1e6 * max(t.shift_m for t in trials):.0f}",
                f"{1e6 * max(t.slip_m for t in trials):.0f}, {np.degrees(max(t.slip_rad for t in trials)):.2f}",
                f"{1e6 * max(t.place_m for t in trials):.0f}, {np.degrees(max(t.place_rad for t in trials)):.2f}",
                "-" if margin is None else f"{margin:.0%}",
            )
        )
    return rows


def main() -> None:
    """Print the tables."""
    options = tyro.cli(GraspBenchmark, description=__doc__)
    names = options.parts or tuple(part_names(options.parts_dir))
    found = {}
    for name in names:
        part = load_part(name, options.parts_dir)
        found[name] = plan_grasps(part) if options.plan else describe_grasps(part)
    columns = ("part", "face", "grasps", "width mm", "held by", "shift um", "slip um, deg", "place um, deg", "margin")
    table = Section(
        title="Grasps that held: width of the best, the worst figures of all",
        columns=columns,
        rows=[row for name, poses in found.items() for row in best_of_each_pose(name, poses)],
    )
    reasons = [(n, str(p.stable_pose), p.why_not) for n, poses in found.items() for p in poses if p.why_not]
    sections = [table]
    if reasons:
        sections.append(Section(title="Poses that cannot be gripped", columns=("part", "face", "why"), rows=reasons))
    show(sections, f"time step {1e3 * CellConfig().timestep_s} ms", as_json=options.json)


if __name__ == "__main__":
    main()
