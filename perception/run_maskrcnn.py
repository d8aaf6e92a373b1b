"""``python -m perception.run_maskrcnn --data DIR --out FILE``: what Mask R-CNN finds in a data set, for the evaluation.

Run it from the environment that ``make maskrcnn`` makes. A run that was stopped goes on where it was.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
import tyro
from pycocotools import mask as run_lengths

from cad.parts import CadError, hash_file, load_part
from cad.run_lengths import encode_runs
from cad.tagboard import TagboardConfig
from perception.bop_files import manifest_hash
from perception.calibration import camera_from_tags, table_from_board
from perception.coco_results import CocoResult
from perception.estimates import PerceptionError
from perception.ground_truth import FrameTruth, read_ground_truth
from perception.maskrcnn import MIN_SCORE, WEIGHTS, MaskRCNNSegmenter
from perception.segmentation import Detection
from perception.standard_view import frame_scale
from perception.stored_detections import StoredDetections, read_detections

METHOD = "maskrcnn"
SAVE_S = 20.0


@dataclass(frozen=True, kw_only=True)
class MaskRCNNRun:
    """``data`` is a finished data set of whole frames or of windows, ``out`` the file to write.

    ``weights`` is a folder with ``maskrcnn.safetensors``, ``count`` the number of images to look at (default: all).
    """

    data: Path
    out: Path
    weights: Path = Path(__file__).parent / "weights"
    count: int | None = None
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("count", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} = {value}: must be at least 1")


def run_maskrcnn(config: MaskRCNNRun) -> StoredDetections:
    """Look at every image of the data set that is not yet in the file, and keep what is found in it."""
    torch.set_num_threads(config.threads)
    cv2.setNumThreads(config.threads)
    segmenter = MaskRCNNSegmenter.load(config.weights)
    truth = read_ground_truth(config.data)
    windows = truth.dataset["kind"] == "window"
    obj_ids = [load_part(name).obj_id for name in segmenter.part_names]
    stored = StoredDetections(
        method=METHOD,
        weights=hash_file(config.weights / WEIGHTS),
        data=manifest_hash(config.data),
        min_score=segmenter.min_score,
        seconds={},
        results=(),
    )
    if config.out.exists():
        stored = _continued(read_detections(config.out), stored, config.out)
    saved = time.monotonic()
    for k, frame_truth in enumerate(truth.frames[: config.count]):
        if frame_truth.image in stored.seconds:
            continue
        detections, seconds = _look(segmenter, frame_truth, windows)
        found = tuple(_as_result(d, frame_truth, obj_ids) for d in detections)
        stored = replace(stored, seconds=stored.seconds | {frame_truth.image: seconds}, results=stored.results + found)
        if time.monotonic() - saved > SAVE_S:
            stored.write(config.out)
            print(f"{METHOD}: {k + 1} of {len(truth.frames)} images", flush=True)
            saved = time.monotonic()
    stored.write(config.out)
    print(f"{METHOD}: {len(stored.seconds)} images, {len(stored.results)} detections in {config.out}")
    return stored


def _continued(earlier: StoredDetections, fresh: StoredDetections, path: Path) -> StoredDetections:
    if (earlier.method, earlier.weights, earlier.data) != (fresh.method, fresh.weights, fresh.data):
        raise PerceptionError(
            f"{path} holds detections by {earlier.method} {earlier.weights} of data set {earlier.data}, these are by "
            f"{fresh.method} {fresh.weights} of {fresh.data}: give another --out, or remove it"
        )
    return earlier


def _look(segmenter: MaskRCNNSegmenter, truth: FrameTruth, windows: bool) -> tuple[list[Detection], float]:
    """What is found in an image, and the seconds from the frame to masks; the scale comes from the tags in the frame.

    Windows are as they were rendered: at the segmenter's own scale, and without tags to read it from.
    """
    frame = truth.frame()
    if windows:
        started = time.perf_counter()
        return segmenter.detect_reduced(frame.image, min_score=MIN_SCORE), time.perf_counter() - started
    scale = frame_scale(frame.intrinsics, table_from_board(camera_from_tags(frame, TagboardConfig()).T_cam_board))
    frame = truth.frame()  # afresh: what the tags needed is not done for the segmenter
    started = time.perf_counter()
    return segmenter.detect(frame, scale, MIN_SCORE), time.perf_counter() - started


def _as_result(detection: Detection, truth: FrameTruth, obj_ids: list[int]) -> CocoResult:
    shape = truth.intrinsics.height, truth.intrinsics.width
    runs = encode_runs(detection.mask, detection.mask_origin, shape)
    return {
        "image_id": truth.image,
        "category_id": obj_ids[int(detection.class_probabilities.argmax())],
        "segmentation": runs,
        "bbox": [float(x) for x in run_lengths.toBbox(runs)],  # pyright: ignore[reportArgumentType]
        "score": detection.score,
    }


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, run, return the exit code."""
    try:
        run_maskrcnn(tyro.cli(MaskRCNNRun, prog="perception.run_maskrcnn", description=__doc__, args=arguments))
    except (PerceptionError, CadError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
