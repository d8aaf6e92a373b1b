"""How a part comes to rest, for people: the table of its stable poses, where each number comes from, and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest

from cad.equivalence import axis_to_json
from cad.parts import Part, StablePose, ViewEquivalent
from cad.spatial import Array
from perception.view_equivalence import find_view_equivalents
from scenes.stable_poses import UPRIGHT, StablePoseConfig, StablePoseResult, find_stable_poses, write_stable_poses


@dataclass(frozen=True, kw_only=True, eq=False)
class StablePoseReport:
    """A part with its stable poses as just found, the drops they come from, and for each pose what looks like it."""

    part: Part
    result: StablePoseResult
    equivalents: tuple[tuple[ViewEquivalent, ...], ...]
    config: StablePoseConfig

    def write(self) -> None:
        """Write ``stable_poses.json`` into the part's folder."""
        write_stable_poses(self.part.folder, self.result, self.equivalents)

    def interval(self, pose: StablePose) -> tuple[float, float]:
        """The probability's 95 % interval by the drops (Clopper and Pearson)."""
        settled = len(self.result.settled_up)
        interval = binomtest(round(pose.probability * settled), settled).proportion_ci(method="exact")
        return float(interval.low), float(interval.high)

    def looks_like(self, index: int) -> list[int]:
        """The other poses that look like pose ``index`` from above."""
        return sorted({e.stable_pose for e in self.equivalents[index]} - {index})

    def as_json(self) -> dict[str, Any]:
        """Everything, the settled drops included; degrees where the key says so, else metres."""
        result = self.result
        roll, elevation = roll_and_elevation_deg(result.settled_up)
        return {
            "part": self.part.name,
            "drops": result.drops,
            "seed": self.config.seed,
            "unsettled": result.unsettled,
            "unassigned": result.unassigned,
            "total_variation": result.total_variation,
            "stable_poses": [self._pose_as_json(pose) for pose in result.poses],
            "settled": {
                "roll_deg": roll.round(2).tolist(),
                "x_elevation_deg": elevation.round(2).tolist(),
                "stable_pose": result.owner.tolist(),
            },
        }

    def _pose_as_json(self, pose: StablePose) -> dict[str, Any]:
        low, high = self.interval(pose)
        hull_deg = self.result.hull_deg[pose.index]
        return {
            "index": pose.index,
            "R_table_part": pose.R_table_part.tolist(),
            "height_m": pose.height_m,
            "probability": pose.probability,
            "probability_lower_95": low,
            "probability_upper_95": high,
            "quasi_static": self.result.quasi_static[pose.index],
            "roll_deg": roll_deg(pose),
            "rolls_about": axis_to_json(pose.roll) if pose.roll is not None else None,
            "looks_like": self.looks_like(pose.index),
            "hull_deg": None if math.isnan(hull_deg) else hull_deg,
            "spread_deg": self.result.spread_deg[pose.index],
        }


def stable_pose_report(
    part: Part, config: StablePoseConfig | None = None, progress: Callable[[float], None] = lambda done: None
) -> StablePoseReport:
    """Drop a part and find its stable poses and which of them look alike; nothing is written.

    ``progress`` is told the share of the drops that are over. Raises SceneError when the part comes to rest nowhere.
    """
    config = config or StablePoseConfig()
    result = find_stable_poses(part, config, progress)
    part = replace(part, stable_poses=result.poses)
    return StablePoseReport(part=part, result=result, equivalents=find_view_equivalents(part), config=config)


def roll_and_elevation_deg(ups: Array) -> tuple[Array, Array]:
    """Roll of the part about its x axis, -180 to 180 (0 with its z axis up), and how far its x axis points up, both in
    degrees, from the table's normal ``ups`` (..., 3) in the part's frame.
    """
    roll = np.degrees(np.arctan2(ups[..., 1], ups[..., 2]))
    return roll, np.degrees(np.arcsin(np.clip(ups[..., 0], -1.0, 1.0)))


def roll_deg(pose: StablePose) -> float | None:
    """Roll of a pose about the part's x axis in degrees, -180 to 180 with 180 upside down.

    None where it has none: with that axis near the vertical, or when the part rests at any turn about another one.
    """
    up = pose.R_table_part[2]
    if pose.roll is not None or np.hypot(up[1], up[2]) < UPRIGHT:
        return None
    return 180.0 - float((180.0 - roll_and_elevation_deg(up)[0]) % 360.0)


def print_stable_poses(report: StablePoseReport, console: Console | None = None) -> None:
    """The table, how well it explains the drops, and how far both sources of the probabilities are apart.

    ``to hull`` is the angle between the hull's face and where physics settles, ``drops`` the largest angle of a drop
    from the pose.
    """
    console = console or Console(highlight=False)
    result = report.result
    table = Table(
        title=f"{report.part.name}: stable poses", title_justify="left", box=SIMPLE_HEAD, padding=(0, 0, 0, 1)
    )
    headings = ("face", "prob-\nability", "95 %\ninterval", "quasi-\nstatic", "height\nmm", "roll\nabout x")
    for heading in (*headings, "looks\nlike", "to hull\ndeg", "drops\ndeg"):
        table.add_column(heading, justify="right", no_wrap=True)
    for pose in result.poses:
        low, high = report.interval(pose)
        hull_deg, roll = result.hull_deg[pose.index], roll_deg(pose)
        looks_like = [str(i) for i in report.looks_like(pose.index)]
        table.add_row(
            str(pose.index),
            f"{pose.probability:.3f}",
            f"{low:.3f}-{high:.3f}",
            f"{result.quasi_static[pose.index]:.3f}",
            f"{1e3 * pose.height_m + 0.0:.3f}",
            "any" if pose.roll is not None else "on end" if roll is None else f"{round(roll)}°",
            ", ".join(looks_like) or "-",
            "none" if math.isnan(hull_deg) else f"{hull_deg:.3f}",
            f"{result.spread_deg[pose.index]:.3f}",
        )
    console.print(table)
    settled = len(result.settled_up)
    console.print(
        f"{result.drops} drops: {result.drops - settled} unsettled; of the settled ones "
        f"{round(result.unassigned * settled)} ({100 * result.unassigned:.2f} %) in none of these poses"
    )
    console.print(f"total variation between drops and quasi-static probabilities: {result.total_variation:.3f}")
