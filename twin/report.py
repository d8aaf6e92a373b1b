"""Scorecards on the terminal, and progress while they are made."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from twin.scorecard import SceneResult


class ScenesProgress:
    """Progress of a pick run: a bar on a terminal, a line a scene elsewhere, nothing when ``quiet``."""

    def __init__(self, scenes: int, *, quiet: bool) -> None:
        self._scenes, self._started = scenes, time.monotonic()
        self._console = Console(stderr=True, quiet=quiet)
        self._bar = Progress(
            TextColumn("picking"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("scenes, {task.fields[state]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=quiet or not self._console.is_terminal,
        )
        self._task = self._bar.add_task("picking", total=scenes, state="no part yet")

    def __enter__(self) -> ScenesProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, results: Sequence[SceneResult]) -> None:
        """Tell how far the run is after the scenes in ``results``."""
        parts = [p for r in results for p in r.parts]
        state = f"{sum(p.succeeded for p in parts)} of {len(parts)} parts succeeded"
        self._bar.update(self._task, completed=len(results), state=state)
        if not self._console.is_terminal:
            elapsed = time.monotonic() - self._started
            left = elapsed / len(results) * (self._scenes - len(results))
            self._console.print(f"scene {len(results)} of {self._scenes}, {state}, {left:.0f} s left", soft_wrap=True)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def print_scorecard(card: dict[str, Any], out: Path) -> None:
    """Success with its bound, failures by cause, errors by part, cycle time."""
    console = Console()
    picks = card["picks"]
    table = Table(title=f"{card['config']['estimator']} estimator, seed {card['config']['seed']}", title_justify="left")
    for column in (
        "part",
        "shown",
        "good",
        "rate",
        "x mm",
        "y mm",
        "z mm",
        "theta",
        "branch",
    ):
        table.add_column(column, justify="left" if column == "part" else "right")
    names = [*dict.fromkeys(p["part"] for p in card["parts"]), "all"]
    for name in names:
        rows = [p for p in card["parts"] if name in ("all", p["part"])]
        good = sum(p["succeeded"] for p in rows)
        error = card["pose_error"].get(name, {})
        right = card["pose_error_branch_right"].get(name, {})
        table.add_row(
            name,
            str(len(rows)),
            str(good),
            f"{good / len(rows):.3f}",
            *(_number(right.get(k, {}).get("mean")) for k in ("e_x_mm", "e_y_mm", "e_z_mm", "e_theta_deg")),
            _number(error.get("branch_right")),
            end_section=name == names[-2],
        )
    console.print(table)
    console.print(
        "x, y, z, theta: mean errors (mm, degrees) of the parts of the first look whose class, face and yaw branch are "
        "right; branch: their share"
    )
    failures = ", ".join(f"{k} {v}" for k, v in card["failures"].items() if v) or "none"
    console.print(
        f"succeeded {picks['succeeded']} of {picks['presented']} presented "
        f"(at least {picks['success_lower_95']:.3f} with 95 % confidence), {picks['retries']} retries; "
        f"failures: {failures}"
    )
    place = card["place_error"]["all"]
    console.print(
        f"place error mean {_number(place['e_mm']['mean'])} mm, p95 {_number(place['e_mm']['p95'])} mm; "
        f"cycle {_number(card['cycle_s']['mean'], 2)} s simulated, {card['picks_per_hour']:.0f} picks an hour"
    )
    for kind, row in card["second_looks"].items():
        console.print(
            f"second looks, {kind}: {row['looks']} in {row['seconds']:.1f} s simulated, {row['accepted']} accepted"
        )
    console.print(f"{out / 'scorecard.json'}", soft_wrap=True)
