"""Table 1: how well instances are found and outlined in whole frames.

The paper's measures are taken class by class: mIoU is the mean over the classes of shared pixels over all pixels of the
class, predicted or true, of all frames together; AP is the mean of TP / (TP + FP) and AR that of TP / (TP + FN) at
thresholds of the overlap (IoU). Recall and precision at 0.5 ask only whether a part was found, whatever class it was
given. Parts that are not whole are not wanted, and detections on them are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cad.run_lengths import RunLengths, area_of, merged, overlaps
from perception.bootstrap import FrameBootstrap, clopper_pearson_lower
from perception.coco_results import CocoResult, coco_ground_truth, coco_scores
from perception.frame_outcomes import on_ignored
from perception.ground_truth import FrameTruth, GroundTruth
from perception.metrics import COCO_THRESHOLDS, DetectionScores, match_detections


@dataclass(kw_only=True)
class _Pixels:
    """Pixels of a class that are shared, and those that are predicted or true, over all frames."""

    shared: int = 0
    either: int = 0

    def add(self, predicted: Sequence[RunLengths], true: Sequence[RunLengths]) -> None:
        a = merged(predicted) if predicted else None
        b = merged(true) if true else None
        both = area_of(merged([a, b], intersect=True)) if a and b else 0
        self.shared += both
        self.either += (area_of(a) if a else 0) + (area_of(b) if b else 0) - both


@dataclass(kw_only=True)
class _Hits:
    """Whether each detection is of a part and each part is found, with the frames they are in."""

    detections: list[bool] = field(default_factory=list)
    detection_frames: list[int] = field(default_factory=list)
    parts: list[bool] = field(default_factory=list)
    part_frames: list[int] = field(default_factory=list)
    iou: list[float] = field(default_factory=list)


def instance_scores(
    truth: GroundTruth, results: Sequence[CocoResult], bootstrap: FrameBootstrap, min_score: float = 0.0
) -> dict[str, Any]:
    """``miou``, COCO's ``ap``, ``ap50``, ``ap75``, ``ar`` (pycocotools), ``precision50``, ``recall50`` and how sure
    they are, the mean overlap of the instances found, the paper's AP and AR by threshold, and figures by part. Results
    below ``min_score`` count for COCO's figures alone, which are made of all scores.
    """
    of_image: dict[int, list[CocoResult]] = defaultdict(list)
    for result in results:
        if result["score"] >= min_score:
            of_image[result["image_id"]].append(result)
    hits = _Hits()
    pixels = {part.obj_id: _Pixels() for part in truth.parts}
    by_class = {part.obj_id: DetectionScores() for part in truth.parts}
    for frame in truth.frames:
        found = _without_ignored(frame, of_image[frame.image])
        _add_frame(frame, found, hits, pixels, by_class)
    paper = {
        f"{t:.2f}": tuple(_mean([scores.precision_recall(t)[k] for scores in by_class.values()]) for k in (0, 1))
        for t in COCO_THRESHOLDS
    }
    return {
        "miou": _mean([p.shared / p.either if p.either else np.nan for p in pixels.values()]),
        **coco_scores(coco_ground_truth(truth), results),
        "precision50": _mean(hits.detections),
        "recall50": _mean(hits.parts),
        "recall50_lower_95": clopper_pearson_lower(sum(hits.parts), len(hits.parts)),
        "precision50_lower_95": clopper_pearson_lower(sum(hits.detections), len(hits.detections)),
        "mean_iou_of_found": _mean(hits.iou),
        "n_detections": len(hits.detections),
        "n_parts": len(hits.parts),
        "intervals_95": {
            "precision50": bootstrap.mean(hits.detections, hits.detection_frames),
            "recall50": bootstrap.mean(hits.parts, hits.part_frames),
        },
        "paper_ap": {t: ap for t, (ap, _) in paper.items()} | {"mean": _mean([ap for ap, _ in paper.values()])},
        "paper_ar": {t: ar for t, (_, ar) in paper.items()} | {"mean": _mean([ar for _, ar in paper.values()])},
        "parts": {
            part.name: {
                "iou": pixels[part.obj_id].shared / max(pixels[part.obj_id].either, 1),
                "precision50": by_class[part.obj_id].precision_recall(0.5)[0],
                "recall50": by_class[part.obj_id].precision_recall(0.5)[1],
            }
            for part in truth.parts
        },
    }


def _without_ignored(frame: FrameTruth, results: list[CocoResult]) -> list[CocoResult]:
    left_out = on_ignored([r["segmentation"] for r in results], frame)
    return [r for r, out in zip(results, left_out, strict=True) if not out]


def _add_frame(
    frame: FrameTruth,
    results: list[CocoResult],
    hits: _Hits,
    pixels: dict[int, _Pixels],
    by_class: dict[int, DetectionScores],
) -> None:
    wanted = [part for part in frame.parts if part.whole]
    scores = [r["score"] for r in results]
    iou = overlaps([r["segmentation"] for r in results], [part.runs for part in wanted])
    taken = match_detections(iou, scores, 0.5)
    hits.detections += (taken >= 0).tolist()
    hits.detection_frames += [frame.image] * len(results)
    hits.parts += [g in taken for g in range(len(wanted))]
    hits.part_frames += [frame.image] * len(wanted)
    hits.iou += [float(iou[d, g]) for d, g in enumerate(taken) if g >= 0]
    for obj_id in by_class:
        mine = [d for d, r in enumerate(results) if r["category_id"] == obj_id]
        true = [g for g, part in enumerate(wanted) if part.part.obj_id == obj_id]
        by_class[obj_id].add(iou[np.ix_(mine, true)], [scores[d] for d in mine])
        pixels[obj_id].add([results[d]["segmentation"] for d in mine], [wanted[g].runs for g in true])


def _mean(values: Sequence[float]) -> float:
    """Mean of what is known; NaN when nothing is."""
    known = np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else float("nan")
