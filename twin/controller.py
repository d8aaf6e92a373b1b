"""The pick-and-place state machine: look, choose, approach, close, check the grip, lift, place, look again.

It knows only what the robot, the camera and the estimator tell it, the parts' folders and the nominal calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from cad.parts import Part
from cad.spatial import Array, apply, inverse
from perception.estimates import Frame, FrameEstimate, PerceptionError, PoseEstimator
from twin.actions import ActionFailed, Actions
from twin.attempts import Attempt, Calibration, ControllerConfig, Outcome
from twin.candidates import Candidate, bring_down
from twin.events import AttemptFinished, AttemptStarted, Event, Looked, LookedAgain, NudgeFinished, NudgeStarted
from twin.grasp_choice import GraspChoice, PlacedPart, choose_grasp
from twin.grasp_config import GraspConfig
from twin.grasps import describe_grasps
from twin.ik import ArmIk, IkError
from twin.nudge import Nudge, plan_nudge
from twin.park_pose import park_elsewhere
from twin.robot import Camera, MotionRefused, Robot, RobotError, TwinError
from twin.second_look import SecondLookConfig, SecondLooks
from twin.views import View


class ControllerError(TwinError):
    """A run that cannot start or go on: a part without grasps or nests."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """A frame, how it was taken, and what it shows."""

    frame: Frame
    estimate: FrameEstimate
    view: View
    candidates: list[Candidate]


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """What an attempt will do: a candidate, its grasp, and the nest it goes to."""

    candidate: Candidate
    choice: GraspChoice
    nest: int
    T_base_part_at_nest: Array


class PickController:
    """Picks every part it can see and puts each into the next free nest of its class.

    ``parts`` are the classes to handle by name; ``on_event`` is told of every look and attempt as they happen.
    """

    def __init__(
        self,
        robot: Robot,
        camera: Camera,
        estimator: PoseEstimator,
        *,
        ik: ArmIk,
        parts: Mapping[str, Part],
        calibration: Calibration,
        config: ControllerConfig | None = None,
        grasp_config: GraspConfig | None = None,
        second_look: SecondLookConfig | None = None,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        missing = sorted(set(parts) - set(calibration.T_base_nests))
        if missing:
            raise ControllerError(f"no nests for {missing}; the calibration has {sorted(calibration.T_base_nests)}")
        self._robot, self._camera, self._estimator, self._ik = robot, camera, estimator, ik
        self._parts, self._calibration = dict(parts), calibration
        self._grasps = {name: describe_grasps(part) for name, part in parts.items()}
        self._config, self._grasp_config = config or ControllerConfig(), grasp_config or GraspConfig()
        self._on_event = on_event or (lambda event: None)
        self._in_nests: dict[str, dict[int, PlacedPart]] = {name: {} for name in parts}
        self._tries: list[Array] = []
        self._actions = Actions(robot, ik, calibration, self._config)
        self._q_elsewhere, self._parked_elsewhere = park_elsewhere(ik, calibration), False
        self._second = SecondLooks(second_look or SecondLookConfig(), elsewhere=self._q_elsewhere is not None)
        self._since_s: float | None = None
        self.attempts: list[Attempt] = []

    def run(self) -> list[Attempt]:
        """Look and pick until nothing is left that can be picked; returns every attempt and every part left behind.

        What the estimator is unsure of is looked at again in other ways before it is left behind, once there is nothing
        else to pick. Raises RobotError when the robot stops by itself in a move: somebody has to look at it first.
        """
        self._actions.park()
        idle, left_behind, view, again = 0, [], self._second.home, None
        for _ in range(self._config.max_looks):
            seen = self._look(view) if again is None else self._look_again(again, view)
            plan, left_behind = self._choose(seen.candidates) if seen else (None, left_behind)
            again = None
            if seen and plan:
                idle, self._second.home = 0, view
                self._attempt(plan, seen)
                continue
            again = self._second.next(view, seen.candidates, self._plan_nudge) if seen else None
            if again is not None:
                view = again if isinstance(again, View) else self._second.home
                continue
            idle += 1
            if view == self._second.home and (idle >= self._config.idle_looks or (seen and not left_behind)):
                break
            view = self._second.home
        self.attempts += left_behind
        return self.attempts

    # -- look -----------------------------------------------------------------------------------------------------

    def _look(self, view: View) -> Seen | None:
        """A frame taken now and what it shows; None when the frame cannot be used."""
        if view.elsewhere != self._parked_elsewhere:
            self._park(elsewhere=view.elsewhere)
        frame = self._camera.capture(view.exposure)
        if self._since_s is None:
            self._since_s = frame.time_s
        try:
            estimate = self._estimator.estimate(frame)
        except PerceptionError:
            return None
        self._on_event(Looked(frame=frame, estimate=estimate, view=str(view)))
        T_base_cam = self._calibration.T_base_board @ inverse(estimate.T_cam_board)
        candidates = [
            bring_down(seen, self._parts, T_base_cam, self._calibration, self._config)
            for seen in estimate.parts
            if seen.part in self._parts
        ]
        others = [
            apply(T_base_cam, seen.T_cam_part[:3, 3])[:2] for seen in estimate.parts if seen.part not in self._parts
        ]
        candidates = self._second.take_in(view, candidates, others)
        return Seen(frame=frame, estimate=estimate, view=view, candidates=candidates)

    def _look_again(self, again: View | Nudge, view: View) -> Seen | None:
        """Another look at what is in doubt, after a push if it takes one, and an account of it."""
        start_s, unsure = self._robot.observe().time_s, self._second.unsure
        if isinstance(again, Nudge):
            self._nudge(again)
        seen = self._look(view)
        seconds = self._robot.observe().time_s - start_s
        self._second.looked(seconds)
        accepted = self._second.accepted if seen else 0
        kind = "nudge" if isinstance(again, Nudge) else again.kind
        self._on_event(LookedAgain(kind=kind, unsure=unsure, accepted=accepted, seconds=seconds))
        return seen

    def _nudge(self, nudge: Nudge) -> None:
        self._on_event(NudgeStarted(nudge=nudge))
        note = ""
        try:
            self._actions.nudge(nudge, self._second.config.nudge)
        except (MotionRefused, IkError) as refusal:
            note = str(refusal)
        self._second.pushed(nudge)
        try:
            self._park()
        finally:
            self._on_event(NudgeFinished(nudge=nudge, note=note))

    def _plan_nudge(self, target: Candidate, others: list[Array]) -> Nudge | str:
        return plan_nudge(
            target,
            others,
            radius_m=max(part.radius_m for part in self._parts.values()),
            solve=self._ik.solve,
            calibration=self._calibration,
            config=self._second.config.nudge,
        )

    def _park(self, *, elsewhere: bool = False) -> None:
        self._actions.park(self._q_elsewhere if elsewhere else None)
        self._parked_elsewhere = elsewhere

    # -- choose ---------------------------------------------------------------------------------------------------

    def _choose(self, candidates: list[Candidate]) -> tuple[Plan | None, list[Attempt]]:
        """The next part to pick, least tried and surest first, and what cannot be picked and why."""
        left_behind: list[Attempt] = []
        for candidate in sorted(candidates, key=lambda c: (self._tries_at(c.placed), -c.estimate.score)):
            problem = candidate.problem
            if problem is None and self._tries_at(candidate.placed) >= self._config.tries_per_region:
                problem = "grasp", f"gave up after {self._config.tries_per_region} tries"
            plan = problem or self._plan(candidate, [c.placed for c in candidates if c is not candidate])
            if isinstance(plan, Plan):
                return plan, left_behind
            left_behind.append(self._left_behind(candidate, *plan))
        return None, left_behind

    def _plan(self, candidate: Candidate, neighbours: list[PlacedPart]) -> Plan | tuple[Outcome, str]:
        name, k = candidate.estimate.part, candidate.estimate.stable_pose
        known = self._grasps[name][k]
        if known.why_not:
            return "grasp", f"face {k} cannot be gripped: {known.why_not}"
        nests, filled = self._calibration.T_base_nests[name], self._in_nests[name]
        nest = next((n for n in range(len(nests)) if n not in filled), None)
        if nest is None:
            return "place", f"all {len(nests)} nests of {name!r} are taken"
        T_base_part_at_nest = nests[nest] @ candidate.placed.part.stable_poses[k].T_table_part
        choice = choose_grasp(
            candidate.placed,
            neighbours,
            T_base_part_at_nest,
            [p for nests in self._in_nests.values() for p in nests.values()],
            known.grasps,
            self._ik.solve,
            self._calibration.q_park,
            self._grasp_config,
        )
        if isinstance(choice, str):
            return ("ik" if "reach" in choice else "grasp"), choice
        return Plan(candidate=candidate, choice=choice, nest=nest, T_base_part_at_nest=T_base_part_at_nest)

    def _tries_at(self, placed: PlacedPart) -> int:
        here = placed.T_base_part[:2, 3]
        return sum(bool(np.linalg.norm(here - there) < self._config.region_m) for there in self._tries)

    def _left_behind(self, candidate: Candidate, outcome: Outcome, note: str) -> Attempt:
        now = self._robot.observe().time_s
        return Attempt(
            part=candidate.estimate.part,
            stable_pose=candidate.estimate.stable_pose,
            T_base_part=candidate.placed.T_base_part,
            outcome=outcome,
            note=note,
            tried=False,
            number=self._tries_at(candidate.placed),
            look_time_s=now,
            start_s=now,
            end_s=now,
        )

    # -- pick and place -------------------------------------------------------------------------------------------

    def _attempt(self, plan: Plan, seen: Seen) -> None:
        """Pick the planned part and place it, and say how that ended."""
        placed, choice = plan.candidate.placed, plan.choice
        self._second.forget(plan.candidate.centre)
        self._tries.append(placed.T_base_part[:2, 3].copy())
        attempt = Attempt(
            part=placed.part.name,
            stable_pose=choice.grasp.stable_pose,
            T_base_part=placed.T_base_part,
            number=self._tries_at(placed),
            grasp=choice.grasp,
            T_part_tcp=choice.T_part_tcp,
            nest=plan.nest,
            approach_opening_m=choice.openings_m[0],
            view=str(seen.view),
            look_time_s=seen.frame.time_s if self._since_s is None else self._since_s,
            start_s=self._robot.observe().time_s,
        )
        self._since_s = None
        self._on_event(AttemptStarted(attempt=attempt, frame=seen.frame, estimate=seen.estimate))
        try:
            attempt = replace(attempt, opening_m=self._actions.pick(placed.T_base_part, choice))
            self._actions.carry(plan.T_base_part_at_nest, choice)
            # from here on the nest counts as taken, whatever happens
            self._in_nests[placed.part.name][plan.nest] = replace(placed, T_base_part=plan.T_base_part_at_nest)
            self._actions.place(plan.T_base_part_at_nest, choice)
            attempt = replace(attempt, outcome="placed")
        except ActionFailed as failure:
            attempt = replace(attempt, outcome=failure.outcome, note=str(failure))
        except (MotionRefused, IkError) as refusal:
            attempt = replace(attempt, outcome="ik", note=str(refusal))
        except RobotError as error:
            self._finish(replace(attempt, outcome="collision", note=str(error)))
            raise
        try:
            self._park()
        finally:
            self._finish(attempt)

    def _finish(self, attempt: Attempt) -> None:
        attempt = replace(attempt, end_s=self._robot.observe().time_s)
        self.attempts.append(attempt)
        self._on_event(AttemptFinished(attempt=attempt))
