"""Where errors come from: confusion of class, face and yaw; figures by place on the board, by light and by face; and
whether covariances hold.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from perception.metrics import summary
from perception.outcomes import SYMMETRIC, Outcome
from perception.pose_tables import ALL

MISSED, NOTHING = "missed", "no part"
BINS = 4
"""Bins of equally many parts."""


def confusion(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Counts of whole parts: ``class`` {true: {taken for}}, with what was missed and detections of no part; ``face``
    {part: {true stable pose: {taken for}}} where the class is right; ``flip`` {part: {right, flipped, other}} of yaws
    where the face is.
    """
    classes: dict[str, Counter[str]] = defaultdict(Counter)
    faces: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    flips: dict[str, Counter[str]] = defaultdict(Counter)
    for o in outcomes:
        if not o.whole:
            continue
        classes[o.part or NOTHING][o.estimated_part if o.detected or not o.is_part else MISSED] += 1
        if o.class_right:
            faces[o.part][str(o.stable_pose)][str(o.estimated_stable_pose)] += 1
        if o.face_right:
            flips[o.part]["right" if o.branch_right else "flipped" if o.flipped else "other"] += 1
    return {
        "class": {true: dict(sorted(row.items())) for true, row in sorted(classes.items())},
        "face": {
            part: {true: dict(sorted(row.items())) for true, row in sorted(rows.items())}
            for part, rows in sorted(faces.items())
        },
        "flip": {
            part: {kind: row[kind] for kind in ("right", "flipped", "other")} for part, row in sorted(flips.items())
        },
    }


def by_position(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Figures by distance in mm from the board's centre, in bins of equally many parts."""
    there = [o for o in outcomes if o.is_part and o.whole]
    return _binned(there, [float(np.hypot(o.x_board_mm, o.y_board_mm)) for o in there])


def by_brightness(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Figures by the mean grey level round the part, in bins of equally many parts."""
    there = [o for o in outcomes if o.is_part and o.whole]
    return _binned(there, [o.brightness for o in there])


def by_face(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Figures by part and stable pose."""
    groups: dict[tuple[str, int], list[Outcome]] = defaultdict(list)
    for o in outcomes:
        if o.is_part and o.whole:
            groups[o.part, o.stable_pose].append(o)
    return [{"part": part, "stable_pose": k} | group_figures(rows) for (part, k), rows in sorted(groups.items())]


def group_figures(rows: Sequence[Outcome]) -> dict[str, float]:
    """Of some parts: ``n``, recall, branch right (of those detected), accepted share, and medians of the planar error
    (mm) and the angle (degrees) where the branch is right.
    """
    seen = [o for o in rows if o.detected]
    errors = [o.errors[SYMMETRIC] for o in seen if o.branch_right_equivalent and o.errors is not None]
    return {
        "n": len(rows),
        "recall": _mean([o.detected for o in rows]),
        "branch_right": _mean([o.branch_right_equivalent for o in seen]),
        "accepted_share": _mean([o.accepted for o in rows]),
        "e_xy_mm_median": _median([float(np.hypot(e["e_x_mm"], e["e_y_mm"])) for e in errors]),
        "e_theta_deg_median": _median([e["e_theta_deg"] for e in errors]),
    }


def covariance_figures(outcomes: Sequence[Outcome], parts: Sequence[str]) -> dict[str, Any]:
    """By part, and over all, of accepted whole parts with the branch right: how the normalised error squared compares
    with chi-square of 6 degrees of freedom (``nees``), and of 3 for x, y and yaw (``nees_planar``).
    """
    rows = [o for o in outcomes if o.is_part and o.whole and o.accepted and o.branch_right]
    return {
        name: {
            "nees": consistency([o.nees for o in rows if name in (ALL, o.part) and o.nees is not None], 6),
            "nees_planar": consistency(
                [o.nees_planar for o in rows if name in (ALL, o.part) and o.nees_planar is not None], 3
            ),
        }
        for name in (ALL, *parts)
    }


def consistency(values: Sequence[float], freedom: int) -> dict[str, Any]:
    """Mean with the 95 % bounds that it keeps if the covariance holds (parts taken as independent), median, and the
    share of values within the 95 % quantile of chi-square, which should be 0.95.
    """
    figures = summary(values)
    n, limit = int(figures["n"]), float(chi2.ppf(0.95, freedom))
    low, high = (float(chi2.ppf(q, freedom * n) / n) if n else float("nan") for q in (0.025, 0.975))
    return {
        "freedom": freedom,
        "n": n,
        "mean": figures["mean"],
        "mean_bounds_95": [low, high],
        "within_bounds": bool(low <= figures["mean"] <= high),
        "median": figures["median"],
        "median_expected": float(chi2.ppf(0.5, freedom)),
        "within_95": _mean([v <= limit for v in values]),
    }


def _binned(rows: Sequence[Outcome], keys: Sequence[float]) -> list[dict[str, Any]]:
    order = np.argsort(keys, kind="stable")
    return [
        {"from": float(keys[part[0]]), "to": float(keys[part[-1]])} | group_figures([rows[i] for i in part])
        for part in np.array_split(order, BINS)
        if len(part)
    ]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")
