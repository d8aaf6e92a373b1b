"""Pictures of training curves: loss terms and validation figures over minutes, from the CSV that training writes."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cad.spatial import Array

VALIDATION = "val_"
"""Names of columns with figures on validation data begin with this."""


def read_curves(path: Path) -> dict[str, Array]:
    """Columns of a CSV of curves, each (R,), NaN where a row has no value."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {name: np.array([float(row[name]) if row[name] else np.nan for row in rows]) for name in names}


def plot_curves(csv_path: Path) -> Path:
    """Write ``NAME.png`` beside ``NAME.csv`` and return its path: losses above, validation figures below."""
    curves = read_curves(csv_path)
    minutes = curves["minutes"]
    losses = [name for name in curves if name not in ("step", "minutes") and not name.startswith(VALIDATION)]
    figures = [name for name in curves if name.startswith(VALIDATION)]
    figure = Figure(figsize=(7.0, 6.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    for name in losses:
        above.plot(minutes, curves[name], label=name, linewidth=1.2)
    above.set(yscale="log", ylabel="loss term", title=f"{csv_path.stem}: {int(curves['step'][-1])} steps")
    for name in figures:
        known = np.isfinite(curves[name])
        top = max(1.0, float(np.nanmax(np.abs(curves[name])))) if known.any() else 1.0
        label = name.removeprefix(VALIDATION) + (f" / {top:.3g}" if top > 1.0 else "")
        below.plot(minutes[known], curves[name][known] / top, marker=".", label=label, linewidth=1.2)
    below.set(xlabel="minutes of training", ylabel="on validation data", ylim=(-0.02, 1.02))
    for axes, shown in ((above, losses), (below, figures)):
        axes.grid(color="0.92")
        if shown:
            axes.legend(fontsize=8, ncols=3)
    out = csv_path.with_suffix(".png")
    aside = out.with_name(f".{out.stem}.part.png")
    figure.savefig(aside)
    os.replace(aside, out)
    return out
