"""What a controller tells while it runs."""

from __future__ import annotations

from dataclasses import dataclass

from perception.estimates import Frame, FrameEstimate
from twin.attempts import Attempt
from twin.nudge import Nudge
from twin.views import LookKind


@dataclass(frozen=True, kw_only=True)
class Looked:
    """A frame was taken and understood; ``view`` says how it was taken, in words."""

    frame: Frame
    estimate: FrameEstimate
    view: str = "usual"


@dataclass(frozen=True, kw_only=True)
class LookedAgain:
    """Another look was taken because ``unsure`` parts were in doubt, and settled ``accepted`` of them.

    ``seconds`` of the robot's time went by from the decision to the look's outcome.
    """

    kind: LookKind
    unsure: int
    accepted: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class NudgeStarted:
    """The arm is about to push a part."""

    nudge: Nudge


@dataclass(frozen=True, kw_only=True)
class NudgeFinished:
    """The push ended; ``note`` says why when the robot refused it."""

    nudge: Nudge
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class AttemptStarted:
    """The arm is about to move for this attempt, chosen from ``estimate`` of ``frame``."""

    attempt: Attempt
    frame: Frame
    estimate: FrameEstimate


@dataclass(frozen=True, kw_only=True)
class AttemptFinished:
    """The attempt ended; ``attempt.outcome`` says how."""

    attempt: Attempt


Event = Looked | LookedAgain | NudgeStarted | NudgeFinished | AttemptStarted | AttemptFinished
