"""The Hand-E without an arm: three slides and a turn about the vertical carry it, pointing down, as stiffly as the arm.

It moves along the profiles of the robot's moves and grips with the Hand-E's own controller.
"""

from __future__ import annotations

import numpy as np

from cad import gripper
from cad.spatial import Array, transform, wrap_angle, yaw_of
from scenes.arm import FINGER_JOINTS, SERVO_INPUTS, add_hand, set_inertia
from scenes.gl import mujoco
from twin.profiles import Trapezoid, sample, steps_per_period
from twin.sim_hand import SimHand

_SLIDES = (("float_x", (1.0, 0.0, 0.0)), ("float_y", (0.0, 1.0, 0.0)), ("float_z", (0.0, 0.0, 1.0)))
_TURN = "float_yaw"
_JOINTS = (*(name for name, _ in _SLIDES), _TURN)
_SLIDE_GAINS, _TURN_GAINS = (4e5, 2e3), (5e3, 1e2)
"""(kp, kv) of the slides in N/m and N s/m and of the turn in N m/rad and N m s/rad."""
_TURN_ARMATURE = 0.1
_FLANGE_MASS_KG = 0.4
_DOWN = np.diag([1.0, -1.0, -1.0])
"""The tool's axes in the world at yaw 0."""


def add_floating_hand(spec: mujoco.MjSpec, *, timestep_s: float, grip_force_n: float) -> None:
    """Add the hand on its slides to a spec's world."""
    flange = spec.worldbody.add_body(name="floating_flange", quat=[0.0, 1.0, 0.0, 0.0], gravcomp=1.0)
    set_inertia(flange, _FLANGE_MASS_KG, (0.0, 0.0, 0.0), (1e-4, 1e-4, 1e-4))
    for name, axis in _SLIDES:
        flange.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=_DOWN @ axis)
    axis = _DOWN @ [0.0, 0.0, 1.0]
    flange.add_joint(name=_TURN, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, armature=_TURN_ARMATURE)
    for name in _JOINTS:
        kp, kv = _TURN_GAINS if name == _TURN else _SLIDE_GAINS
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(kp=kp, kv=kv, ctrlspec=SERVO_INPUTS)
    add_hand(spec, flange, timestep_s=timestep_s, grip_force_n=grip_force_n)


class FloatingHand:
    """Moves and closes the hand of a compiled model. Every method steps the physics but :meth:`put`."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, period_s: float = 0.002) -> None:
        """Raises ProfileError when the control period is not a whole multiple of the model's time step."""
        self._model, self._data, self._period_s = model, data, period_s
        self._steps = steps_per_period(period_s, float(model.opt.timestep))
        self._inputs = np.array([model.actuator_ctrladr[model.actuator(n).id] + np.arange(3) for n in _JOINTS])
        self._dofs = [int(model.joint(name).dofadr[0]) for name in _JOINTS]
        self._tcp = model.site("tcp").id
        self._at = np.zeros(4)
        self._hand = SimHand(model, data)

    @property
    def hand(self) -> SimHand:
        """Opening and object detection."""
        return self._hand

    @property
    def T_world_tcp(self) -> Array:
        """(4, 4) tool pose as it is."""
        return transform(self._data.site_xmat[self._tcp].reshape(3, 3).copy(), self._data.site_xpos[self._tcp].copy())

    def put(self, T_world_tcp: Array, opening_m: float) -> None:
        """Place the hand, pointing down, at rest, without physics."""
        self._at = np.array([*T_world_tcp[:3, 3], yaw_of(T_world_tcp[:3, :3] @ _DOWN)])
        self._at[2] += gripper.TCP_Z_M
        for name, value in zip(_JOINTS, self._at, strict=True):
            self._data.joint(name).qpos[0] = value
        for finger in FINGER_JOINTS:
            self._data.joint(finger).qpos[0] = opening_m / 2
        mujoco.mj_forward(self._model, self._data)
        full = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_fullM(self._model, self._data, full)
        self._inertia = full.diagonal()[self._dofs]
        self._data.ctrl[self._inputs[:, 0]] = self._at
        self._hand = SimHand(self._model, self._data)

    def move(self, shift: Array, turn: float, *, speed: float, acceleration: float) -> None:
        """Move by ``shift`` (3,) metres and ``turn`` rad, both on one profile, m/s and m/s^2."""
        length = float(np.linalg.norm(shift))
        direction = np.array([*shift, float(wrap_angle(turn))]) / length
        profile = Trapezoid(length=length, speed=speed, acceleration=acceleration)
        s, ds, dds = sample(profile, self._period_s)
        start = self._at
        for distance, rate, pull in zip(s, ds, dds, strict=True):
            self._data.ctrl[self._inputs[:, 0]] = start + direction * distance
            self._data.ctrl[self._inputs[:, 1]] = direction * rate
            self._data.ctrl[self._inputs[:, 2]] = self._inertia * direction * pull
            self.period()
        self._at = start + direction * length
        self._data.ctrl[self._inputs] = np.column_stack([self._at, np.zeros((4, 2))])

    def grip(self, opening_m: float, *, force_n: float, speed: float, limit_s: float, rest_s: float) -> bool:
        """Send the fingers to an opening; returns whether they came to rest for ``rest_s`` within the limit."""
        self._hand.go(opening_m, force_n=force_n, speed=speed)
        travel_s = abs(opening_m - self._hand.opening_m) / speed
        resting = 0.0
        for _ in range(round((travel_s + limit_s) / self._period_s)):
            self.period()
            resting = resting + self._period_s if self._hand.at_rest else 0.0
            if resting >= rest_s:
                return True
        return False

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        for _ in range(round(duration_s / self._period_s)):
            self.period()

    def period(self) -> None:
        """One control period."""
        self._hand.advance(self._period_s)
        mujoco.mj_step(self._model, self._data, nstep=self._steps)
