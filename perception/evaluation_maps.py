"""Where errors are: over the board, over the light, and between which faces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from scipy.stats import beta

from cad.spatial import Array
from perception.outcomes import EQUIVALENT, Outcome
from perception.plot_style import BAD, FAINT, colour_of, new_figure, say_empty

Rows = Mapping[str, Sequence[Outcome]]
"""Outcomes by method."""

LIGHT_BINS = 6
Span = tuple[float, float]
_PANELS: tuple[tuple[str, Callable[[Outcome], float], Span, Span], ...] = (
    ("e_xy (mm)", lambda o: float(np.hypot(_error(o, "e_x_mm"), _error(o, "e_y_mm"))), (0.003, 1.0), (0.002, 10.0)),
    ("e_theta (degrees)", lambda o: _error(o, "e_theta_deg"), (0.01, 3.0), (0.005, 30.0)),
)
"""Title, error of an outcome, and the spans that colours and axes cover."""


def plot_board_map(rows: Rows) -> Figure:
    """Errors of parts on the right branch where they lie on the board; wrong branches and missed parts marked."""
    figure, grid = new_figure(len(rows), len(_PANELS), (4.8, 3.1), "Errors over the board", sharex=True, sharey=True)
    for row, (method, outcomes) in zip(grid, rows.items(), strict=True):
        parts = _whole(outcomes)
        right = [o for o in parts if o.detected and o.branch_right_equivalent]
        wrong = [o for o in parts if o.detected and not o.branch_right_equivalent]
        missed = [o for o in parts if not o.detected]
        for axes, (_, error, span, _) in zip(row, _PANELS, strict=True):
            values = [error(o) for o in right]
            axes.scatter(*_places(right), c=values, norm=LogNorm(*span), cmap="viridis", s=16, linewidths=0)
            axes.plot(*_places(wrong), "x", color=BAD, ms=7, mew=2, label=f"wrong branch: {len(wrong)}")
            axes.plot(*_places(missed), "o", mfc="none", mec="black", ms=8, label=f"missed: {len(missed)}")
            axes.set_aspect("equal")
            axes.grid(color="0.92")
            axes.set_axisbelow(True)
        row[0].set_ylabel(f"{method}\ny on the board (mm)")
        row[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=8, frameon=False)
    for axes, column, (label, _, span, _) in zip(grid[-1], zip(*grid, strict=True), _PANELS, strict=True):
        axes.set_xlabel("x on the board (mm)")
        colours = ScalarMappable(LogNorm(*span), "viridis")
        figure.colorbar(colours, ax=column, label=label, extend="both", location="bottom", fraction=0.04)
    return figure


def plot_light(rows: Rows) -> Figure:
    """Share on the right branch, and errors of those, against how bright a part's surroundings are."""
    title = "Errors against light: mean grey level round the part (lines: medians)"
    figure, ((share, *panels),) = new_figure(1, 3, (4.3, 3.6), title, sharex=True)
    levels = [o.brightness for outcomes in rows.values() for o in _whole(outcomes)]
    edges = np.unique(np.quantile(levels, np.linspace(0, 1, LIGHT_BINS + 1))) if levels else np.zeros(0)
    for axes in (share, *panels):
        axes.set_xlabel("grey level of 255")
        axes.grid(color="0.92")
        if edges.size < 2:
            say_empty(axes, "no two levels of light")
    if edges.size < 2:
        return figure
    for k, (method, outcomes) in enumerate(rows.items()):
        parts, colour = _whole(outcomes), colour_of(method, list(rows))
        bins = _bins(np.array([o.brightness for o in parts]), edges)
        middle, right, seen = [], [], []
        for b in range(edges.size - 1):
            own = [o for o, at in zip(parts, bins, strict=True) if at == b]
            if own:
                middle.append(float(np.mean([o.brightness for o in own])) + (k - (len(rows) - 1) / 2) * 0.8)
                right.append(sum(o.detected and bool(o.branch_right_equivalent) for o in own))
                seen.append(len(own))
        r, n = np.array(right), np.array(seen)
        low, high = np.nan_to_num(beta.ppf(0.025, r, n - r + 1)), np.nan_to_num(beta.ppf(0.975, r + 1, n - r), nan=1.0)
        bars = [r / n - low, high - r / n]
        share.errorbar(middle, r / n, bars, fmt="o-", color=colour, ms=4, capsize=2, label=method)
        for axes, (label, error, _, span) in zip(panels, _PANELS, strict=True):
            good = [o for o in parts if o.detected and o.branch_right_equivalent]
            values, at = np.array([error(o) for o in good]), np.array([o.brightness for o in good])
            axes.plot(at, np.clip(values, *span), ".", color=colour, ms=3, alpha=0.35)
            own_bins = _bins(at, edges)
            drawn = [b for b in range(edges.size - 1) if (own_bins == b).any()]
            axes.plot(
                [at[own_bins == b].mean() for b in drawn],
                [np.median(values[own_bins == b]) for b in drawn],
                "o-",
                color=colour,
                ms=4,
            )
            axes.set(yscale="log", ylim=span, ylabel=label)
    share.set(ylim=(-0.02, 1.02), ylabel="class, face and yaw branch right")
    share.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:.0f} %"))
    share.legend(loc="lower right", fontsize=8)
    return figure


def confusion(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], NDArray[np.int64]]:
    """Labels of the rows and columns of the faces' confusion matrix, and the matrix of counts.

    Rows are the true faces and, last, places where no part is; columns the estimated faces, then, apart from the
    diagonal, "turned" (right face, wrong yaw branch) and "missed".
    """
    parts = _whole(outcomes)
    false = [o for o in outcomes if o.whole and not o.is_part]
    true = {(o.part, o.stable_pose) for o in parts}
    found = {(o.estimated_part, o.estimated_stable_pose) for o in [*parts, *false] if o.estimated_part}
    faces = sorted(true | found)
    counts = np.zeros((len(faces) + 1, len(faces) + 2), np.int64)
    for o in [*parts, *false]:
        row = faces.index((o.part, o.stable_pose)) if o.is_part else len(faces)
        if o.is_part and not o.detected:
            column = len(faces) + 1
        elif o.is_part and o.class_right and o.face_right and not o.branch_right_equivalent:
            column = len(faces)
        else:
            column = faces.index((o.estimated_part, o.estimated_stable_pose))
        counts[row, column] += 1
    names = [f"{part} {pose}" for part, pose in faces]
    return [*names, "no part"], [*names, "turned", "missed"], counts


def plot_confusion(method: str, outcomes: Sequence[Outcome]) -> Figure:
    """True faces against estimated ones: counts, coloured by their share of the row."""
    rows, columns, counts = confusion(outcomes)
    side = 1.8 + 0.42 * len(columns)
    title = f"{method}: which face is taken for which (all whole parts)"
    figure, ((axes,),) = new_figure(1, 1, (side + 1.0, side), title)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    share[-1] = 0.0
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="equal")
    n = len(rows) - 1
    for i, j in zip(*np.nonzero(counts), strict=True):
        wrong = i != j and i < n
        colour = "white" if share[i, j] > 0.55 else (BAD if wrong else "black")
        weight = "bold" if wrong else "normal"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", color=colour, fontsize=8, fontweight=weight)
    for edge in range(1, n):
        if rows[edge].rsplit(" ", 1)[0] != rows[edge - 1].rsplit(" ", 1)[0]:
            axes.axhline(edge - 0.5, color=FAINT, linewidth=0.8)
            axes.axvline(edge - 0.5, color=FAINT, linewidth=0.8)
    axes.axhline(n - 0.5, color="black", linewidth=0.8)
    axes.axvline(n - 0.5, color="black", linewidth=0.8)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set(xlabel="estimated", ylabel="true")
    return figure


def _whole(outcomes: Sequence[Outcome]) -> list[Outcome]:
    return [o for o in outcomes if o.whole and o.is_part]


def _places(outcomes: Sequence[Outcome]) -> Array:
    """Where they lie on the board, (2, N)."""
    return np.reshape([(o.x_board_mm, o.y_board_mm) for o in outcomes], (-1, 2)).T


def _bins(levels: Array, edges: Array) -> NDArray[np.int64]:
    return np.clip(np.searchsorted(edges, levels, side="right") - 1, 0, edges.size - 2)


def _error(outcome: Outcome, name: str) -> float:
    """An error modulo what the view cannot tell apart; infinite where there is no estimate."""
    return float(outcome.errors[EQUIVALENT][name]) if outcome.errors else np.inf
