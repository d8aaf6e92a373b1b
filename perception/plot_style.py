"""How the plots of an evaluation look: one colour a method, one way to lay out, and to write, a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cad.files import replacing

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito: for the colour-blind
METHOD_COLOURS = {"tagcell": COLOURS[0], "pvnet-refined": COLOURS[1], "pvnet": COLOURS[4]}
BAD, FAINT = "#C00000", "0.6"


def new_figure(
    rows: int,
    columns: int,
    panel_inches: tuple[float, float],
    title: str,
    *,
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of ``rows`` x ``columns`` axes, each of about ``panel_inches`` (width, height), and the rows of axes."""
    size = (columns * panel_inches[0], rows * panel_inches[1] + 0.4)
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
    figure.suptitle(title, fontsize=11)
    return figure, axes.tolist()


def colour_of(method: str, methods: Sequence[str]) -> str:
    """Colour of a method among those that are compared."""
    if method in METHOD_COLOURS:
        return METHOD_COLOURS[method]
    left = [colour for colour in COLOURS if colour not in METHOD_COLOURS.values()]
    return left[[m for m in methods if m not in METHOD_COLOURS].index(method) % len(left)]


def say_empty(axes: Axes, what: str) -> None:
    """Write into axes that there is nothing to draw."""
    axes.text(0.5, 0.5, what, transform=axes.transAxes, ha="center", va="center", color=FAINT)


def step_curve(axes: Axes, values: Sequence[float], total: int, **style: Any) -> None:
    """Share of ``total`` that is at most x, as a step for each of ``values``; what is not finite is never reached."""
    finite = np.sort([v for v in values if np.isfinite(v)])
    if total and finite.size:
        low, high = axes.get_xlim()
        x = np.concatenate([[low], finite, [high]])
        axes.step(x, np.concatenate([[0], np.arange(1, finite.size + 1), [finite.size]]) / total, where="post", **style)
        axes.set_xlim(low, high)


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG; returns the path."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return path
