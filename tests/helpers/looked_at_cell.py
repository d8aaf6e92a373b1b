"""The simulated cell with parts lying where a test puts them, watched by the referee and by a scripted estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cad.parts import load_part, planar
from cad.robot import JOINT_NAMES
from cad.spatial import Array
from perception.estimates import Frame, FrameEstimate, PartEstimate
from scenes.gl import mujoco
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.attempts import Calibration
from twin.controller import PickController
from twin.events import AttemptStarted, Event, NudgeStarted
from twin.nominal import nominal_calibration
from twin.oracle import OracleEstimator
from twin.referee import Referee
from twin.second_look import SecondLookConfig
from twin.sim_camera import SimCamera
from twin.sim_robot import SimRobot

CELL = CellConfig()
Change = Callable[[PartEstimate, float], PartEstimate]
"""What a scripted estimator makes of a true estimate, told the exposure of the frame."""


class _Camera(SimCamera):
    exposure = 1.0

    def capture(self, exposure: float = 1.0) -> Frame:
        self.exposure = exposure
        return super().capture(exposure)


class LookedAtCell:
    """``places`` are (class, stable pose, x, y, yaw) on the board; ``change`` alters what the oracle says of each."""

    def __init__(
        self,
        places: Sequence[tuple[str, int, float, float, float]],
        change: Change = lambda estimate, exposure: estimate,
        second_look: SecondLookConfig | None = None,
        calibrated: Callable[[Calibration], Calibration] = lambda calibration: calibration,
    ) -> None:
        names = [place[0] for place in places]
        self.parts = [load_part(name) for name in names]
        self.model = build_workcell(CELL, names).compile()
        self.data = mujoco.MjData(self.model)
        lying = [
            CELL.T_world_board @ planar(x, y, yaw) @ part.stable_poses[pose].T_table_part
            for part, (_, pose, x, y, yaw) in zip(self.parts, places, strict=True)
        ]
        set_parts(self.model, self.data, np.array(lying))
        self.calibration = calibrated(nominal_calibration(CELL, sorted(set(names))))
        for name, q in zip(JOINT_NAMES, self.calibration.q_park, strict=True):
            self.data.joint(name).qpos[0] = q
        mujoco.mj_forward(self.model, self.data)
        self.robot = SimRobot(self.model, self.data, CELL, on_step=lambda: self.referee.watch())
        self.referee = Referee(self.model, self.data, CELL, self.parts)
        self.camera = _Camera(self.model, self.data, None, rng=np.random.default_rng(0), latency_s=0.3)
        self.oracle, self.change = OracleEstimator(self.model, self.data, self.parts, CELL), change
        self.events: list[Event] = []
        self.on_event: Callable[[Event], object] = lambda event: None
        self.controller = PickController(
            self.robot,
            self.camera,
            self,
            ik=self.robot.ik,
            parts={part.name: part for part in self.parts},
            calibration=self.calibration,
            second_look=second_look,
            on_event=self._on_event,
        )

    def estimate(self, frame: Frame) -> FrameEstimate:
        truth = self.oracle.estimate(frame)
        return replace(truth, parts=tuple(self.change(part, self.camera.exposure) for part in truth.parts))

    def poses(self) -> Array:
        """``T_world_part`` (N, 4, 4) now."""
        return self.referee.poses()

    def run(self):
        """Attempts of the controller and records of the referee."""
        return self.controller.run(), self.referee.finish()

    def _on_event(self, event: Event) -> None:
        self.events.append(event)
        self.on_event(event)
        if isinstance(event, AttemptStarted | NudgeStarted):
            self.referee.begin_attempt(nudge=isinstance(event, NudgeStarted))
