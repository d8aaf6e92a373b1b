"""``tagcell evaluate``: frames that perception has never seen, every method on each of them, and all that comes of it.

Frames, and what each method makes of a frame, are kept as soon as they are finished; the same command goes on from
there. Tables, plots and pictures follow from what is kept.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from cad.files import replacing, write_json
from cad.parts import hash_file
from perception.bop_files import DATASET, manifest_hash, read_json
from perception.bop_results import bop_results_name, write_bop_results
from perception.coco_results import write_coco_results
from perception.estimates import PerceptionError, PoseEstimator
from perception.evaluate import FOLDER, FrameRecord, Progress, evaluate, kept_frames, outcomes_of
from perception.evaluation_plots import write_plots
from perception.evaluation_report import evaluation_markdown
from perception.evaluation_tables import BASELINE, BASELINE_RAW, OURS, evaluation_tables
from perception.failure_sheet import write_failures
from perception.ground_truth import GroundTruth, read_ground_truth
from perception.stored_detections import StoredDetections, read_detections
from scenes.generate import Progress as Made
from scenes.generate import generate
from twin.doctor import versions
from twin.evaluation_config import EvaluationConfig
from twin.render_progress import image_progress
from twin.robot import TwinError
from twin.scorecard import check_writable

DATA_SET_NAME = "tagcell"
"""In the names of BOP's files."""
BASELINE_WEIGHTS = ("segmentation.safetensors", "pvnet.safetensors")
OTHER_WEIGHTS = ("pvnet.safetensors", "maskrcnn.safetensors")
"""In the same folder, but not Tagcell's own."""


def run_evaluation(config: EvaluationConfig) -> dict[str, Any]:
    """Render what is missing of the frames, run what is missing of the methods, write all files; returns the report.

    Raises TwinError for a data set of another split and a folder that cannot be written, CadError for parts that there
    are not, PerceptionError for missing weights and a data set that cannot be read: before anything is rendered or run.
    """
    check_writable(config.out)
    if config.data is not None:
        check_data(config.data, config.split, config.domain)
    else:
        config.dataset().load_parts()
    estimators = load_estimators(config)
    if config.data is None:
        with image_progress("frames") as report:
            generate(config.dataset(), config.frames, jobs=config.jobs, report=report)
    truth = first_frames(read_ground_truth(config.frames, config.parts_dir), config)
    refuse_learned(config.weights, truth.manifest, config.frames)
    stored = [(path, read_detections(path)) for path in config.detections]
    for path, detections in stored:
        detections.check(truth.manifest, [frame.image for frame in truth.frames], path)
    made_with = {row: " ".join(hashes.values()) for row, hashes in weight_hashes(config).items()}
    kept = kept_frames(truth, estimators, config.out, made_with)
    if kept:
        print(
            f"{kept} of {len(truth.frames)} frames were estimated before from the same data and weights and are kept; "
            f"delete {config.out / FOLDER} to make them again",
            file=sys.stderr,
        )
    with method_progress(", ".join(estimators), kept) as progress:
        records = evaluate(
            truth,
            estimators,
            config.out,
            raw_names={BASELINE: BASELINE_RAW} if BASELINE in estimators else None,
            versions=made_with,
            parts_dir=config.parts_dir,
            progress=progress,
        )
    return write_results(config, truth, records, [detections for _, detections in stored])


def check_data(data: Path, split: str, domain: str | None = None) -> None:
    """Raise PerceptionError when there is no finished data set, TwinError when it is not of this split and domain."""
    manifest_hash(data)
    dataset = read_json(data / DATASET)
    found = dataset.get("split")
    if found == "train":
        raise TwinError(
            f"{data} is of split 'train': networks may have learned these very images, so that figures on them say "
            "nothing about new ones. Evaluate on a data set of split test"
        )
    if found != split:
        remedy = "choices were made on it; if that is what you want, say --split val" if found == "val" else "choose it"
        raise TwinError(f"{data} is of split {found!r}, not {split!r}: {remedy}")
    if domain is not None and dataset.get("domain") != domain:
        raise TwinError(f"--domain {domain} and --data {data}, which is of domain {dataset.get('domain')!r}")


def load_estimators(config: EvaluationConfig) -> dict[str, PoseEstimator]:
    """The estimators by the row that their poses make; raises PerceptionError when weights are missing."""
    from perception.estimator import LearnedEstimator
    from perception.pvnet_baseline import PvnetEstimator

    estimators: dict[str, PoseEstimator] = {}
    for method in config.methods:
        if method == "tagcell":
            estimators[OURS] = LearnedEstimator(config.weights, parts_dir=config.parts_dir)
        else:
            try:
                estimators[BASELINE] = PvnetEstimator(config.weights, parts_dir=config.parts_dir)
            except PerceptionError as error:
                raise PerceptionError(f"{error}; or leave the method out: --methods tagcell") from error
    return estimators


def weight_hashes(config: EvaluationConfig) -> dict[str, dict[str, str]]:
    """Hashes of the files that each estimator's result depends on, by its row and the file's name."""
    folder = config.weights or _weights_of_package()
    hashes = {
        path.name: hash_file(path) for path in sorted([*folder.glob("*.safetensors"), *folder.glob("choice.json")])
    }
    by_row = {
        OURS: {name: value for name, value in hashes.items() if name not in OTHER_WEIGHTS},
        BASELINE: {name: value for name, value in hashes.items() if name in BASELINE_WEIGHTS},
    }
    return {row: by_row[row] for row in (OURS if method == "tagcell" else BASELINE for method in config.methods)}


def learned_from(weights: Path | None) -> dict[str, Any]:
    """What the weight files say about the data that they were made from, by the file's name."""
    folder = weights or _weights_of_package()
    notes = {path.stem: read_json(path) for path in sorted(folder.glob("*.json"))}
    return {name: note.get("data", note.get("fitted_on")) for name, note in notes.items()}


def refuse_learned(weights: Path | None, manifest: str, data: Path) -> None:
    """Raise TwinError when the weights were made from this data set, whatever split it says it is of."""
    for name, made_from in learned_from(weights).items():
        if manifest in json.dumps(made_from):
            raise TwinError(
                f"the weights {name} were made from {data} itself: evaluate on a data set that they never saw"
            )


def _weights_of_package() -> Path:
    from perception.estimator import WEIGHTS

    return WEIGHTS


def first_frames(truth: GroundTruth, config: EvaluationConfig) -> GroundTruth:
    """The frames that were asked for; raises TwinError when a given data set has fewer."""
    if config.count is None or config.data is None:
        return truth
    if config.count > len(truth.frames):
        raise TwinError(f"count {config.count}: {config.data} has {len(truth.frames)} frames")
    return replace(truth, frames=truth.frames[: config.count])


@contextmanager
def method_progress(what: str, kept: int) -> Iterator[Progress]:
    """What ``evaluate`` is to tell how far it is: frames done, and the time left by the pace of those not ``kept``."""
    started = time.monotonic()
    with image_progress(what) as report:

        def progress(done: int, total: int, _: str) -> None:
            report(Made(done=done, total=total, made=max(0, done - kept), seconds=time.monotonic() - started))

        yield progress


def write_results(
    config: EvaluationConfig,
    truth: GroundTruth,
    records: Mapping[str, list[FrameRecord]],
    stored: Sequence[StoredDetections] = (),
) -> dict[str, Any]:
    """Tables, plots, pictures of failures, BOP's and COCO's files; returns the content of ``evaluation.json``."""
    out = config.out
    for method, own in records.items():
        name = bop_results_name(method, DATA_SET_NAME, config.split)
        write_bop_results(out / "bop" / name, [pose for record in own for pose in record.bop_poses()])
        write_coco_results(out / "coco" / f"{method}.json", [d for record in own for d in record.detections])
    tables = evaluation_tables(
        truth,
        records,
        splits={"weights_made_from": learned_from(config.weights)},
        instances={d.method: d.results for d in stored},
        min_scores={d.method: d.min_score for d in stored},
        main=next(iter(records)),
    )
    tables |= {
        "config": config_json(config),
        "versions": versions(),
        "weights": weight_hashes(config),
    }
    write_plots([o for own in records.values() for o in outcomes_of(own)], out)
    for k, (method, own) in enumerate(records.items()):
        write_failures(out / ("failures.png" if k == 0 else f"failures_{method}.png"), truth, own)
    write_json(out / "evaluation.json", tables)
    with replacing(out / "evaluation.md") as temporary:
        temporary.write_text(evaluation_markdown(tables), encoding="utf-8")
    return tables


def config_json(config: EvaluationConfig) -> dict[str, Any]:
    """The configuration without what cannot change the result."""
    values = asdict(config)
    for name in ("out", "jobs", "parts_dir"):
        del values[name]
    return json.loads(json.dumps(values, default=str))
