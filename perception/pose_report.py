"""What an evaluation says about poses, as Markdown, from the content of ``evaluation.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from perception.evaluation_tables import BASELINE, BASELINE_RAW
from perception.markdown import markdown_table, number, share
from perception.outcomes import COMPARISONS, ERRORS, SYMMETRIC
from perception.pose_tables import ALL
from perception.references import PAPER_RAW, PAPER_REFINED

Tables = Mapping[str, Any]
STAGES = ["raw", "refined"]
ERROR_NAMES = {"e_x_mm": "e_x mm", "e_y_mm": "e_y mm", "e_z_mm": "e_z mm", "e_theta_deg": "e_theta deg"}
_KNOWN_AS = {
    "strict": "as they stand (strict)",
    "symmetric": "modulo the part's proper symmetries",
    "equivalent": "modulo what looks the same from above",
}


def table_2(tables: Tables) -> str:
    """By comparison, those that give the same figures together, all that were found and accepted ones apart."""
    text = ["## Table 2: poses, mean ± standard deviation, median, p95"]
    for comparisons in _distinct_comparisons(tables):
        how = " = ".join(_KNOWN_AS[c] for c in comparisons)
        text.append(f"**All that were found, {how}**\n\n{_errors(tables, 'all', comparisons)}")
        text.append(
            f"**Accepted only, {how}**. The paper declines nothing: these do not compare with its figures.\n\n"
            + _errors(tables, "accepted", comparisons)
        )
    text.append(
        "**Flips apart**: only parts whose class, face and yaw branch are right, modulo what looks the same from above "
        "where they are chosen, modulo the part's proper symmetries where they are measured. The rates are in the next "
        f"section.\n\n{_errors(tables, 'right', (SYMMETRIC,))}"
    )
    text.append(f"**Accepted, flips apart**\n\n{_errors(tables, 'accepted_right', (SYMMETRIC,))}")
    return "\n\n".join(text)


def _distinct_comparisons(tables: Tables) -> list[list[str]]:
    """Comparisons in groups that give the same errors: all of them for parts without symmetries."""
    groups: list[list[str]] = []
    for c in COMPARISONS:
        for group in groups:
            if all(p["refined"]["all"][c] == p["refined"]["all"][group[0]] for p in _part_figures(tables)):
                group.append(c)
                break
        else:
            groups.append([c])
    return groups


def _part_figures(tables: Tables) -> list[Tables]:
    return [figures for pose in tables["pose"].values() for figures in pose.values()]


def _errors(tables: Tables, selection: str, comparisons: Sequence[str]) -> str:
    """Rows by part and method, and beside all that were found those of the paper."""
    rows = []
    for part in next(iter(tables["pose"].values()), {}):
        for method, pose in tables["pose"].items():
            stages = ["refined"] if method in (BASELINE, BASELINE_RAW) and BASELINE_RAW in tables["pose"] else STAGES
            for stage in stages:
                name = f"`{method}`" if len(stages) == 1 else f"`{method}` {stage}"
                rows.append(_pose_row(part, name, pose[part][stage][selection][comparisons[0]]))
        if selection == "all" and SYMMETRIC in comparisons and part in PAPER_RAW:
            for stage, of in (("raw", PAPER_RAW), ("refined", PAPER_REFINED)):
                rows.append([part, f"the paper, {stage}: means", "-", *(number(of[part][e]) for e in ERRORS)])
    return markdown_table(("part", "method", "n", *ERROR_NAMES.values()), [row for row in rows if row])


def _pose_row(part: str, name: str, errors: Tables) -> list[str]:
    """Empty where nothing was measured."""
    n = errors[ERRORS[0]]["n"]
    return [part, name, str(n), *(_spread(errors[e]) for e in ERRORS)] if n else []


def _spread(s: Tables) -> str:
    return f"{number(s['mean'])} ± {number(s['std'])}, {number(s['median'])}, {number(s['p95'])}"


def decisions(tables: Tables) -> str:
    """Shares of parts of which class, face and yaw are right, and of what was accepted."""
    rows = []
    for method, pose in tables["pose"].items():
        for part, p in pose.items():
            shares = ("class_right", "face_right", "branch_right", "branch_right_equivalent", "flip_rate")
            rows.append(
                [
                    f"`{method}` {part}",
                    str(p["n_parts"]),
                    *(share(p[s]) for s in ("missed_share", *shares, "accepted_share")),
                    f"{p['n_bad']} of {p['n_accepted']}",
                    str(p["n_strays_accepted"]),
                    *(share(p[s]) for s in ("bad_share", "bad_share_upper_95")),
                    str(p["n_open"]),
                    share(p["open_reading_right"]),
                ]
            )
    header = ("", "parts", "missed", "class right", "face right", "branch right", "view-equivalent", "flipped")
    header += ("accepted", "wrong among accepted", "of these no part", "share", "at most (95 %)")
    header += ("left open", "set holds the right one")
    return (
        "## Class, face and yaw\n\n"
        + markdown_table(header, rows)
        + "\n\nRight and flipped: of the parts found. Branch: class, stable pose, and yaw within 6 degrees; flipped: "
        "the face is right, the yaw more than 90 degrees off. Accepted: of all parts. Wrong among accepted: another "
        "branch than the view allows, or no part at all. Left open: the view cannot tell between several poses."
    )


def surface_recall(tables: Tables) -> str:
    """Shares of parts whose largest surface distance is small enough."""
    first = next(iter(tables["pose"].values()), None)
    if first is None:
        return ""
    limits = list(first[ALL]["mssd_recall"])
    rows = [
        [f"`{method}` {part}", *(share(p["mssd_recall"][limit]) for limit in limits)]
        for method, pose in tables["pose"].items()
        for part, p in pose.items()
    ]
    table = markdown_table(("", *(f"{limit} mm" for limit in limits)), rows)
    return f"## Recall of MSSD\n\n{table}\n\nOf all parts, missed ones included."
