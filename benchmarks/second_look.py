"""What other looks are worth: the same scenes with an unsure estimator, with and without looks before it declines.

``python -m benchmarks.second_look`` prints the table of ``docs/second_look.md``. The poses are true, so that nothing
but the doubt differs: three in ten parts are declined as they lie at first, and again in any other view and after any
push with a probability of a half.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from cad.parts import BUILT_IN, load_part
from cad.robot import JOINT_NAMES
from perception.estimates import AMBIGUOUS, Frame, FrameEstimate, PartEstimate
from scenes.camera import camera_pose
from scenes.gl import mujoco
from scenes.placement import settle_parts
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.attempts import Attempt
from twin.controller import PickController
from twin.events import AttemptStarted, Event, LookedAgain, NudgeStarted
from twin.nominal import nominal_calibration
from twin.oracle import OracleEstimator
from twin.referee import PartRecord, Referee
from twin.robot import RobotError
from twin.second_look import SecondLookConfig
from twin.sim_camera import SimCamera
from twin.sim_robot import SimRobot
from twin.views import LookKind

ROWS: tuple[tuple[LookKind, ...], ...] = ((), ("exposure",), ("nudge",), ("exposure", "nudge"))


@dataclass(frozen=True, kw_only=True)
class Config:
    """Scenes of ``parts_per_class`` parts of each class, the same ones for every row of the table.

    ``doubt`` is the share of parts that the first look declines, ``again`` the probability that such a part is declined
    when it is seen, or lies, in another way.
    """

    scenes: int = 10
    parts_per_class: int = 2
    seed: int = 500
    doubt: float = 0.3
    again: float = 0.5


class Scene:
    """One scene, its referee, and an estimator and a camera in one: it must know how a frame was exposed."""

    def __init__(self, config: Config, scene: int, looks: tuple[LookKind, ...]) -> None:
        self._config, self._scene, cell = config, scene, CellConfig()
        names = [name for name in BUILT_IN for _ in range(config.parts_per_class)]
        parts = [load_part(name) for name in names]
        self._model = build_workcell(cell, names).compile()
        self._data = mujoco.MjData(self._model)
        rng = np.random.default_rng([config.seed, scene])
        set_parts(self._model, self._data, settle_parts(cell, names, rng))
        for name, q in zip(JOINT_NAMES, cell.home_q, strict=True):
            self._data.joint(name).qpos[0] = q
        mujoco.mj_forward(self._model, self._data)
        self._robot = SimRobot(self._model, self._data, cell, on_step=lambda: self.referee.watch())
        self.referee = Referee(self._model, self._data, cell, parts)
        self._first = self.referee.poses()
        self._camera = SimCamera(self._model, self._data, None, rng=rng)
        self._exposure = 1.0
        self._oracle = OracleEstimator(self._model, self._data, parts, cell)
        self.again: list[LookedAgain] = []
        self._controller = PickController(
            self._robot,
            self,
            self,
            ik=self._robot.ik,
            parts={part.name: part for part in parts},
            calibration=nominal_calibration(cell, BUILT_IN),
            second_look=SecondLookConfig(looks=looks),
            on_event=self._on_event,
        )

    def run(self) -> tuple[list[Attempt], list[PartRecord], float]:
        """Attempts, what became of the parts, and the simulated time that it took."""
        with suppress(RobotError):
            self._controller.run()
        end_s = float(self._data.time)
        return self._controller.attempts, self.referee.finish(), end_s

    def capture(self, exposure: float = 1.0) -> Frame:
        """See :class:`twin.robot.Camera`."""
        self._exposure = exposure
        return self._camera.capture(exposure)

    def estimate(self, frame: Frame) -> FrameEstimate:
        """See :class:`perception.estimates.PoseEstimator`."""
        seen = self._oracle.estimate(frame)
        return replace(seen, parts=tuple(self._doubt(part) for part in seen.parts))

    def _doubt(self, part: PartEstimate) -> PartEstimate:
        T_world_part = camera_pose(self._model, self._data) @ part.T_cam_part
        distance = np.linalg.norm(self.referee.poses()[:, :3, 3] - T_world_part[:3, 3], axis=1)
        i = int(distance.argmin())
        moved = np.linalg.norm(T_world_part - self._first[i]) > 1e-3
        declined = self._draw(i) < self._config.doubt
        if declined and (moved or self._exposure != 1.0):
            here = np.round(1e3 * T_world_part[:2, 3]).astype(int).tolist()
            declined = self._draw(i, here, self._exposure) < self._config.again
        return replace(part, score=0.6, verdict=AMBIGUOUS) if declined else replace(part, score=0.98)

    def _draw(self, *key: Any) -> float:
        """Uniform in [0, 1), the same for the same key whatever was drawn before."""
        digest = hashlib.sha256(repr((self._config.seed, self._scene, *key)).encode()).digest()
        return int.from_bytes(digest[:8], "big") / 2.0**64

    def _on_event(self, event: Event) -> None:
        if isinstance(event, AttemptStarted | NudgeStarted):
            self.referee.begin_attempt(nudge=isinstance(event, NudgeStarted))
        if isinstance(event, LookedAgain):
            self.again.append(event)


def row(config: Config, looks: tuple[LookKind, ...]) -> list[str]:
    """One line of the table: the same scenes, with these looks."""
    runs = [(scene := Scene(config, i, looks), *scene.run()) for i in range(config.scenes)]
    records = [record for _, _, records, _ in runs for record in records]
    attempts = [attempt for _, attempts, _, _ in runs for attempt in attempts]
    again = [look for scene, *_ in runs for look in scene.again]
    cycles = [a.end_s - a.look_time_s for a in attempts if a.outcome == "placed"]
    return [
        " + ".join(looks) or "none",
        f"{sum(r.succeeded for r in records)} of {len(records)}",
        str(sum(a.outcome == "declined" for a in attempts)),
        str(sum(bool(r.collisions or r.disturbed) for r in records)),
        f"{len(again)}, {sum(look.seconds for look in again):.0f} s",
        str(sum(r.nudges for r in records)),
        f"{np.mean(cycles):.2f} s",
        f"{sum(end_s for *_, end_s in runs):.0f} s",
    ]


def main(config: Config) -> None:
    """Print the table."""
    headings = ("other looks", "placed", "declined", "touched or moved others", "looks", "pushes", "cycle", "all")
    table = Table(*headings, title=f"{config.scenes} scenes, seed {config.seed}")
    for looks in ROWS:
        table.add_row(*row(config, looks))
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Config))
