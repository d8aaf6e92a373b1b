"""Grasps of a part: searched on its mesh for each stable pose, tried in physics, ranked and kept in ``grasps.json``.

The file also says of every stable pose what spoke against other grasps, and so why a pose has none.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from cad.parts import Part, load_part, part_names
from twin.grasp_config import Grasp, GraspConfig, GraspError, Trial, grasp_from_json
from twin.grasp_geometry import Miss, sample_surface
from twin.grasp_search import GraspSearch, find_grasps
from twin.grasp_trial import TrialBench, TrialConfig

_STRAY_M, _STRAY_RAD = 0.1e-3, np.deg2rad(1.0)
"""A grasp whose part strays by this in its trial counts 1 / e of one whose part does not."""
_MARGIN_TESTS = 4
_FILE = "grasps.json"


@dataclass(frozen=True, kw_only=True)
class PoseGrasps:
    """Grasps of one stable pose, best first, all of which held, and what spoke against others, most frequent first."""

    stable_pose: int
    grasps: tuple[Grasp, ...]
    reasons: tuple[str, ...]

    @property
    def why_not(self) -> str:
        """Why the pose cannot be gripped; empty where it can."""
        return "" if self.grasps else "; ".join(self.reasons) or "no grasp was found"


def plan_grasps(
    part: Part, config: GraspConfig | None = None, trial: TrialConfig | None = None
) -> tuple[PoseGrasps, ...]:
    """Search the grasps of every stable pose of ``part`` and try them in physics; poses without any say why."""
    config = config or GraspConfig()
    samples = sample_surface(part.mesh, config.sample_spacing_m, config.max_samples)
    searches = [find_grasps(part, pose, config, samples) for pose in part.stable_poses]
    if not any(search.grasps for search in searches):
        return tuple(_judged(k, search, [], []) for k, search in enumerate(searches))
    bench = TrialBench(part, trial)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return tuple(_try_pose(k, search, bench, config, pool) for k, search in enumerate(searches))


def _try_pose(
    stable_pose: int, search: GraspSearch, bench: TrialBench, config: GraspConfig, pool: Executor
) -> PoseGrasps:
    """Try the candidates of a pose, best first, until enough have held; then see what errors the best ones bear."""
    held: list[Grasp] = []
    failed: list[Trial] = []
    enough = config.enough_for(len(bench.part.hulls))
    waiting = list(search.grasps)
    while waiting and len(held) < enough:
        batch, waiting = waiting[: enough - len(held)], waiting[enough - len(held) :]
        for grasp, trial in zip(batch, pool.map(bench.run, batch), strict=True):
            if trial.held:
                held.append(replace(grasp, trial=trial, quality=grasp.quality * _steadiness(trial)))
            else:
                failed.append(trial)
    for _ in range(_MARGIN_TESTS):
        held.sort(key=lambda g: -g.quality)
        if not held or _trial_of(held[0]).margin is not None:
            break
        held[0] = _with_margin(held[0], bench.margin(held[0], pool))
    return _judged(stable_pose, search, sorted(held, key=lambda g: -g.quality), failed)


def _trial_of(grasp: Grasp) -> Trial:
    assert grasp.trial is not None
    return grasp.trial


def _steadiness(trial: Trial) -> float:
    """Share in (0, 1] by which what the part moved in its trial lowers a grasp's quality."""
    metres = max(trial.shift_m, trial.slip_m, trial.place_m)
    radians = max(trial.shift_rad, trial.slip_rad, trial.place_rad)
    return float(np.exp(-metres / _STRAY_M - radians / _STRAY_RAD))


def _with_margin(grasp: Grasp, margin: float) -> Grasp:
    quality = grasp.quality * (0.1 + 0.9 * margin)
    return replace(grasp, quality=quality, trial=replace(_trial_of(grasp), margin=margin))


def _judged(stable_pose: int, search: GraspSearch, held: Sequence[Grasp], failed: Sequence[Trial]) -> PoseGrasps:
    reasons = []
    if failed:
        causes = Counter(re.sub(r"[-\d.]+", "", trial.why) for trial in failed)
        examples = {re.sub(r"[-\d.]+", "", trial.why): trial.why for trial in failed}
        listed = ", ".join(f"{examples[cause]} ({n} times)" for cause, n in causes.most_common())
        reasons.append(f"{len(held)} of {len(held) + len(failed)} trials in physics held: {listed}")
    misses = {m: n for m, n in search.rejections.items() if m.miss is not Miss.NOTHING} or search.rejections
    reasons += [f"{missed} ({n} places)" for missed, n in misses.items()]
    return PoseGrasps(stable_pose=stable_pose, grasps=tuple(held), reasons=tuple(reasons))


def write_grasps(
    part: Part, config: GraspConfig | None = None, trial: TrialConfig | None = None
) -> tuple[PoseGrasps, ...]:
    """Plan the grasps of ``part`` and write ``grasps.json`` into its folder; returns what was found for each pose."""
    planned = plan_grasps(part, config, trial)
    content = {
        "made_for": _made_for(part),
        "grasps": [grasp.as_json() for pose in planned for grasp in pose.grasps],
        "reasons": [list(pose.reasons) for pose in planned],
    }
    (part.folder / _FILE).write_text(json.dumps(content) + "\n")
    _read.cache_clear()
    return planned


def _made_for(part: Part) -> dict[str, str]:
    """What grasps depend on: the mesh, and how the part lies to a micrometre and ten microradians or so."""
    poses = np.array([pose.T_table_part for pose in part.stable_poses])
    rounded = (np.round(poses, 5) + 0.0).tobytes()
    return {"mesh": part.mesh_hash, "stable_poses": hashlib.sha256(rounded).hexdigest()[:16]}


def read_grasps(part: Part) -> tuple[tuple[Grasp, ...], ...]:
    """Grasps of ``part`` by stable pose, best first, from its folder.

    Raises GraspError when there are none or they were made for another mesh or other stable poses.
    """
    return tuple(pose.grasps for pose in describe_grasps(part))


def describe_grasps(part: Part) -> tuple[PoseGrasps, ...]:
    """What is stored about every stable pose: its grasps and what spoke against others. Raises as ``read_grasps``."""
    path = part.folder / _FILE
    if not path.exists():
        raise GraspError(f"part {part.name!r} has no {_FILE} in {part.folder}; write_grasps makes it")
    return _read(part, path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read(part: Part, stamp: int) -> tuple[PoseGrasps, ...]:
    del stamp
    path = part.folder / _FILE
    content: dict[str, Any] = json.loads(path.read_text())
    if content.get("made_for") != _made_for(part):
        raise GraspError(
            f"{path} was made for {content.get('made_for')}, the part's files are {_made_for(part)}; write_grasps "
            "makes it anew"
        )
    grasps = [grasp_from_json(part.name, entry) for entry in content["grasps"]]
    return tuple(
        PoseGrasps(
            stable_pose=k, grasps=tuple(g for g in grasps if g.stable_pose == k), reasons=tuple(content["reasons"][k])
        )
        for k in range(len(part.stable_poses))
    )


def main() -> None:
    """Plan and write the grasps of the parts named on the command line (default: all)."""
    for name in sys.argv[1:] or part_names():
        for pose in write_grasps(load_part(name)):
            best = pose.grasps[0] if pose.grasps else None
            says = f"{len(pose.grasps)} grasps, the best {1e3 * best.width_m:.2f} mm wide" if best else pose.why_not
            print(f"{name} face {pose.stable_pose}: {says}")


if __name__ == "__main__":
    main()
