"""How fast the whole cell runs on one core: python -m benchmarks.cell_speed.

Ten parts of the built-in classes lie on the board and the arm picks and places some of them at full speed with the true
poses, the referee watching every physics step, as in scored runs; only the camera's pictures and its waiting time are
left out, for an arm at rest would flatter the figure. CPU time is compared with simulated time. On a core whose
neighbours are busy it is up to twice as long as on a free machine, so the best of several runs counts.
"""

from __future__ import annotations

import json
import os
import time
from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.tables import machine
from cad.parts import BUILT_IN, load_part
from cad.robot import JOINT_NAMES
from perception.estimates import Frame
from scenes.gl import mujoco
from scenes.placement import settle_parts
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.controller import PickController
from twin.events import AttemptFinished, AttemptStarted, Event
from twin.nominal import nominal_calibration
from twin.oracle import OracleEstimator
from twin.referee import Referee
from twin.sim_robot import SimRobot

Timer = mujoco.mjtTimer
STAGES = {
    "collision": (Timer.mjTIMER_POS_COLLISION,),
    "constraints and solver": (Timer.mjTIMER_POS_MAKE, Timer.mjTIMER_POS_PROJECT, Timer.mjTIMER_CONSTRAINT),
    "kinematics and inertia": (Timer.mjTIMER_POS_KINEMATICS, Timer.mjTIMER_POS_INERTIA, Timer.mjTIMER_VELOCITY),
    "rest of the physics step": (),
}
"""Stages of a physics step by MuJoCo's own timers."""


@dataclass(frozen=True, kw_only=True)
class CellSpeed:
    """Options of the benchmark."""

    parts: int = 10
    """Parts on the board, of all built-in classes in turn."""
    picks: int = 3
    """Parts that are picked and placed, of all classes in turn."""
    repeats: int = 3
    """Runs of the same sequence; the best counts."""
    timestep_s: float = CellConfig().timestep_s
    seed: int = 0
    json: bool = False
    """Print JSON instead of a table."""

    def __post_init__(self) -> None:
        if not 1 <= self.picks <= self.parts or self.repeats < 1:
            raise ValueError(f"picks {self.picks} must be 1 to parts {self.parts}, repeats {self.repeats} at least 1")


@dataclass(frozen=True, kw_only=True)
class Timing:
    """CPU and simulated seconds of a run, its physics steps, and its stages in microseconds of wall time a step."""

    cpu_s: float
    simulated_s: float
    steps: int
    stages_us: dict[str, float]

    @property
    def factor(self) -> float:
        """Simulated time over CPU time."""
        return self.simulated_s / self.cpu_s


class _Enough(Exception):  # noqa: N818 - ends a run
    pass


@dataclass
class _Shutter:
    """A camera that takes no time and no picture; true poses need none."""

    data: mujoco.MjData
    cell: CellConfig

    def capture(self, exposure: float = 1.0) -> Frame:
        image = np.zeros((1, 1, 3), np.uint8)
        return Frame(image=image, intrinsics=self.cell.intrinsics, time_s=float(self.data.time))


@dataclass
class _Events:
    """Marks attempts for the referee and ends the run after so many."""

    referee: Referee
    left: int

    def __call__(self, event: Event) -> None:
        if isinstance(event, AttemptStarted):
            self.referee.begin_attempt()
        if isinstance(event, AttemptFinished):
            self.left -= 1
            if not self.left:
                raise _Enough


class Sequence:
    """The same picks again and again."""

    def __init__(self, options: CellSpeed) -> None:
        self._picks = options.picks
        self._cell = CellConfig(timestep_s=options.timestep_s)
        names = [BUILT_IN[i % len(BUILT_IN)] for i in range(options.parts)]
        self._parts = [load_part(name) for name in names]
        self._T_world_part = settle_parts(self._cell, names, np.random.default_rng(options.seed))
        self._model = build_workcell(self._cell, names).compile()

    def run(self, *, staged: bool = False) -> Timing:
        """Pick and place; ``staged`` measures the stages as well, which takes time itself."""
        model, cell = self._model, self._cell
        data = mujoco.MjData(model)
        set_parts(model, data, self._T_world_part)
        for name, q in zip(JOINT_NAMES, cell.home_q, strict=True):
            data.joint(name).qpos[0] = q
        mujoco.mj_forward(model, data)
        robot, referee = SimRobot(model, data, cell), Referee(model, data, cell, self._parts)
        watched_s = 0.0

        def watch() -> None:
            nonlocal watched_s
            before = time.perf_counter()
            referee.watch()
            watched_s += time.perf_counter() - before

        robot.on_step = watch if staged else referee.watch
        controller = PickController(
            robot,
            _Shutter(data, cell),
            OracleEstimator(model, data, self._parts, cell),
            ik=robot.ik,
            parts={part.name: part for part in self._parts},
            calibration=nominal_calibration(cell, sorted({part.name for part in self._parts})),
            on_event=_Events(referee, self._picks),
        )
        if staged:
            mujoco.set_mjcb_time(time.perf_counter)
        cpu, wall = time.process_time(), time.perf_counter()
        with suppress(_Enough):
            controller.run()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        mujoco.set_mjcb_time(None)
        steps = round(data.time / model.opt.timestep)
        stages = _stages(data, wall, watched_s) if staged else {}
        return Timing(
            cpu_s=cpu,
            simulated_s=float(data.time),
            steps=steps,
            stages_us={name: 1e6 * seconds / steps for name, seconds in stages.items()},
        )


def _stages(data: mujoco.MjData, wall_s: float, watched_s: float) -> dict[str, float]:
    """Seconds of every stage; the controller's are what the others leave."""
    physics = float(data.timer[Timer.mjTIMER_STEP].duration)
    out = {name: sum(float(data.timer[t].duration) for t in timers) for name, timers in STAGES.items()}
    out["rest of the physics step"] = physics - sum(out.values())
    return out | {"referee": watched_s, "controller, kinematics, planning": wall_s - physics - watched_s}


def main(options: CellSpeed) -> None:
    """Measure and print."""
    sequence = Sequence(options)
    runs = [sequence.run() for _ in range(options.repeats)]
    best, staged = min(runs, key=lambda run: run.cpu_s), sequence.run(staged=True)
    where = f"{machine()}; load {os.getloadavg()[0]:.1f}"
    what = (
        f"{options.parts} parts, {options.picks} picks, time step {1e3 * options.timestep_s:g} ms, seed {options.seed}"
    )
    if options.json:
        runs_json = [asdict(run) | {"factor": run.factor} for run in (*runs, staged)]
        print(json.dumps({"machine": where, "what": what, "factor": best.factor, "runs": runs_json}, indent=2))
        return
    table = Table(title=f"{best.factor:.1f} x real time on one core", title_justify="left")
    table.add_column("stage")
    table.add_column("us a step", justify="right")
    table.add_column("share", justify="right")
    whole = sum(staged.stages_us.values())
    for name, us in staged.stages_us.items():
        table.add_row(name, f"{us:.1f}", f"{100 * us / whole:.0f} %")
    table.add_section()
    table.add_row("run with timers, wall time", f"{whole:.1f}", "100 %")
    table.add_row("best run, CPU time", f"{1e6 * best.cpu_s / best.steps:.1f}", "")
    console = Console()
    console.print(where, what, sep="\n")
    console.print(table)
    console.print("all runs: " + ", ".join(f"{run.factor:.1f} x" for run in runs), highlight=False)


if __name__ == "__main__":
    main(tyro.cli(CellSpeed))
