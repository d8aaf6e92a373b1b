"""The robot and camera as the controller sees them; simulated and real ones implement the same protocols.

Frames: ``base`` is the UR base frame; ``tcp`` sits between the fingertips at their lower ends, +z out of the tool (the
approach direction), +x along the direction in which the fingers close.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from cad.spatial import Array, transform
from perception.estimates import Frame


class TwinError(Exception):
    """Root of the errors that ``twin`` raises."""


class RobotError(TwinError):
    """A motion that the robot refused or could not finish; the message says what was asked and why not."""


class MotionRefused(RobotError):  # noqa: N818 - a refusal, as controllers call it
    """A motion that the robot refused before anything moved: outside its limits, not finite, or below the table."""


class GripState(Enum):
    """What the hand reports, after Robotiq's object-detection states."""

    MOVING = 0
    CONTACT_OPENING = 1
    CONTACT_CLOSING = 2
    AT_POSITION = 3


@dataclass(frozen=True, kw_only=True)
class RobotState:
    """One observation: joint positions and speeds (6,), ``T_base_tcp`` (4, 4), opening between the pads in metres."""

    time_s: float
    q: Array
    qd: Array
    T_base_tcp: Array
    opening_m: float
    grip: GripState


@dataclass(frozen=True, kw_only=True)
class JointMove:
    """What a joint move sent: target (6,) rad, leading-axis speed rad/s and acceleration rad/s^2, duration s."""

    q: Array
    speed: float
    acceleration: float
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class LinearMove:
    """What a linear move sent: ``T_base_tcp`` (4, 4), speed m/s, acceleration m/s^2, duration s."""

    T_base_tcp: Array
    speed: float
    acceleration: float
    duration_s: float


def top_down(x: float, y: float, z: float, yaw: float) -> Array:
    """``T_base_tcp`` (4, 4) of a tool that points straight down at (x, y, z) m, closing direction at ``yaw`` rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return transform([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]], [x, y, z])


class Robot(Protocol):
    """An arm with a parallel gripper. Every move blocks until done and raises RobotError when it cannot be finished."""

    def observe(self) -> RobotState:
        """The latest measured state."""
        ...

    def move_j(self, q: Array, *, speed: float, acceleration: float) -> JointMove:
        """Synchronised trapezoidal move in joint space (UR's moveJ)."""
        ...

    def move_l(self, T_base_tcp: Array, *, speed: float, acceleration: float) -> LinearMove:
        """Straight-line trapezoidal move of the TCP (UR's moveL)."""
        ...

    def grip(self, opening_m: float, *, force_n: float, speed: float) -> RobotState:
        """Drive the fingers to an opening, stopping on contact; returns the state once they rest."""
        ...

    def stop(self) -> None:
        """Stop all motion now."""
        ...


class Camera(Protocol):
    """A camera that looks at the board."""

    def capture(self, exposure: float = 1.0) -> Frame:
        """A fresh frame, exposed after the call for ``exposure`` times the camera's usual exposure time.

        Raises TwinError when none has come by the camera's own deadline.
        """
        ...
