"""The Hand-E's own controller in simulation: opening, speed and force as commanded, object detection from contact.

Like the real hand it drives the fingers at the commanded speed; fingers that cannot follow are pushed with the
commanded force until they can, or until another command comes.
"""

from __future__ import annotations

import numpy as np

from cad import gripper
from scenes.arm import FINGER_JOINTS, GRIPPER_ACTUATOR, hand_inputs
from scenes.gl import mujoco
from twin.robot import GripState, MotionRefused

REACH_M = 0.3e-3
"""An opening this close to the commanded one has been reached. Fingers this far behind their set point have stalled."""
REST_SPEED = 0.5e-3
"""m/s of opening below which a grip is done."""
STOPPED_SPEED = 10e-3
"""m/s of opening up to which fingers count as stopped by what they press on: a hand that is carried about shivers."""
TOUCH_SHARE = 0.5
"""Contact counts once it takes up this share of the commanded force; both fingers together give twice that force."""


class SimHand:
    """The hand of a compiled cell. :meth:`advance` must be called once every control period, before the physics."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        joints = [model.joint(name) for name in FINGER_JOINTS]
        self._left, self._right = (int(j.qposadr[0]) for j in joints)
        self._dofs = np.array([j.dofadr[0] for j in joints])
        self._opens = np.zeros(model.nbody)
        for joint in joints:  # the x direction in which a finger opens; 0 for every other body
            self._opens[joint.bodyid[0]] = model.jnt_axis[joint.id][0]
        self._actuator = model.actuator(GRIPPER_ACTUATOR).id
        self._inputs = hand_inputs(model)
        self._target = self._set_point = self.opening_m
        self._direction, self._speed = 0.0, gripper.SPEED_RANGE_M_S[0]
        data.ctrl[self._inputs] = self._target, 0.0, 0.0

    @property
    def opening_m(self) -> float:
        """Opening between the pads."""
        return float(self._data.qpos[self._left] + self._data.qpos[self._right])

    @property
    def speed(self) -> float:
        """Speed of both fingers together, m/s, not negative."""
        return float(np.abs(self._data.qvel[self._dofs]).sum())

    @property
    def at_rest(self) -> bool:
        """Whether the fingers have stopped: where they were sent, or stalled on the way."""
        arrived = abs(self._target - self._set_point) < 1e-9
        return self.speed < REST_SPEED and (arrived or self._stalled)

    @property
    def state(self) -> GripState:
        """The hand's object detection (``gOBJ`` in Robotiq's manual, section 4).

        Contact is reported only by fingers that something has stopped short of the commanded opening and that press
        on it; an object that is lost later ends in AT_POSITION, once the fingers have closed the gap.
        """
        short = self.opening_m - self._target
        if abs(short) <= REACH_M:
            return GripState.AT_POSITION
        resistance = self._contact_force * np.sign(short)
        if resistance < TOUCH_SHARE * self._force_n or self.speed > STOPPED_SPEED:
            return GripState.MOVING
        return GripState.CONTACT_CLOSING if short > 0 else GripState.CONTACT_OPENING

    def go(self, opening_m: float, *, force_n: float, speed: float) -> None:
        """Send the fingers to an opening. Raises MotionRefused outside the hand's ranges."""
        checks = (
            ("opening", opening_m, (0.0, gripper.STROKE_M), "m"),
            ("force", force_n, gripper.FORCE_RANGE_N, "N"),
            ("speed", speed, gripper.SPEED_RANGE_M_S, "m/s"),
        )
        for name, value, (low, high), unit in checks:
            if not low <= value <= high:
                raise MotionRefused(f"grip {name} {value} {unit} refused: the Hand-E's range is {low} to {high} {unit}")
        direction = float(np.sign(opening_m - self.opening_m))
        if not (self._stalled and direction == self._direction):  # a grip that is tightened never lets go
            self._set_point = self.opening_m
        self._model.actuator_forcerange[self._actuator] = [-force_n, force_n]
        self._target, self._speed, self._direction = opening_m, speed, direction

    def advance(self, period_s: float) -> None:
        """Move the set point on by one period, or push while the fingers cannot follow it."""
        velocity = push = 0.0
        if self._stalled:
            push = self._direction * self._force_n
        else:
            if self._lag < -REACH_M:  # what held the fingers has gone
                self._set_point = self.opening_m
            left = self._target - self._set_point
            velocity = max(-self._speed, min(self._speed, left / period_s))
            self._set_point += velocity * period_s
        self._data.ctrl[self._inputs] = self._set_point, velocity, push

    def stop(self) -> None:
        """Halt moving fingers where they are; fingers that hold an object keep holding it."""
        if self.state in (GripState.CONTACT_CLOSING, GripState.CONTACT_OPENING):
            return
        self._target = self._set_point = self.opening_m
        self._direction = 0.0
        self._data.ctrl[self._inputs] = self._target, 0.0, 0.0

    @property
    def _force_n(self) -> float:
        return float(self._model.actuator_forcerange[self._actuator, 1])

    @property
    def _lag(self) -> float:
        """How far (m) the fingers are behind their set point on the way to the commanded opening."""
        return (self._set_point - self.opening_m) * self._direction

    @property
    def _stalled(self) -> bool:
        """Whether something is in the fingers' way."""
        return self._lag > REACH_M

    @property
    def _contact_force(self) -> float:
        """Force (N) with which contacts push the fingers open, both fingers' added; negative pushes them together."""
        total, wrench, bodies = 0.0, np.zeros(6), self._model.geom_bodyid[self._data.contact.geom]
        for i, side in zip(*np.nonzero(self._opens[bodies]), strict=True):
            finger = bodies[i, side]
            mujoco.mj_contactForce(self._model, self._data, int(i), wrench)
            force = (1.0 if side else -1.0) * self._data.contact.frame[i].reshape(3, 3).T @ wrench[:3]
            total += float(self._opens[finger] * self._data.xmat[finger].reshape(3, 3)[:, 0] @ force)
        return total
