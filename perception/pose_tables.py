"""Table 2: errors of poses by part, raw and refined, of all estimates and of those accepted, and what was decided.

Only whole parts count. A missed part has no error; it counts as missed, and as failed in the recall of MSSD. "Bad"
among the accepted are those of another class, face or yaw branch that the view tells apart, and those of no part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from perception.bootstrap import FrameBootstrap, clopper_pearson_lower, clopper_pearson_upper
from perception.metrics import summary
from perception.outcomes import COMPARISONS, ERRORS, SYMMETRIC, Outcome
from perception.references import MSSD_MM

ALL = "all"
"""The row of all parts together."""

SELECTIONS: dict[str, Callable[[Outcome], bool]] = {
    "all": lambda o: True,
    "right": lambda o: o.branch_right_equivalent,
    "accepted": lambda o: o.accepted,
    "accepted_right": lambda o: o.accepted and o.branch_right_equivalent,
}
"""Of which detected parts errors are summed up: "right" leaves out wrong classes, faces and yaw branches, which are
given as rates."""


def pose_table(outcomes: Sequence[Outcome], parts: Sequence[str], bootstrap: FrameBootstrap) -> dict[str, Any]:
    """By part, and over all of them, what ``part_figures`` gives."""
    counted = [o for o in outcomes if o.whole]
    table = {ALL: part_figures(counted, bootstrap)}
    for name in parts:
        table[name] = part_figures([o for o in counted if (o.part or o.estimated_part) == name], bootstrap)
    return table


def part_figures(rows: Sequence[Outcome], bootstrap: FrameBootstrap) -> dict[str, Any]:
    """Figures of some outcomes, strays among them.

    Errors are {mean, std, median, p95, n}; at the top they are those of all detected parts, refined, modulo the part's
    symmetries. ``refined`` and ``raw`` hold them by selection and comparison. ``n_open`` is the number of parts whose
    view leaves more than one pose open, ``open_reading_right`` the share of these with the right one among them.
    """
    there = [o for o in rows if o.is_part]
    seen = [o for o in there if o.detected]
    accepted = [o for o in rows if o.accepted]
    bad = [o for o in accepted if not o.branch_right_equivalent]
    strays = [o for o in rows if not o.is_part]
    refined = {name: _errors([o for o in seen if chosen(o)], raw=False) for name, chosen in SELECTIONS.items()}
    taken = [o for o in accepted if o.is_part]
    return {
        "n_parts": len(there),
        "n_detected": len(seen),
        "missed_share": _share(not o.detected for o in there),
        "n_strays": len(strays),
        "n_strays_accepted": sum(o.accepted for o in strays),
        **refined["all"][SYMMETRIC],
        "class_right": _share(o.class_right for o in seen),
        "face_right": _share(o.face_right for o in seen),
        "branch_right": _share(o.branch_right for o in seen),
        "branch_right_equivalent": _share(o.branch_right_equivalent for o in seen),
        "branch_right_lower_95": clopper_pearson_lower(sum(o.branch_right_equivalent for o in seen), len(seen)),
        "n_open": sum(o.readings > 1 for o in seen),
        "open_reading_right": _share(o.reading_right for o in seen if o.readings > 1),
        "flip_rate": _share(o.flipped for o in seen),
        "flip_rate_accepted": _share(o.flipped for o in taken),
        "accepted_share": _share(o.accepted for o in there),
        "accepted_share_of_detected": _share(o.accepted for o in seen),
        "n_accepted": len(accepted),
        "n_bad": len(bad),
        "bad_share": _share(not o.branch_right_equivalent for o in accepted),
        "bad_share_upper_95": clopper_pearson_upper(len(bad), len(accepted)),
        "mssd_recall": {f"{limit:g}": _share(_within(o, limit) for o in there) for limit in MSSD_MM},
        "refined": refined,
        "raw": {name: _errors([o for o in seen if chosen(o)], raw=True) for name, chosen in SELECTIONS.items()},
        "intervals_95": _intervals(there, seen, accepted, bootstrap),
    }


def error_values(rows: Sequence[Outcome], error: str, comparison: str = SYMMETRIC, *, raw: bool = False) -> list[float]:
    """One error of all rows that have it."""
    found = [o.raw_errors if raw else o.errors for o in rows]
    return [errors[comparison][error] for errors in found if errors is not None]


def _errors(rows: Sequence[Outcome], *, raw: bool) -> dict[str, dict[str, dict[str, float]]]:
    return {c: {e: summary(error_values(rows, e, c, raw=raw)) for e in ERRORS} for c in COMPARISONS}


def _intervals(
    there: Sequence[Outcome], seen: Sequence[Outcome], accepted: Sequence[Outcome], bootstrap: FrameBootstrap
) -> dict[str, Any]:
    """95 % bootstrap intervals over frames of the figures that matter most."""

    def of(rows: Sequence[Outcome], flag: Callable[[Outcome], bool]) -> tuple[float, float]:
        return bootstrap.mean([flag(o) for o in rows], [o.image for o in rows])

    out: dict[str, Any] = {
        "branch_right": of(seen, lambda o: o.branch_right),
        "branch_right_equivalent": of(seen, lambda o: o.branch_right_equivalent),
        "flip_rate": of(seen, lambda o: o.flipped),
        "missed_share": of(there, lambda o: not o.detected),
        "accepted_share": of(there, lambda o: o.accepted),
        "bad_share": of(accepted, lambda o: not o.branch_right_equivalent),
        "mssd_recall": {f"{limit:g}": of(there, lambda o, limit=limit: _within(o, limit)) for limit in MSSD_MM},
    }
    for name, chosen in SELECTIONS.items():
        rows = [o for o in seen if chosen(o) and o.errors is not None]
        frames = [o.image for o in rows]
        out[name] = {
            e: {
                "mean": bootstrap.mean(error_values(rows, e), frames),
                "median": bootstrap.quantile(error_values(rows, e), frames, 0.5),
                "p95": bootstrap.quantile(error_values(rows, e), frames, 0.95),
            }
            for e in ERRORS
        }
    return out


def _within(outcome: Outcome, limit_mm: float) -> bool:
    return outcome.mssd_mm is not None and outcome.mssd_mm <= limit_mm


def _share(flags: Any) -> float:
    """Share of true flags; NaN without any."""
    values = list(flags)
    return sum(values) / len(values) if values else float("nan")
