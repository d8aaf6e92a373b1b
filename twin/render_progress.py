"""How a data set comes along: one line that is updated on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from scenes.generate import Progress

EVERY_S = 5.0


@contextmanager
def image_progress(name: str, console: Console | None = None) -> Iterator[Callable[[Progress], None]]:
    """Yields what is to be told how far the data set ``name`` is; writes to standard error."""
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), TextColumn("{task.fields[told]}"))
    told_at = time.monotonic()
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=None, told="starting")

        def report(progress: Progress) -> None:
            nonlocal told_at
            text = describe(progress)
            bar.update(task, completed=progress.done, total=progress.total, told=text)
            now = time.monotonic()
            if not console.is_terminal and now - told_at >= EVERY_S:
                told_at = now
                console.print(f"{name}: {text}", highlight=False, soft_wrap=True)

        yield report


def describe(progress: Progress) -> str:
    """Images, images a second of this run, time left."""
    text = f"{progress.done} of {progress.total} images"
    if progress.seconds_left is None:
        return text
    return f"{text}, {progress.rate:.3g} images/s, {timedelta(seconds=round(progress.seconds_left))} left"
