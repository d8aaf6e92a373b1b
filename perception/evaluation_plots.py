"""Every plot of an evaluation, from its outcomes alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from matplotlib.figure import Figure

from perception.evaluation_curves import (
    Rows,
    plot_covariance,
    plot_cumulative_errors,
    plot_mssd_recall,
    plot_risk_coverage,
)
from perception.evaluation_maps import plot_board_map, plot_confusion, plot_light
from perception.outcomes import Outcome
from perception.plot_style import save_figure

PLOTS: dict[str, Callable[[Rows], Figure]] = {
    "risk_coverage": plot_risk_coverage,
    "cumulative_errors": plot_cumulative_errors,
    "mssd_recall": plot_mssd_recall,
    "covariance": plot_covariance,
    "error_over_board": plot_board_map,
    "error_by_light": plot_light,
}
"""File name, without suffix -> plot of all methods; confusion matrices come on top, one for each method."""


def write_plots(outcomes: Iterable[Outcome], out: Path) -> list[Path]:
    """Draw all plots into the folder ``out`` as PNG; methods in the order in which they first come. Returns the paths.

    Raises ValueError when there are no outcomes.
    """
    rows: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        rows.setdefault(outcome.method, []).append(outcome)
    if not rows:
        raise ValueError("no outcomes: there is nothing to draw")
    written = [save_figure(plot(rows), out / f"{name}.png") for name, plot in PLOTS.items()]
    return written + [save_figure(plot_confusion(m, own), out / f"confusion_{m}.png") for m, own in rows.items()]
