"""One scene from falling parts to its result: build, drop, perceive, pick, place, judge."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from cad.parts import Part, load_part
from cad.robot import JOINT_NAMES
from cad.spatial import Array, inverse, rotation_from_rotvec, transform
from perception.estimates import PoseEstimator
from perception.overlay import save_picture
from scenes.camera import camera_pose, set_camera_pose
from scenes.classic import ClassicRenderer
from scenes.gl import mujoco
from scenes.placement import settle_parts
from scenes.sensor import SensorConfig
from scenes.workcell import CellConfig, build_workcell, set_parts
from twin.assessment import Beliefs, assess, centre, match, pose_error
from twin.attempts import Attempt
from twin.controller import PickController
from twin.events import AttemptFinished, AttemptStarted, Event, Looked, LookedAgain, NudgeStarted
from twin.nominal import nominal_calibration
from twin.oracle import OracleEstimator
from twin.pick_config import PickConfig
from twin.pictures import annotate, grasp_in_camera
from twin.referee import Referee
from twin.robot import RobotError
from twin.scorecard import SceneResult
from twin.second_look import SecondLookConfig
from twin.sim_camera import SimCamera
from twin.sim_robot import SimRobot
from twin.views import USUAL


@dataclass(frozen=True, kw_only=True)
class CameraPlacement:
    """How far a camera that somebody mounted stands from where the drawing has it; uniform, a side."""

    shift_m: float = 0.004
    tilt_rad: float = np.radians(0.7)
    yaw_rad: float = np.radians(2.0)

    def sample(self, T_board_cam: Array, rng: np.random.Generator) -> Array:
        """``T_board_cam`` (4, 4) of one mounting."""
        turn = rng.uniform(-1.0, 1.0, 3) * [self.tilt_rad, self.tilt_rad, self.yaw_rad]
        shift = rng.uniform(-1.0, 1.0, 3) * self.shift_m
        return transform(t=shift) @ T_board_cam @ transform(rotation_from_rotvec(turn))


@dataclass
class Stopwatch:
    """Wall time by stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to ``stage``."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


class SceneTrial:
    """Runs one scene of a pick run; every random choice comes from (seed, scene)."""

    def __init__(self, config: PickConfig, scene: int, estimator: PoseEstimator | None, cell: CellConfig) -> None:
        """``estimator`` None means the oracle, which is made for the scene."""
        self._config, self._scene, self._cell = config, scene, cell
        place, mount, noise = np.random.SeedSequence([config.seed, scene]).spawn(3)
        self._watch = Stopwatch()
        instances = [name for name in config.parts for _ in range(config.parts_per_class)]
        self._classes = {name: load_part(name, config.parts_dir) for name in config.parts}
        self._parts: list[Part] = [self._classes[name] for name in instances]
        T_world_part = settle_parts(cell, instances, np.random.default_rng(place))
        self._watch.lap("settle")
        self._model = build_workcell(cell, instances).compile()
        self._data = mujoco.MjData(self._model)
        T_board_cam = CameraPlacement().sample(cell.T_board_cam, np.random.default_rng(mount))
        set_parts(self._model, self._data, T_world_part)
        for name, q in zip(JOINT_NAMES, cell.home_q, strict=True):
            self._data.joint(name).qpos[0] = q
        mujoco.mj_forward(self._model, self._data)
        set_camera_pose(self._model, self._data, T_board_cam)  # the camera's mount is part of the board's body
        self._robot = SimRobot(self._model, self._data, cell, on_step=self._step)
        width, height = cell.intrinsics.width, cell.intrinsics.height
        blind = estimator is None and not config.pictures  # nobody looks at what the oracle's camera sees
        self._renderer = None if blind else ClassicRenderer(self._model, max_width=width, max_height=height)
        sensor = SensorConfig(exposure=config.exposure)
        self._camera = SimCamera(
            self._model, self._data, self._renderer, rng=np.random.default_rng(noise), sensor=sensor
        )
        self._estimator = estimator or OracleEstimator(self._model, self._data, self._parts, cell)
        self._referee = Referee(self._model, self._data, cell, self._parts)
        self._beliefs = [Beliefs() for _ in self._parts]
        self._target: int | None = None
        self._cycles: list[float] = []
        self._again: list[LookedAgain] = []
        self._cycle_start, self._looked_once = 0.0, False
        self._pending: Looked | None = None
        self._watch.lap("build")

    def run(self, on_attempt: Callable[[Attempt], None] | None = None) -> SceneResult:
        """Run the controller and judge; ``on_attempt`` is told of every finished attempt."""
        self._on_attempt = on_attempt or (lambda attempt: None)
        controller = PickController(
            self._robot,
            self._camera,
            self._estimator,
            ik=self._robot.ik,
            parts=self._classes,
            calibration=nominal_calibration(self._cell, list(self._classes)),
            second_look=SecondLookConfig(looks=self._config.second_looks),
            on_event=self._on_event,
        )
        try:
            with suppress(RobotError):  # a protective stop ends the scene; what is left on the board counts as failed
                controller.run()
            self._watch.lap("robot")
            self._draw_pending()
            records = self._referee.finish()
        finally:
            if self._renderer is not None:
                self._renderer.close()
        attempts = controller.attempts
        for attempt in attempts:
            i = self._nearest(attempt.T_base_part, attempt.part)
            if not attempt.tried and i is not None:
                self._beliefs[i].attempts.append(attempt)
        results = [
            assess(self._scene, record, part, beliefs)
            for record, part, beliefs in zip(records, self._parts, self._beliefs, strict=True)
        ]
        self._watch.lap("judge")
        return SceneResult(
            scene=self._scene,
            parts=tuple(results),
            cycle_s=tuple(self._cycles),
            retries=sum(a.tried and a.number > 1 for a in attempts),
            looked_again=tuple(self._again),
            wall_s=self._watch.seconds,
        )

    # -- what happens while the controller runs -------------------------------------------------------------------

    def _step(self) -> None:
        self._referee.watch()

    def _on_event(self, event: Event) -> None:
        match event:
            case Looked():
                self._watch.lap("look")
                self._looked(event)
            case LookedAgain():
                self._again.append(event)
            case NudgeStarted():
                self._referee.begin_attempt(nudge=True)
                self._draw_pending(event.nudge.T_base_start)
            case AttemptStarted():
                self._referee.begin_attempt()
                self._target = self._nearest(event.attempt.T_base_part, event.attempt.part)
                self._cycle_start = event.attempt.look_time_s
                self._draw_pending(event.attempt.T_base_tcp, event.attempt.approach_opening_m or 0.0)
            case AttemptFinished():
                if self._target is not None:
                    self._beliefs[self._target].attempts.append(event.attempt)
                if event.attempt.outcome == "placed":
                    self._cycles.append(event.attempt.end_s - self._cycle_start)
                self._on_attempt(event.attempt)
                self._watch.lap("robot")

    def _looked(self, look: Looked) -> None:
        if not self._looked_once:
            self._looked_once = True
            T_cam_parts = inverse(camera_pose(self._model, self._data)) @ self._referee.poses()
            found = match(look.estimate.parts, self._classes, self._parts, T_cam_parts)
            for i, seen in found.items():
                self._beliefs[i].estimate = seen
                self._beliefs[i].error = pose_error(self._parts[i], T_cam_parts[i], seen)
        self._draw_pending()
        self._pending = look
        self._watch.lap("pictures")

    def _draw_pending(self, T_base_tcp: Array | None = None, opening_m: float = 0.0) -> None:
        """Save the picture of the last look, with the grasp or the push that it led to if it led to one."""
        if self._pending is None or not self._config.pictures:
            return
        look, self._pending = self._pending, None
        chosen = None
        if T_base_tcp is not None:
            chosen = grasp_in_camera(T_base_tcp, self._cell.T_world_board, look.estimate.T_cam_board)
        view = "" if look.view == str(USUAL) else f"_{look.view.replace(' ', '_')}"
        name = f"scene_{self._scene:03d}_time_{look.frame.time_s:07.2f}{view}.jpg"
        save_picture(
            self._config.out / "frames" / name, annotate(look.frame, look.estimate, self._classes, chosen, opening_m)
        )
        self._watch.lap("pictures")

    def _nearest(self, T_world_part: Array, name: str) -> int | None:
        """Index of the presented part that lies where an estimate says, None when none is within 10 mm."""
        there = np.array([centre(p, T)[:2] for p, T in zip(self._parts, self._referee.poses(), strict=True)])
        distance = np.linalg.norm(there - centre(self._classes[name], T_world_part)[:2], axis=1)
        return int(distance.argmin()) if distance.min() < 0.010 else None
