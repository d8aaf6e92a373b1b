"""``tagcell pick``: many scenes side by side, one scorecard."""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

from cad.parts import Part, hash_file, load_part
from cad.robot import UR5E
from cad.robot_calibration import read_dh_calibration
from perception.estimates import PoseEstimator
from scenes.cell_config import CellConfig, TrayConfig
from twin.doctor import versions
from twin.pick_config import PickConfig
from twin.report import ScenesProgress
from twin.scorecard import SceneResult, build_scorecard, check_writable, write_json


def run_pick(config: PickConfig, *, quiet: bool = False) -> dict[str, Any]:
    """Run all scenes and write ``scorecard.json``; returns the scorecard.

    Raises TwinError when ``out`` cannot be written and PerceptionError when weights are missing, before any scene runs.
    """
    check_writable(config.out)
    parts = {name: load_part(name, config.parts_dir) for name in config.parts}
    cell_for(config)
    weights = check_weights(config)
    results: list[SceneResult] = []
    with ScenesProgress(config.scenes, quiet=quiet) as progress:
        for result in _run_scenes(config):
            results.append(result)
            progress.show(results)
    results.sort(key=lambda r: r.scene)
    card = build_scorecard(
        results,
        config=config_json(config),
        views_differ=all(_views_differ(part) for part in parts.values()),
        seed=config.seed,
        versions=versions(),
        weights=weights,
        meshes={name: part.mesh_hash for name, part in parts.items()},
    )
    write_json(config.out / "scorecard.json", card)
    return card


def run_scene(config: PickConfig, scene: int) -> SceneResult:
    """One scene, from (seed, scene) alone."""
    from twin.scene_trial import SceneTrial

    return SceneTrial(config, scene, _estimator(config), cell_for(config)).run()


def cell_for(config: PickConfig) -> CellConfig:
    """The cell of a run: nests for its parts, and the arm it is about.

    Raises SceneError when the tray has no room for the parts and CalibrationFileError for a calibration that cannot be
    used.
    """
    parts = [load_part(name, config.parts_dir) for name in config.parts]
    return CellConfig(
        tray=TrayConfig.for_parts(parts, at_least=config.parts_per_class),
        arm=read_dh_calibration(config.arm_calibration) if config.arm_calibration else UR5E,
        parts_dir=config.parts_dir,
    )


def config_json(config: PickConfig) -> dict[str, Any]:
    """The configuration without what cannot change the result."""
    values = dataclasses.asdict(config)
    for name in ("out", "jobs", "pictures", "parts_dir"):
        del values[name]
    paths = {name: str(values[name]) if values[name] else None for name in ("arm_calibration", "weights")}
    return values | paths | {name: list(values[name]) for name in ("parts", "second_looks")}


def check_weights(config: PickConfig) -> dict[str, str]:
    """Hashes of the weight files a run will use; raises PerceptionError when one is missing or does not fit."""
    if config.estimator == "oracle":
        return {}
    _estimator(config)
    from perception.estimator import WEIGHTS

    folder = config.weights or WEIGHTS
    return {p.name: hash_file(p) for p in sorted(folder.glob("*.safetensors"))}


_ESTIMATORS: dict[PickConfig, PoseEstimator] = {}


def _estimator(config: PickConfig) -> PoseEstimator | None:
    """The learned estimator, loaded once a process; None stands for the oracle."""
    if config.estimator == "oracle":
        return None
    if config not in _ESTIMATORS:
        import torch

        from perception.estimator import LearnedEstimator

        torch.set_num_threads(1)  # sums must not depend on how many scenes run side by side
        _ESTIMATORS[config] = LearnedEstimator(config.weights, part_names=config.parts, parts_dir=config.parts_dir)
    return _ESTIMATORS[config]


def _run_scenes(config: PickConfig) -> Iterator[SceneResult]:
    jobs = min(config.jobs, config.scenes)
    if jobs == 1:
        for scene in range(config.scenes):
            yield run_scene(config, scene)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context)
    try:
        pending = [pool.submit(run_scene, config, scene) for scene in range(config.scenes)]
        for future in as_completed(pending):
            yield future.result()
        pool.shutdown()
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(cancel_futures=True)
        raise


def _views_differ(part: Part) -> bool:
    return len({p.view_class for p in part.stable_poses}) == len(part.stable_poses)
