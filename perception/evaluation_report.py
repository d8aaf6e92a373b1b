"""``evaluation.md``: the tables of an evaluation for people, from the content of ``evaluation.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from perception.breakdowns import MISSED, NOTHING
from perception.evaluation_tables import BASELINE, OURS
from perception.markdown import interval, markdown_table, number, share
from perception.outcomes import ERRORS
from perception.pose_report import ERROR_NAMES, decisions, surface_recall, table_2
from perception.pose_tables import ALL
from perception.references import PAPER_REFINED

Tables = Mapping[str, Any]


def evaluation_markdown(tables: Tables) -> str:
    """All tables, figures rounded to what they are good for."""
    sections = (
        _head(tables),
        _goals(tables),
        _headline(tables),
        _table_1(tables),
        table_2(tables),
        decisions(tables),
        surface_recall(tables),
        _covariance(tables),
        _confusion(tables),
        _groups(tables),
        _latency(tables),
    )
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(tables: Tables) -> str:
    return (
        f"# Evaluation: {tables['domain']}\n\n"
        f"{tables['n_images']} whole frames of split `{tables['splits']['evaluated']}`, {tables['n_parts']} parts of "
        f"which at least 60 % is visible and that the border does not cut; {tables['n_parts_not_whole']} others are "
        "left out, as are detections on them. The camera's pose comes from the tags in the frame. Intervals are 95 % "
        "bootstraps over frames; bounds of shares are one-sided 95 % Clopper-Pearson."
    )


def _goals(tables: Tables) -> str:
    rows = [
        [g["name"], g["wanted"], number(g["measured"], 4), interval(g["interval_95"]), "yes" if g["met"] else "**no**"]
        for g in tables.get("goals", [])
    ]
    if not rows:
        return ""
    header = ("", "required (aim)", "measured", "interval or bound", "reached")
    return f"## What is asked for, and what `{OURS}` reaches\n\n{markdown_table(header, rows)}"


def _headline(tables: Tables) -> str:
    figures = tables.get("headline") or {}
    if not figures:
        return ""
    rows = [["mean error, nothing declined", *(number(figures["mean"][e]) for e in ERRORS)]]
    if "ratio" in figures:
        ratio = figures["ratio"]
        text = f"times smaller than `{BASELINE}`, same {figures['n_common']} parts"
        rows.append([f"{text}, means", *(number(ratio[e]["mean"]) for e in ERRORS)])
        rows.append(["interval", *(interval(ratio[e]["mean_interval_95"]) for e in ERRORS)])
        rows.append([f"{text}, medians", *(number(ratio[e]["median"]) for e in ERRORS)])
    rows.append(["the paper's mean, refined, of its own images", *(number(PAPER_REFINED[ALL][e]) for e in ERRORS)])
    rows.append(["times smaller than the paper's", *(number(figures["ratio_to_paper"][e]) for e in ERRORS)])
    return (
        f"## Headline: `{OURS}`, all {figures['n']} parts that it found\n\n"
        + markdown_table(("", *ERROR_NAMES.values()), rows)
        + "\n\nNothing is left out because it was declined, and wrong classes, faces and yaws count with their errors."
    )


def _table_1(tables: Tables) -> str:
    rows = []
    for method, s in tables["segmentation_by_method"].items():
        own = [s["miou"], s["paper_ap"]["0.50"], s["paper_ap"]["mean"], s["paper_ar"]["0.50"], s["paper_ar"]["mean"]]
        coco = [s["precision50"], s["recall50"], s["ap"], s["ap50"], s["ap75"], s["ar"], s["mean_iou_of_found"]]
        rows.append([f"`{method}`", *(number(v) for v in own + coco)])
    rows.append(["the paper", *["n/a"] * 12])
    header = ("method", "mIoU", "AP at 0.5", "AP mean", "AR at 0.5", "AR mean", "precision 0.5", "recall 0.5")
    header += ("COCO AP", "COCO AP50", "COCO AP75", "COCO AR", "IoU of found")
    return (
        "## Table 1: instances\n\n"
        + markdown_table(header, rows)
        + "\n\nmIoU, AP = mean of TP / (TP + FP) and AR = mean of TP / (TP + FN), class by class, as the paper defines "
        "them, at an overlap of 0.5 and averaged over 0.5 to 0.95; precision and recall whatever the class; COCO's "
        "figures by pycocotools. The paper's own values of its Table 1 are not available."
    )


def _covariance(tables: Tables) -> str:
    rows = []
    for method, parts in tables["calibration_of_covariance"].items():
        for part, kinds in parts.items():
            for kind, c in kinds.items():
                rows.append(
                    [
                        f"`{method}` {part}",
                        "x, y, yaw" if kind == "nees_planar" else "all six",
                        str(c["n"]),
                        number(c["mean"]),
                        interval(c["mean_bounds_95"]),
                        *(number(c[name]) for name in ("median", "median_expected")),
                        share(c["within_95"]),
                    ]
                )
    if not rows:
        return ""
    header = ("", "of", "n", "mean", "95 % bounds", "median", "expected", "within 95 % region")
    return (
        "## Does the covariance hold?\n\n"
        + markdown_table(header, rows)
        + "\n\nNormalised error squared of accepted poses with the branch right."
    )


def _confusion(tables: Tables) -> str:
    text = ["## Confusion"]
    for method, c in tables["confusion"].items():
        columns = sorted({name for row in c["class"].values() for name in row}, key=lambda name: (name == MISSED, name))
        rows = [
            [true, *(str(row.get(name, 0)) for name in columns)]
            for true, row in sorted(c["class"].items(), key=lambda item: item[0] == NOTHING)
        ]
        text.append(f"**`{method}`**, true class by row:\n\n{markdown_table(('class', *columns), rows)}")
        wrong = [
            [part, true, taken, str(n)]
            for part, faces in c["face"].items()
            for true, row in faces.items()
            for taken, n in row.items()
            if taken != true
        ]
        if wrong:
            text.append(markdown_table(("part", "stable pose", "taken for", "times"), wrong))
        yaws = [[part, *(str(row[kind]) for kind in ("right", "flipped", "other"))] for part, row in c["flip"].items()]
        if yaws:
            text.append(markdown_table(("yaw where the face is right", "right", "flipped", "other"), yaws))
    return "\n\n".join(text)


def _groups(tables: Tables) -> str:
    text = ["## Where errors are"]
    header = ("parts", "found", "branch right", "accepted", "e_xy mm, median", "e_theta deg, median")
    for key, what in (
        ("by_position", "mm from the board's centre"),
        ("by_brightness", "mean grey level"),
        ("by_face", "stable pose"),
    ):
        for method, groups in tables[key].items():
            rows = [
                [
                    f"{g['part']} {g['stable_pose']}" if key == "by_face" else f"{g['from']:.0f} to {g['to']:.0f}",
                    str(g["n"]),
                    *(share(g[name]) for name in ("recall", "branch_right", "accepted_share")),
                    number(g["e_xy_mm_median"]),
                    number(g["e_theta_deg_median"]),
                ]
                for g in groups
            ]
            text.append(f"**`{method}`**\n\n{markdown_table((what, *header), rows)}")
    return "\n\n".join(text)


def _latency(tables: Tables) -> str:
    rows = [
        [f"`{method}` {stage}", *(number(s[k]) for k in ("mean", "p50", "p95")), str(s["n"])]
        for method, stages in tables["latency_s_by_method"].items()
        for stage, s in stages.items()
    ]
    if not rows:
        return ""
    return "## Seconds a frame\n\n" + markdown_table(("", "mean", "p50", "p95", "frames"), rows)
