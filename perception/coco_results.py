"""Instances found in whole frames as COCO's results, and their scores by pycocotools.

Masks are run lengths of the whole frame, made from small windows: no mask of 20 million pixels is ever held.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from cad.files import write_json
from cad.run_lengths import area_of, box_of, encode_runs
from perception.estimates import NOT_A_PART, FrameEstimate, PerceptionError
from perception.ground_truth import FrameTruth, GroundTruth

MOST_DETECTIONS = 100
"""An image's detections that count, those of the highest scores: COCO's number."""

CocoResult = dict[str, Any]
"""``image_id``, ``category_id`` (obj_id), ``segmentation`` (run lengths), ``bbox`` (x, y, w, h) and ``score``."""


def frame_results(estimate: FrameEstimate, frame: FrameTruth, obj_ids: dict[str, int]) -> list[CocoResult]:
    """The instances of a frame: estimates that are parts and have a mask, under the obj_id of their class."""
    shape = frame.intrinsics.height, frame.intrinsics.width
    found = []
    for e in estimate.parts:
        if e.verdict == NOT_A_PART or e.mask is None or not e.mask.any():
            continue
        runs = encode_runs(e.mask, e.mask_origin, shape)
        found.append(
            {
                "image_id": frame.image,
                "category_id": obj_ids[e.part],
                "segmentation": runs,
                "bbox": list(box_of(runs)),
                "score": float(e.score),
            }
        )
    return found


def write_coco_results(path: Path, results: Iterable[CocoResult]) -> None:
    """The results of all images in the form that ``COCO.loadRes`` reads."""
    write_json(path, list(results))


def coco_ground_truth(truth: GroundTruth) -> dict[str, Any]:
    """The data set in COCO's form. Parts that are not whole are crowds, which COCO neither wants nor punishes."""
    images, annotations = [], []
    for frame in truth.frames:
        size = {"width": frame.intrinsics.width, "height": frame.intrinsics.height}
        images.append({"id": frame.image, "file_name": f"{frame.image:06d}"} | size)
        annotations += [
            {
                "id": len(annotations) + k + 1,
                "image_id": frame.image,
                "category_id": part.part.obj_id,
                "segmentation": part.runs,
                "area": area_of(part.runs),
                "bbox": list(box_of(part.runs)),
                "iscrowd": int(not part.whole),
            }
            for k, part in enumerate(frame.parts)
        ]
    categories = [{"id": part.obj_id, "name": part.name} for part in truth.parts]
    return {"info": {}, "images": images, "annotations": annotations, "categories": categories}


def coco_scores(truth: dict[str, Any], results: Sequence[CocoResult]) -> dict[str, float]:
    """COCO's mask AP, AP50, AP75 and AR (100 detections an image) by pycocotools, mean over the classes there are.

    NaN where there are no instances; 0 without results. Raises PerceptionError for a result of an image that the ground
    truth does not have.
    """
    unknown = {r["image_id"] for r in results} - {image["id"] for image in truth["images"]}
    if unknown:
        raise PerceptionError(f"results of images {sorted(unknown)[:5]}, which are not in the data set: evaluate again")
    names = ("ap", "ap50", "ap75", "ar")
    if not any(not a["iscrowd"] for a in truth["annotations"]):
        return dict.fromkeys(names, float("nan"))
    if not results:
        return dict.fromkeys(names, 0.0)
    with contextlib.redirect_stdout(io.StringIO()):
        reference = COCO()
        reference.dataset = truth
        reference.createIndex()
        found = reference.loadRes([dict(r) for r in results])  # pyright: ignore[reportArgumentType]
        evaluation = COCOeval(reference, found, "segm")
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0.0, 1e10]], ["all"]
        evaluation.params.maxDets = [MOST_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][..., 0, 0]  # (thresholds, recalls, classes)
    recall = evaluation.eval["recall"][..., 0, 0]  # (thresholds, classes)
    at = {round(float(t), 2): k for k, t in enumerate(evaluation.params.iouThrs)}
    figures = (precision, precision[at[0.5]], precision[at[0.75]], recall)
    return {name: _mean_of_known(values) for name, values in zip(names, figures, strict=True)}


def _mean_of_known(values: np.ndarray) -> float:
    """Mean without -1, which stands for a class of which there is none."""
    known = values[values > -1]
    return float(known.mean()) if known.size else float("nan")
