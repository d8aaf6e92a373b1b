"""Tables that benchmarks print, on a terminal or as JSON, with the machine they were measured on."""

from __future__ import annotations

import json
import os
import platform
import sys
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from scenes.gl import mujoco

_FILE_WIDTH = 160  # columns, so that nothing is cut in a file or a pipe


@dataclass(frozen=True, kw_only=True)
class Section:
    """One table: a title, column heads and rows."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def machine() -> str:
    """Processor, cores and the versions that matter."""
    return (
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, mujoco {mujoco.__version__}"
    )


def show(sections: list[Section], note: str, *, as_json: bool) -> None:
    """Print the tables, the machine and ``note``, such as time step and seed."""
    if as_json:
        tables = {s.title: [dict(zip(s.columns, row, strict=True)) for row in s.rows] for s in sections}
        print(json.dumps({"machine": machine(), "note": note, "tables": tables}, indent=2))
        return
    console = Console() if sys.stdout.isatty() else Console(width=_FILE_WIDTH)
    for section in sections:
        table = Table(*section.columns, title=section.title, title_justify="left")
        for row in section.rows:
            table.add_row(*row)
        console.print(table)
    console.print(f"{machine()}; {note}", highlight=False)
