"""From part records to ``scorecard.json``: rates with their bounds, failures by cause, pose and place errors."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.bootstrap import clopper_pearson_lower
from twin.events import LookedAgain
from twin.robot import TwinError

FAILURES = ("detection", "declined", "pose", "ik", "grasp", "transport", "place", "disturbed", "collision")


@dataclass(frozen=True, kw_only=True)
class PoseError:
    """Error of one estimate in the camera frame: strict, and modulo what the view cannot tell apart."""

    e_x_mm: float
    e_y_mm: float
    e_z_mm: float
    e_theta_deg: float
    branch_right: bool
    class_right: bool


@dataclass(frozen=True, kw_only=True)
class PartResult:
    """One presented part: what the referee saw, why it failed if it did, and the errors made on it."""

    scene: int
    instance: int
    part: str
    stable_pose: int
    attempted: bool
    attempts: int
    picked: bool
    placed: bool
    succeeded: bool
    failure: str | None
    note: str
    pose_error: PoseError | None
    in_hand_error_mm: tuple[float, float, float, float] | None = None  # x, y, z mm and angle deg in the tcp frame
    place_error_mm_deg: tuple[float, float] | None = None
    collisions: tuple[str, ...] = ()
    disturbed: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """One scene: its parts, the simulated time of each pick cycle, second looks and wall time by stage."""

    scene: int
    parts: tuple[PartResult, ...]
    cycle_s: tuple[float, ...]
    retries: int
    looked_again: tuple[LookedAgain, ...] = ()
    wall_s: dict[str, float] = field(default_factory=dict)


def summarise(values: Iterable[float]) -> dict[str, float | int | None]:
    """{mean, std, median, p95, n} of values; None where there are none."""
    v = np.array([x for x in values], dtype=np.float64)
    if not len(v):
        return {"mean": None, "std": None, "median": None, "p95": None, "n": 0}
    return {
        "mean": float(v.mean()),
        "std": float(v.std()),
        "median": float(np.median(v)),
        "p95": float(np.percentile(v, 95)),
        "n": len(v),
    }


def pose_error_table(errors: Sequence[tuple[str, PoseError]]) -> dict[str, Any]:
    """Summary by part and over "all" of (part name, error) pairs."""
    table: dict[str, Any] = {}
    for name in ["all", *sorted({p for p, _ in errors})]:
        rows = [e for p, e in errors if name in ("all", p)]
        table[name] = {
            key: summarise(getattr(e, key) for e in rows) for key in ("e_x_mm", "e_y_mm", "e_z_mm", "e_theta_deg")
        }
        table[name]["branch_right"] = float(np.mean([e.branch_right for e in rows])) if rows else None
        table[name]["class_right"] = float(np.mean([e.class_right for e in rows])) if rows else None
    return table


def second_look_table(looks: Sequence[LookedAgain]) -> dict[str, dict[str, float]]:
    """By kind: ``looks`` taken, parts ``accepted`` by them, and the ``seconds`` of simulated time they took."""
    table: dict[str, dict[str, float]] = {}
    for kind in sorted({look.kind for look in looks}):
        rows = [look for look in looks if look.kind == kind]
        table[kind] = {
            "looks": len(rows),
            "accepted": sum(look.accepted for look in rows),
            "seconds": sum(look.seconds for look in rows),
        }
    return table


def build_scorecard(
    scenes: Sequence[SceneResult], *, config: dict[str, Any], views_differ: bool = True, **about: Any
) -> dict[str, Any]:
    """The scorecard as a JSON-ready dictionary; ``about`` adds seed, versions, weights.

    ``views_differ`` says that no two placements of any part look the same from above (its view classes); the errors
    modulo view equivalence are then the strict ones, and otherwise left out.
    """
    parts = [p for s in scenes for p in s.parts]
    succeeded = sum(p.succeeded for p in parts)
    cycles = summarise(c for s in scenes for c in s.cycle_s)
    strict = [(p.part, p.pose_error) for p in parts if p.pose_error]
    in_hand = [p.in_hand_error_mm for p in parts if p.in_hand_error_mm]
    placed = [(p.part, p.place_error_mm_deg) for p in parts if p.place_error_mm_deg and p.picked]
    stages = sorted({k for s in scenes for k in s.wall_s})
    return {
        "picks": {
            "presented": len(parts),
            "attempted": sum(p.attempted for p in parts),
            "succeeded": succeeded,
            "success_rate": succeeded / len(parts) if parts else 0.0,
            "success_lower_95": clopper_pearson_lower(succeeded, len(parts)),
            "retries": sum(s.retries for s in scenes),
        },
        "failures": {f: sum(p.failure == f for p in parts) for f in FAILURES},
        "pose_error": pose_error_table(strict),
        "pose_error_equivalent": pose_error_table(strict) if views_differ else None,
        "pose_error_branch_right": pose_error_table([(n, e) for n, e in strict if e.branch_right]),
        "in_hand_error": {
            "all": {
                key: summarise(abs(e[k]) for e in in_hand)
                for k, key in enumerate(("e_x_mm", "e_y_mm", "e_z_mm", "e_theta_deg"))
            }
        },
        "place_error": {
            name: {
                "e_mm": summarise(e[0] for p, e in placed if name in ("all", p)),
                "e_theta_deg": summarise(e[1] for p, e in placed if name in ("all", p)),
            }
            for name in ["all", *sorted({p for p, _ in placed})]
        },
        "cycle_s": {k: cycles[k] for k in ("mean", "median", "p95")} | {"p50": cycles["median"]},
        "second_looks": second_look_table([look for s in scenes for look in s.looked_again]),
        "picks_per_hour": 3600.0 / cycles["mean"] if cycles["mean"] else 0.0,
        "wall_s": {k: sum(s.wall_s.get(k, 0.0) for s in scenes) for k in stages},
        "config": config,
        **about,
        "parts": [asdict(p) for p in parts],
    }


def check_writable(out: Path) -> None:
    """Make the folder ``out``; raises TwinError, naming --out, where nothing can be written to it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".tagcell"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise TwinError(f"cannot write to {out} ({error.strerror}); choose another folder with --out") from error


def write_json(path: Path, value: Any) -> None:
    """Write JSON beside ``path`` and rename, so that a reader never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    try:
        with os.fdopen(handle, "w") as stream:
            json.dump(value, stream, indent=1)
            stream.write("\n")
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
