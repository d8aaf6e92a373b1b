"""Curves of an evaluation: risk over coverage, cumulative errors, MSSD recall, and whether covariances hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter
from scipy.stats import beta, chi2

from cad.spatial import Array
from perception.bootstrap import clopper_pearson_upper
from perception.outcomes import SYMMETRIC, Outcome
from perception.plot_style import COLOURS, FAINT, colour_of, new_figure, say_empty, step_curve
from perception.references import BAD_SHARE, MSSD_MM, PAPER_REFINED

Rows = Mapping[str, Sequence[Outcome]]
"""Outcomes by method."""

ERRORS = {"e_x_mm": "e_x (mm)", "e_y_mm": "e_y (mm)", "e_z_mm": "e_z (mm)", "e_theta_deg": "e_theta (degrees)"}
_SPANS = {"e_x_mm": (1e-3, 30.0), "e_y_mm": (1e-3, 30.0), "e_z_mm": (1e-3, 300.0), "e_theta_deg": (1e-2, 180.0)}


def risk_coverage(outcomes: Sequence[Outcome]) -> tuple[Array, Array, Array]:
    """Coverage, share of bad among the accepted, and of wrong branches alone, each (K,), accepting ever lower scores.

    Coverage is the share of all whole parts, so it ends at the share that is found. Bad are wrong branches and
    detections of no part. A point is kept for each score at which something is accepted, from the first part on.
    """
    wanted = sum(o.whole and o.is_part for o in outcomes)
    seen = [o for o in outcomes if o.whole and (o.detected or not o.is_part)]
    score = np.array([o.score for o in seen], np.float64)
    order = np.argsort(-score, kind="stable")
    false = np.cumsum([not seen[i].is_part for i in order])
    wrong = np.cumsum([seen[i].is_part and not seen[i].branch_right_equivalent for i in order])
    accepted = np.arange(1, len(order) + 1) - false
    last_of_tie = np.append(np.diff(score[order]) < 0, True)[: len(order)]
    keep = (accepted > 0) & last_of_tie
    accepted, false, wrong = accepted[keep], false[keep], wrong[keep]
    return accepted / max(wanted, 1), (wrong + false) / (accepted + false), wrong / accepted


def plot_risk_coverage(rows: Rows) -> Figure:
    """Share of bad among the accepted against the accepted share; a dot where each method's gate is set."""
    title = "What would be bad among the accepted, if more or fewer were accepted"
    figure, ((axes,),) = new_figure(1, 1, (7.5, 4.8), title)
    for method, outcomes in rows.items():
        coverage, bad, wrong = risk_coverage(outcomes)
        if not coverage.size:
            continue
        colour = colour_of(method, list(rows))
        axes.step(coverage, bad, where="post", color=colour, label=f"{method}: wrong branch or no part")
        axes.step(coverage, wrong, where="post", color=colour, linestyle=":", label="wrong branch only")
        parts = sum(o.whole and o.is_part for o in outcomes)
        accepted = [o for o in outcomes if o.whole and o.accepted]
        if accepted and parts:
            at = sum(o.is_part for o in accepted) / parts
            n_bad = sum(not o.branch_right_equivalent for o in accepted)
            share, most = n_bad / len(accepted), clopper_pearson_upper(n_bad, len(accepted))
            said = f"gate: {at:.1%} accepted, {share:.2%} bad (at most {most:.2%})"
            axes.plot(at, share, "o", color=colour, mec="black", ms=8, zorder=5, label=said)
    axes.axhline(BAD_SHARE, color=FAINT, linestyle="--", linewidth=1)
    axes.set_yscale("symlog", linthresh=0.01, linscale=0.8)
    axes.yaxis.set_major_locator(FixedLocator([0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]))
    axes.yaxis.set_minor_locator(FixedLocator([]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{100 * x:.0f} %"))
    axes.set(xlim=(0.0, 1.005), ylim=(-5e-4, 1.0), xlabel="accepted, of all whole parts", ylabel="bad, of the accepted")
    axes.grid(color="0.92")
    if axes.lines[:-1]:
        axes.legend(loc="upper left", fontsize=8)
    else:
        say_empty(axes, "no part was found")
    return figure


def plot_cumulative_errors(rows: Rows) -> Figure:
    """Share of all whole parts with an error of at most x, by part and error; the paper's means as lines."""
    parts = sorted({o.part for outcomes in rows.values() for o in outcomes if o.is_part})
    title = "Cumulative errors over all whole parts, wrong branches and missed ones among them (dot: mean)"
    figure, grid = new_figure(max(1, len(parts)), len(ERRORS), (3.3, 2.4), title, sharey=True)
    for row, part in zip(grid, parts, strict=False):
        for axes, (error, label) in zip(row, ERRORS.items(), strict=True):
            axes.set(xscale="log", xlim=_SPANS[error], ylim=(0.0, 1.02))
            for method, outcomes in rows.items():
                colour, own = colour_of(method, list(rows)), [o for o in outcomes if o.whole and o.part == part]
                values = [_error(o, error) for o in own]
                step_curve(axes, values, len(own), color=colour, label=method)
                found = [v for v in values if np.isfinite(v)]
                if found:
                    axes.plot(np.mean(found), np.mean(np.array(values) <= np.mean(found)), "o", color=colour, ms=5)
            if part in PAPER_REFINED:
                axes.axvline(
                    PAPER_REFINED[part][error], color="black", linestyle="--", linewidth=1, label="paper, mean"
                )
            axes.grid(color="0.92")
            if row is grid[-1]:
                axes.set_xlabel(label)
        row[0].set_ylabel(f"{part}\nshare")
    if parts:
        figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def plot_mssd_recall(rows: Rows) -> Figure:
    """Share of whole parts whose surface is nowhere further off than x: all parts, then each."""
    parts = sorted({o.part for outcomes in rows.values() for o in outcomes if o.is_part})
    title = "Recall by maximum symmetry-aware surface distance"
    figure, (panels,) = new_figure(1, 1 + len(parts), (3.2, 3.0), title, sharey=True)
    for axes, part in zip(panels, [None, *parts], strict=True):
        axes.set(xscale="log", xlim=(0.005, 20.0), ylim=(0.0, 1.02), title=part or "all parts", xlabel="MSSD (mm)")
        for mark in MSSD_MM:
            axes.axvline(mark, color="0.9", linewidth=1, zorder=0)
        for method, outcomes in rows.items():
            own = [o for o in outcomes if o.whole and o.is_part and part in (None, o.part)]
            values = [np.inf if o.mssd_mm is None or not o.detected else o.mssd_mm for o in own]
            step_curve(axes, values, len(own), color=colour_of(method, list(rows)), label=method)
        axes.grid(axis="y", color="0.92")
    panels[0].set_ylabel("recall")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def plot_covariance(rows: Rows) -> Figure:
    """Quantiles of the normalised error squared of accepted parts on the right branch, against chi-square's; part by
    part, too, when only one method states covariances.
    """
    figure, (panels,) = new_figure(1, 2, (4.6, 4.6), "Do the covariances hold? Accepted parts on the right branch")
    kinds = (("nees_planar", 3, "x, y, yaw (3 degrees of freedom)"), ("nees", 6, "all six degrees of freedom"))
    for axes, (name, degrees, title) in zip(panels, kinds, strict=True):
        axes.set_title(title, fontsize=10)
        drawn = {method: good for method, own in rows.items() if (good := _with_covariance(own, name))}
        for method, good in drawn.items():
            values = np.array([getattr(o, name) for o in good])
            _draw_band(axes, len(good), degrees)
            _draw_quantiles(axes, values, degrees, method, color=colour_of(method, list(rows)), marker=".", ms=4, lw=0)
            for k, part in enumerate(sorted({o.part for o in good}) if len(drawn) == 1 else []):
                own = np.array([getattr(o, name) for o in good if o.part == part])
                _draw_quantiles(axes, own, degrees, part, color=COLOURS[(k + 1) % len(COLOURS)], lw=1)
        if not drawn:
            say_empty(axes, "no covariances of accepted parts")
            continue
        low, high = chi2.ppf([1e-3, 0.9995], degrees)
        axes.plot([low, high], [low, high], color="black", linewidth=1)
        axes.axvline(float(chi2.ppf(0.95, degrees)), color=FAINT, linestyle="--", linewidth=1)
        axes.set(xscale="log", yscale="log", xlabel=f"chi-square quantile, {degrees} dof")
        axes.set_ylabel("normalised error squared, quantile")
        axes.grid(color="0.92")
        axes.legend(loc="upper left", fontsize=7, title="within the 95 % bound", title_fontsize=7)
    return figure


def _with_covariance(outcomes: Sequence[Outcome], name: str) -> list[Outcome]:
    """Accepted parts on the right branch that have this normalised error."""
    good = [o for o in outcomes if o.whole and o.is_part and o.accepted and o.branch_right_equivalent]
    return [o for o in good if getattr(o, name) is not None]


def _draw_band(axes: Axes, n: int, degrees: int) -> None:
    """Where 95 % of samples of ``n`` would lie."""
    rank = np.arange(1, n + 1)
    low, high = (chi2.ppf(beta.ppf(q, rank, n - rank + 1), degrees) for q in (0.025, 0.975))
    axes.fill_between(chi2.ppf((rank - 0.5) / n, degrees), low, high, color=FAINT, alpha=0.25, linewidth=0)


def _draw_quantiles(axes: Axes, values: Array, degrees: int, what: str, **style: Any) -> None:
    n = values.size
    within = np.mean(values <= chi2.ppf(0.95, degrees))
    expected = chi2.ppf((np.arange(1, n + 1) - 0.5) / n, degrees)
    axes.plot(expected, np.sort(values), label=f"{what}: {100 * within:.1f} % of {n}", **style)


def _error(outcome: Outcome, name: str) -> float:
    """An error under the part's proper symmetries; infinite where there is no estimate."""
    if not outcome.detected or not outcome.errors:
        return np.inf
    return float(outcome.errors[SYMMETRIC][name])
