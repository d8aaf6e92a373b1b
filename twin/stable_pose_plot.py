"""Probability of a part's stable poses over its roll about x, with every settled drop and a picture of each pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnnotationBbox, OffsetImage
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from scenes.part_preview import TILE_PX, contact_sheet
from twin.stable_pose_report import StablePoseReport, roll_and_elevation_deg, roll_deg

_BAR_DEG = 9.0
_SEAM_DEG = -172.0  # rolls below are drawn past +180, so that a part on its back is in one place
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito: for the colour-blind
_LEFT_OVER = "#555555"
_ZOOM = 0.4
_PITCH_DEG = 66.0  # between pictures over the roll
_PITCH_APART = 66.0
_TICKS = np.arange(-180, 181, 45)


def plot_stable_poses(report: StablePoseReport, path: Path) -> None:
    """Write the plot to ``path`` (PNG, SVG or PDF by its suffix).

    Above: a picture of each pose, and over its roll about the part's x axis the probability by drops (bar, 95 %
    interval) and quasi-static (white diamond). Poses with that axis upright, or with any roll, stand apart on the
    right. Below: where every settled drop lies, by its roll and by how far its x axis points up.
    """
    figure = Figure(figsize=(9.0, 6.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    rolled, apart = _placed_bars(report)
    width = 0.5 + 0.85 * max(1, len(apart))
    grid = figure.add_gridspec(3, 2, width_ratios=[6.0, width], height_ratios=[1.15, 2.2, 1.8])
    above, bars = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    above_apart, bars_apart = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1], sharey=bars)
    drops, legend = figure.add_subplot(grid[2, 0]), figure.add_subplot(grid[2, 1])
    pictures = _pictures(report)
    _draw_bars(bars, above, report, rolled, pictures, (-185.0, 195.0))
    half = _PITCH_APART * max(1, len(apart)) / 2
    _draw_bars(bars_apart, above_apart, report, apart, pictures, (-half, half))
    top = max(max(report.interval(pose)[1] for pose in report.result.poses), *report.result.quasi_static)
    bars.set_ylim(0.0, min(1.02, 1.08 * top))
    bars.set_ylabel("probability")
    bars.set_xticks(_TICKS)
    bars.tick_params(labelbottom=False)
    bars_apart.set_xticks([])
    bars_apart.tick_params(labelleft=False)
    above.set_title(f"{report.part.name}: how it comes to rest ({report.result.drops} drops)", loc="left", pad=10)
    above_apart.set_title("x upright, or any roll", fontsize=9, pad=10)
    _draw_drops(drops, report)
    _draw_legend(legend, report)
    figure.savefig(path)


def _placed_bars(report: StablePoseReport) -> tuple[dict[int, float], dict[int, float]]:
    """Where the bars of poses with a roll, and of the others, are drawn: by pose the place on the abscissa."""
    rolled: dict[int, float] = {}
    apart: list[int] = []
    for pose in report.result.poses:
        roll = roll_deg(pose)
        if roll is None:
            apart.append(pose.index)
            continue
        place = float(_across_seam(np.array(roll)))
        while any(abs(place - other) < _BAR_DEG for other in rolled.values()):
            place += 1.1 * _BAR_DEG if place < 90 else -1.1 * _BAR_DEG
        rolled[pose.index] = place
    middle = (len(apart) - 1) / 2
    return rolled, {index: _PITCH_APART * (i - middle) for i, index in enumerate(apart)}


def _pictures(report: StablePoseReport) -> list[NDArray[np.uint8]]:
    """The slanted view of each pose."""
    sheet = contact_sheet(report.part)[TILE_PX:]
    return [sheet[:, i * TILE_PX : (i + 1) * TILE_PX] for i in range(len(report.result.poses))]


def _draw_bars(
    axes: Axes,
    above: Axes,
    report: StablePoseReport,
    places: dict[int, float],
    pictures: list[NDArray[np.uint8]],
    span: tuple[float, float],
) -> None:
    """Bars in ``axes`` over ``span`` of the abscissa, and a picture for each in the strip ``above``."""
    above.axis("off")
    above.set_ylim(0.0, 1.0)
    for panel in (axes, above):
        panel.set_xlim(*span)
    order = sorted(places, key=places.__getitem__)
    middles = _spread([places[index] for index in order], span)
    for index, middle in zip(order, middles, strict=True):
        pose, place, colour = report.result.poses[index], places[index], _colour(index)
        low, high = report.interval(pose)
        quasi_static = report.result.quasi_static[index]
        axes.bar(place, pose.probability, width=_BAR_DEG, color=colour, zorder=2)
        axes.vlines(place, low, high, color="black", linewidth=1.2, zorder=3)
        axes.plot(place, quasi_static, "D", color="white", mec="black", ms=6, zorder=4)
        axes.annotate(
            "",
            (place, max(high, quasi_static)),
            (middle, 0.1),
            textcoords=above.transData,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 1.0, "shrinkB": 6.0},
        ).set_in_layout(False)
        zoom = _ZOOM * min(1.0, 6.0 / max(1, len(order)))
        frame = {"edgecolor": colour, "linewidth": 1.5}
        box = AnnotationBbox(OffsetImage(pictures[index], zoom=zoom), (middle, 0.47), pad=0.1, bboxprops=frame)
        box.set_in_layout(False)
        above.add_artist(box)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)


def _spread(places: list[float], span: tuple[float, float]) -> list[float]:
    """Middles of pictures as near to ``places`` (ascending) as they fit into ``span`` side by side."""
    if not places:
        return []
    pitch = min(_PITCH_DEG, (span[1] - span[0]) / len(places))
    steps = pitch * np.arange(len(places))
    low, high = span[0] + pitch / 2, span[1] - pitch / 2
    fitted = isotonic_regression(np.array(places) - steps).x + steps
    return np.clip(fitted, low + steps, high - steps[::-1]).tolist()


def _draw_drops(axes: Axes, report: StablePoseReport) -> None:
    result = report.result
    roll, elevation = roll_and_elevation_deg(result.settled_up)
    colours = [_LEFT_OVER if owner < 0 else _colour(int(owner)) for owner in result.owner]
    axes.scatter(_across_seam(roll), elevation, s=14, c=colours, alpha=0.6, linewidths=0)
    axes.set_xlim(-185.0, 195.0)
    axes.set_xticks(_TICKS)
    axes.set_ylim(-100.0, 100.0)
    axes.set_yticks([-90, -45, 0, 45, 90])
    axes.set_xlabel("roll about the part's x axis (degrees; 0: its z axis points up)")
    axes.set_ylabel("x axis up by (degrees)")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)


def _draw_legend(axes: Axes, report: StablePoseReport) -> None:
    axes.axis("off")
    result = report.result
    lines = [(_colour(pose.index), "s", f"face {pose.index}") for pose in result.poses]
    handles = [axes.plot([], [], marker, color=colour, label=label)[0] for colour, marker, label in lines]
    handles += axes.plot([], [], "-", color="black", label="95 % interval")
    handles += axes.plot([], [], "D", color="white", mec="black", label="quasi-static")
    handles += axes.plot([], [], ".", color=_LEFT_OVER, label=f"unassigned: {100 * result.unassigned:.2f} %")
    axes.legend(handles=handles, loc="upper left", fontsize=8, frameon=False, borderaxespad=0.0)


def _across_seam(roll: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(roll < _SEAM_DEG, roll + 360.0, roll)


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]
