"""``evaluation.json``: everything that is measured on one data set, by method, beside what is asked for.

Made from the records of the frames alone, so that it can be made again at any time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from perception.bootstrap import FrameBootstrap
from perception.breakdowns import by_brightness, by_face, by_position, confusion, covariance_figures
from perception.coco_results import CocoResult
from perception.evaluate import FrameRecord, outcomes_of
from perception.ground_truth import GroundTruth
from perception.instance_scores import instance_scores
from perception.metrics import summary
from perception.outcomes import ERRORS, SYMMETRIC, Outcome
from perception.pose_tables import ALL, error_values, pose_table
from perception.references import ACCEPTED_SHARE, BAD_SHARE, GOALS, PAPER_REFINED

OURS, BASELINE, BASELINE_RAW = "tagcell", "pvnet-refined", "pvnet"
"""Rows: Tagcell, and the published method with and without its refinement."""
SEED = 20
"""Of the bootstrap's draws."""


def evaluation_tables(
    truth: GroundTruth,
    records: Mapping[str, Sequence[FrameRecord]],
    *,
    splits: Mapping[str, Any] | None = None,
    instances: Mapping[str, Sequence[CocoResult]] | None = None,
    min_scores: Mapping[str, float] | None = None,
    main: str = OURS,
    draws: int = 1000,
) -> dict[str, Any]:
    """The content of ``evaluation.json``, JSON-ready: what is not known is None.

    ``instances`` are results of methods that find instances and no poses, which count from ``min_scores`` on (those
    below are for curves over all scores). ``segmentation`` and ``latency_s`` are those
    of the method ``main``; those of all methods stand in ``segmentation_by_method`` and ``latency_s_by_method``.
    """
    names = [part.name for part in truth.parts]
    bootstrap = FrameBootstrap([f.image for f in truth.frames], np.random.default_rng(SEED), draws)
    rows = {method: outcomes_of(own) for method, own in records.items()}
    found = {m: [d for record in own for d in record.detections] for m, own in records.items() if m != BASELINE_RAW}
    segmentation = {
        method: instance_scores(truth, results, bootstrap, (min_scores or {}).get(method, 0.0))
        for method, results in (found | dict(instances or {})).items()
    }
    latency = {method: latency_figures(own) for method, own in records.items()}
    pose = {method: pose_table(own, names, bootstrap) for method, own in rows.items()}
    tables = {
        "domain": truth.domain,
        "n_images": len(truth.frames),
        "n_parts": truth.n_parts,
        "n_parts_not_whole": sum(not part.whole for frame in truth.frames for part in frame.parts),
        "splits": {"evaluated": truth.dataset["split"], "manifest": truth.manifest, **(splits or {})},
        "segmentation": segmentation.get(main),
        "pose": pose,
        "headline": headline(rows, bootstrap),
        "calibration_of_covariance": {m: covariance_figures(own, names) for m, own in rows.items() if _has_nees(own)},
        "latency_s": latency.get(main),
        "segmentation_by_method": segmentation,
        "latency_s_by_method": latency,
        "confusion": {method: confusion(own) for method, own in rows.items()},
        "by_position": {method: by_position(own) for method, own in rows.items()},
        "by_brightness": {method: by_brightness(own) for method, own in rows.items()},
        "by_face": {method: by_face(own) for method, own in rows.items()},
        "not_usable": {
            method: {str(record.image): record.note for record in own if record.note} for method, own in records.items()
        },
    }
    if main in pose and main in segmentation:
        tables["goals"] = goals(truth.domain, truth.n_parts, segmentation[main], pose[main][ALL])
    return json_ready(tables)


def latency_figures(records: Sequence[FrameRecord]) -> dict[str, dict[str, float]]:
    """Seconds of a frame by stage: mean, p50, p95, n."""
    stages = dict.fromkeys(stage for record in records for stage in record.seconds)
    out = {}
    for stage in stages:
        figures = summary([record.seconds[stage] for record in records if stage in record.seconds])
        out[stage] = {"mean": figures["mean"], "p50": figures["median"], "p95": figures["p95"], "n": figures["n"]}
    return out


def headline(rows: Mapping[str, Sequence[Outcome]], bootstrap: FrameBootstrap) -> dict[str, Any]:
    """How many times smaller Tagcell's mean errors are, no part declined, wrong branches included: than those of the
    published method with its refinement on the parts that both found, and than the paper's of its own images.
    """
    if OURS not in rows:
        return {}
    ours = {(o.image, o.instance): o for o in rows[OURS] if o.is_part and o.whole and o.detected}
    mean = {e: float(np.mean(error_values(list(ours.values()), e))) if ours else float("nan") for e in ERRORS}
    out: dict[str, Any] = {
        "n": len(ours),
        "mean": mean,
        "paper_refined": PAPER_REFINED[ALL],
        "ratio_to_paper": {e: PAPER_REFINED[ALL][e] / mean[e] if mean[e] else float("nan") for e in ERRORS},
    }
    if BASELINE in rows:
        theirs = {(o.image, o.instance): o for o in rows[BASELINE] if o.is_part and o.whole and o.detected}
        out |= {"beside": BASELINE} | _ratios(ours, theirs, bootstrap)
    return out


def _ratios(
    ours: Mapping[tuple[int, int], Outcome], theirs: Mapping[tuple[int, int], Outcome], bootstrap: FrameBootstrap
) -> dict[str, Any]:
    common = [key for key in ours if key in theirs]
    images = [image for image, _ in common]
    ratio: dict[str, Any] = {}
    for e in ERRORS:
        a = error_values([ours[key] for key in common], e)
        b = error_values([theirs[key] for key in common], e)
        ratio[e] = {
            "mean": float(np.sum(b) / np.sum(a)) if np.sum(a) else float("nan"),
            "mean_interval_95": bootstrap.ratio(b, images, a, images),
            "median": float(np.median(b) / np.median(a)) if common and np.median(a) else float("nan"),
        }
    return {"n_common": len(common), "ratio": ratio}


def goals(domain: str, n_parts: int, segmentation: Mapping[str, Any], pose: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What is asked for in a domain beside what was measured over all parts; empty for a domain without goals.

    Figures that are not known reach nothing.
    """
    accepted, right = (pose["refined"][name][SYMMETRIC] for name in ("accepted", "accepted_right"))
    wide, interval = segmentation["intervals_95"], pose["intervals_95"]
    measured = [
        (segmentation["recall50"], wide["recall50"]),
        (segmentation["precision50"], wide["precision50"]),
        (segmentation["miou"], None),
        (pose["branch_right_equivalent"], interval["branch_right_equivalent"]),
        (pose["accepted_share"], interval["accepted_share"]),
        *((accepted[e][s], interval["accepted"][e][s]) for e in ("e_x_mm", "e_y_mm") for s in ("mean", "p95")),
        (accepted["e_z_mm"]["mean"], interval["accepted"]["e_z_mm"]["mean"]),
        *((right["e_theta_deg"][s], interval["accepted_right"]["e_theta_deg"][s]) for s in ("median", "p95")),
        (pose["bad_share"], [0.0, pose["bad_share_upper_95"]]),
        (n_parts, None),
    ]
    return [
        {
            "name": goal.name,
            "wanted": goal.wanted(),
            "measured": value,
            "interval_95": bounds,
            "met": goal.met(value) and (goal.name != ACCEPTED_SHARE or pose["bad_share"] <= BAD_SHARE),
        }
        for goal, (value, bounds) in zip(GOALS.get(domain, ()), measured, strict=False)
    ]


def json_ready(value: Any) -> Any:
    """The same with None for numbers that are not finite, which JSON does not have, and plain Python numbers."""
    if isinstance(value, Mapping):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if isinstance(value, np.generic):
        return json_ready(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _has_nees(rows: Sequence[Outcome]) -> bool:
    return any(o.nees is not None for o in rows)
