"""What contacts do to parts, by time step: python -m benchmarks.contact [--parts NAME ...].

Resting depth and drift on the board, the worst of all stable poses; squeeze, creep over 5 s and slip over a carry of
100 mm in the part's best grasp, with the force and speeds of picks. The shipped time step must meet the targets.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.tables import machine
from cad.parts import BUILT_IN, load_part
from scenes.workcell import CellConfig
from twin.contact_study import ContactStudyConfig, best_grasp, study_grip, study_rest

TARGETS = {"depth um": 5.0, "drift um/s": 0.05, "squeeze um": 30.0, "slip um": 30.0}
"""Largest values at the shipped time step."""


@dataclass(frozen=True, kw_only=True)
class ContactBenchmark:
    """Options of the benchmark."""

    parts: tuple[str, ...] = BUILT_IN
    """Parts to study."""
    parts_dir: Path | None = None
    """Folder of your own parts."""
    timesteps_ms: tuple[float, ...] = (2.0, 1.0, 0.5, 0.25)
    study: ContactStudyConfig = field(default_factory=ContactStudyConfig)
    json: bool = False
    """Print JSON instead of a table."""


def measure(options: ContactBenchmark) -> list[dict[str, float | str]]:
    """One row for each part and time step."""
    rows: list[dict[str, float | str]] = []
    for name in options.parts:
        part = load_part(name, options.parts_dir)
        grasp = best_grasp(part)
        for step_ms in options.timesteps_ms:
            config = replace(options.study, timestep_s=1e-3 * step_ms)
            rest, grip = study_rest(part, config), study_grip(part, grasp, config)
            rows.append(
                {
                    "part": name,
                    "step ms": step_ms,
                    "depth um": 1e6 * rest.penetration_m,
                    "drift um/s": 1e6 * rest.drift_m_s,
                    "squeeze um": 1e6 * grip.squeeze_m,
                    "creep um": 1e6 * grip.creep_m,
                    "slip um": 1e6 * grip.slip_m,
                }
            )
    return rows


def misses(rows: list[dict[str, float | str]]) -> list[str]:
    """What the shipped time step does not meet."""
    shipped = [row for row in rows if abs(float(row["step ms"]) - 1e3 * CellConfig().timestep_s) < 1e-9]
    return [
        f"{row['part']}: {name} is {float(row[name]):.3g}, allowed {most:g}"
        for row in shipped
        for name, most in TARGETS.items()
        if not float(row[name]) < most
    ]


def main(options: ContactBenchmark) -> None:
    """Measure, print, and exit with 1 when a target is missed."""
    rows = measure(options)
    missed = misses(rows)
    note = f"{machine()}; {options.study.pick.grip_force_n:g} N"
    if options.json:
        print(json.dumps({"machine": note, "rows": rows, "targets": TARGETS, "missed": missed}, indent=2))
        sys.exit(bool(missed))
    table = Table()
    for name in rows[0]:
        table.add_column(name, justify="left" if name == "part" else "right")
    for row in rows:
        table.add_row(*(value if isinstance(value, str) else f"{value:.3g}" for value in row.values()))
    table.add_section()
    table.add_row(
        "target at",
        f"{1e3 * CellConfig().timestep_s:g}",
        *(f"< {TARGETS[name]:g}" if name in TARGETS else "" for name in list(rows[0])[2:]),
    )
    console = Console()
    console.print(note, table, *missed, sep="\n")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main(tyro.cli(ContactBenchmark))
