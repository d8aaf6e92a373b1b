"""Velocity profiles of the moves: how far along a path the robot is at each control period.

UR's moveJ and moveL run a trapezoidal speed profile along the path: constant acceleration, constant speed, constant
deceleration, and a triangle where the path is too short to reach the speed (URScript manual, "moveJ" and "moveL").
In moveJ the given speed and acceleration are the leading axis's, the other joints are scaled to start and stop with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cad.spatial import Array, inverse, rotation_from_rotvec, rotvec_from_rotation, transform
from twin.robot import TwinError

ROTATION_LEVER_M = 0.1
"""Path length that one radian of tool rotation counts for in a linear move (a fingertip's lever about the wrist)."""


class ProfileError(TwinError):
    """A profile that cannot be followed: a speed, acceleration or control period that makes no sense."""


@dataclass(frozen=True, kw_only=True)
class Trapezoid:
    """Distance over time with bounded speed and acceleration, at rest at both ends.

    ``length``, ``speed`` and ``acceleration`` share one unit of distance (rad or m), per second and per second squared.
    """

    length: float
    speed: float
    acceleration: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.length) and self.length >= 0):
            raise ProfileError(f"path length {self.length} must be finite and not negative")
        for name, value in (("speed", self.speed), ("acceleration", self.acceleration)):
            if not (np.isfinite(value) and value > 0):
                raise ProfileError(f"{name} {value} must be finite and positive")

    @cached_property
    def peak_speed(self) -> float:
        """Highest speed reached: the given one, or less on a path too short for it."""
        return float(min(self.speed, np.sqrt(self.length * self.acceleration)))

    @cached_property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        if self.length == 0.0:
            return 0.0
        return self.length / self.peak_speed + self.peak_speed / self.acceleration

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Distance, speed and acceleration at ``time_s``, which is clamped to [0, duration_s]."""
        ramp_s = self.peak_speed / self.acceleration
        left_s = self.duration_s - time_s
        if time_s <= 0.0 or self.length == 0.0:
            return 0.0, 0.0, 0.0
        if left_s <= 0.0:
            return self.length, 0.0, 0.0
        if time_s < ramp_s:
            return 0.5 * self.acceleration * time_s**2, self.acceleration * time_s, self.acceleration
        if left_s < ramp_s:
            return self.length - 0.5 * self.acceleration * left_s**2, self.acceleration * left_s, -self.acceleration
        return self.peak_speed * (time_s - 0.5 * ramp_s), self.peak_speed, 0.0


@dataclass(frozen=True, kw_only=True)
class JointPath:
    """UR's moveJ: all joints go from ``q_start`` to ``q_end`` (n,) rad on one trapezoid of the leading axis."""

    q_start: Array
    q_end: Array
    speed: float
    acceleration: float

    @cached_property
    def profile(self) -> Trapezoid:
        """Profile of the leading axis, the joint that moves furthest, in rad."""
        lead = float(np.abs(self.q_end - self.q_start).max(initial=0.0))
        return Trapezoid(length=lead, speed=self.speed, acceleration=self.acceleration)

    @cached_property
    def direction(self) -> Array:
        """What each joint (n,) moves for a radian of the leading axis."""
        way = self.q_end - self.q_start
        return way / self.profile.length if self.profile.length else way

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return self.profile.duration_s

    def at(self, time_s: float) -> tuple[Array, Array, Array]:
        """Joint positions, speeds and accelerations, each (n,), at ``time_s``."""
        s, ds, dds = self.profile.at(time_s)
        return self.q_start + self.direction * s, self.direction * ds, self.direction * dds


@dataclass(frozen=True, kw_only=True)
class LinearPath:
    """UR's moveL: the TCP goes along a straight line while the tool turns about one fixed axis.

    The path length is the longer of the line and ``ROTATION_LEVER_M`` times the angle, so that a pure rotation has a
    finite speed too.
    """

    T_base_start: Array
    T_base_end: Array
    speed: float
    acceleration: float

    @cached_property
    def rotvec(self) -> Array:
        """Rotation from start to end as a rotation vector (3,) rad in the tool's starting frame."""
        return rotvec_from_rotation((inverse(self.T_base_start) @ self.T_base_end)[:3, :3])

    @cached_property
    def profile(self) -> Trapezoid:
        """Profile along the path, in metres."""
        line = float(np.linalg.norm(self.T_base_end[:3, 3] - self.T_base_start[:3, 3]))
        arc = ROTATION_LEVER_M * float(np.linalg.norm(self.rotvec))
        return Trapezoid(length=max(line, arc), speed=self.speed, acceleration=self.acceleration)

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        return self.profile.duration_s

    def at(self, time_s: float) -> Array:
        """``T_base_tcp`` (4, 4) at ``time_s``."""
        profile = self.profile
        return self.at_share(profile.at(time_s)[0] / profile.length if profile.length > 0.0 else 1.0)

    def at_share(self, share: float) -> Array:
        """``T_base_tcp`` (4, 4) after a share in [0, 1] of the path."""
        start, end = self.T_base_start, self.T_base_end
        R = start[:3, :3] @ rotation_from_rotvec(share * self.rotvec)
        return transform(R, start[:3, 3] + share * (end[:3, 3] - start[:3, 3]))


def speed_for(length: float, acceleration: float, duration_s: float) -> float:
    """Speed at which a trapezoid over ``length`` takes ``duration_s``; infinite where it cannot be that quick.

    From ``duration = length / speed + speed / acceleration``, the slower root.
    """
    discriminant = (acceleration * duration_s) ** 2 - 4 * acceleration * length
    return float(acceleration * duration_s - np.sqrt(discriminant)) / 2 if discriminant > 0 else float("inf")


def steps_per_period(period_s: float, step_s: float) -> int:
    """Physics steps in one control period.

    Raises ProfileError when the period is not a whole multiple of the step: the clock and the motion would drift apart.
    """
    if not (period_s > 0 and step_s > 0):
        raise ProfileError(f"control period {period_s} s and physics step {step_s} s must both be positive")
    ratio = period_s / step_s
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise ProfileError(
            f"the control period {period_s} s is not a whole multiple of the physics step {step_s} s; "
            f"choose a step that divides the period, such as {period_s / max(1, round(ratio))} s"
        )
    return round(ratio)


def sample_times(duration_s: float, period_s: float) -> Iterator[float]:
    """Set-point times of a move: every control period after the start, the last one at or just after the end."""
    for k in range(1, max(1, int(np.ceil(duration_s / period_s - 1e-9))) + 1):
        yield k * period_s


def sample(profile: Trapezoid, period_s: float) -> Array:
    """Distance, speed and acceleration at the set-point times of a move, (3, n, 1) to be scaled along n rows."""
    return np.array([profile.at(time_s) for time_s in sample_times(profile.duration_s, period_s)]).T[:, :, None]
