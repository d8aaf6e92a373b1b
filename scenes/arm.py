"""The UR5e and the Hand-E as MuJoCo bodies, straight from the published tables in ``cad.robot`` and ``cad.gripper``."""

from __future__ import annotations

import numpy as np

from cad import gripper, robot
from cad.spatial import Array, inverse, quat_wxyz_from_rotation
from scenes.contacts import ROBOT, Touches, add_primitive, pad_contact
from scenes.gl import mujoco

SERVO_INPUTS = int(mujoco.mjtCtrlInput.mjINPUT_POS | mujoco.mjtCtrlInput.mjINPUT_VEL | mujoco.mjtCtrlInput.mjINPUT_FF)
"""Every servo takes a position, a speed and a force: ``force = kp (position - x) + kv (speed - v) + feed-forward``."""
SHOULDER_GAINS, WRIST_GAINS = (20000.0, 800.0), (5000.0, 100.0)
"""(kp N m/rad, kv N m s/rad) of the joint servos: stiff enough for a static error of the tcp below 0.1 um."""
JOINT_ARMATURE = 0.1
"""kg m^2 of rotor and harmonic drive, seen from the joint (ours: UR publishes none). Without it the wrists' damping
outweighs their inertia within a time step, and a part in the hand feels accelerations that the hand does not make:
carried over 0.4 m it slips by up to 1.2 mm instead of 0.03 mm."""
HAND_KP = 10000.0
"""N/m of opening; the opening is the sum of both fingers' slides."""
FINGER_DAMPING, FINGER_ARMATURE = 20.0, 0.05
FINGER_JOINTS = ("hande_left", "hande_right")
GRIPPER_ACTUATOR = "hande"
FORCE_NUMERIC, SPEED_NUMERIC = "hande_force_range_n", "hande_speed_range_m_s"
"""Custom numerics of the model: the ranges (low, high) of the hand's force and speed commands."""


def add_arm(spec: mujoco.MjSpec, dh: robot.DhTable, *, timestep_s: float, grip_force_n: float) -> None:
    """Add arm and hand to a spec's world, whose frame is ``base``, with their joints, actuators and sites.

    ``dh`` is the arm's kinematic table; ``grip_force_n`` the hand's force until it is commanded another.
    """
    links = _add_links(spec, dh)
    _add_arm_actuators(spec)
    flange = links[-1]
    flange.add_site(name="flange", group=4)
    add_hand(spec, flange, timestep_s=timestep_s, grip_force_n=grip_force_n)
    for solid in robot.COLLISION:
        add_primitive(spec.body(solid.body), solid, Touches.ROBOT, ROBOT)


def _add_links(spec: mujoco.MjSpec, dh: robot.DhTable) -> list[mujoco.MjsBody]:
    """Bodies whose frames are ``robot.link_frames``; body i turns about z of frame i - 1."""
    links = [spec.worldbody.add_body(name=robot.BODY_NAMES[0], gravcomp=1.0)]
    rest = robot.rest_frames(dh)
    for i in range(6):
        T = inverse(rest[i]) @ rest[i + 1]
        R, offset = T[:3, :3], T[:3, 3]
        body = links[-1].add_body(
            name=robot.BODY_NAMES[i + 1], pos=offset, quat=quat_wxyz_from_rotation(R), gravcomp=1.0
        )
        joint = body.add_joint(
            name=robot.JOINT_NAMES[i],
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=R.T @ [0.0, 0.0, 1.0],
            pos=R.T @ -offset,
            range=robot.JOINT_RANGE_RAD,
            armature=JOINT_ARMATURE,
        )
        joint.limited = True
        inertia = robot.LINK_INERTIAS[i]
        set_inertia(body, inertia.mass_kg, inertia.com_m, inertia.moments_kg_m2)
        links.append(body)
    return links


def set_inertia(body: mujoco.MjsBody, mass_kg: float, com_m: Array | tuple, moments_kg_m2: Array | tuple) -> None:
    """State a body's mass, centre of mass and moments about it along the body's axes; geoms then add nothing."""
    body.explicitinertial = True
    body.mass = mass_kg
    body.ipos = com_m
    body.iquat = [1.0, 0.0, 0.0, 0.0]
    body.inertia = moments_kg_m2


def _add_arm_actuators(spec: mujoco.MjSpec) -> None:
    """Servos with three inputs each: position, speed and torque feed-forward, all clamped to the arm's limits."""
    for i, name in enumerate(robot.JOINT_NAMES):
        kp, kv = SHOULDER_GAINS if i < 3 else WRIST_GAINS
        speed, torque = robot.SPEED_LIMIT_RAD_S[i], robot.TORQUE_LIMIT_NM[i]
        actuator = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrlrange=robot.JOINT_RANGE_RAD,
            velrange=[-speed, speed],
            ffrange=[-torque, torque],
            forcerange=[-torque, torque],
        )
        actuator.set_to_pid(kp=kp, kv=kv, ctrlspec=SERVO_INPUTS)
        actuator.ctrllimited = actuator.forcelimited = True


def arm_inputs(model: mujoco.MjModel) -> Array:
    """Indices (3, 6) into ``data.ctrl``: the joints' position (rad), speed (rad/s) and torque (N m) set points."""
    return np.array([model.actuator_ctrladr[model.actuator(name).id] + np.arange(3) for name in robot.JOINT_NAMES]).T


def hand_inputs(model: mujoco.MjModel) -> Array:
    """Indices (3,) into ``data.ctrl``: set points of the opening (m) and its speed (m/s), force feed-forward (N)."""
    return model.actuator_ctrladr[model.actuator(GRIPPER_ACTUATOR).id] + np.arange(3)


def add_hand(spec: mujoco.MjSpec, flange: mujoco.MjsBody, *, timestep_s: float, grip_force_n: float) -> None:
    """Add the Hand-E to a body whose frame is ``flange``, with its fingers, their actuator and the site ``tcp``."""
    base = flange.add_body(name="hande_base", gravcomp=1.0)
    com = np.average(
        [gripper.BODY_COM_M, (0, 0, gripper.COUPLING_HEIGHT_M / 2)],
        axis=0,
        weights=[gripper.BODY_MASS_KG, gripper.COUPLING_MASS_KG],
    )
    set_inertia(base, gripper.BODY_MASS_KG + gripper.COUPLING_MASS_KG, com, gripper.BODY_MOMENTS_KG_M2)
    base.add_site(name="tcp", pos=gripper.T_FLANGE_TCP[:3, 3], group=4)
    for name, sign in zip(FINGER_JOINTS, (1.0, -1.0), strict=True):
        _add_finger(base, name, sign)
    _couple_fingers(spec, grip_force_n)
    for solid in gripper.COLLISION:
        contact = pad_contact(timestep_s) if solid.touches else ROBOT
        add_primitive(spec.body(solid.body), solid, Touches.ROBOT, contact)


def _add_finger(base: mujoco.MjsBody, name: str, sign: float) -> None:
    """One finger; its body frame coincides with ``tcp`` while the hand is closed. Moments: those of the carriage."""
    body = base.add_body(name=name, pos=gripper.T_FLANGE_TCP[:3, 3], gravcomp=1.0)
    joint = body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[sign, 0.0, 0.0],
        range=gripper.FINGER_RANGE_M,
        armature=FINGER_ARMATURE,
    )
    joint.limited = True
    joint.damping[0] = FINGER_DAMPING
    x, y, z = gripper.CARRIAGE_LENGTH_M, gripper.CARRIAGE_WIDTH_M, gripper.CARRIAGE_HEIGHT_M
    mass = gripper.CARRIAGE_MASS_KG + gripper.FINGER_MASS_KG
    com = (sign * x / 2, 0.0, -gripper.FINGER_LENGTH_M - z / 2)
    set_inertia(body, mass, com, mass / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2]))


def _couple_fingers(spec: mujoco.MjSpec, grip_force_n: float) -> None:
    """Both fingers move by the same amount; one actuator commands the opening with ``grip_force_n`` a finger."""
    spec.add_equality(
        name="hande_coupling",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1="hande_left",
        name2="hande_right",
        data=[0.0, 1.0] + [0.0] * 10,
        solref=[0.002, 1.0],
        solimp=[0.99, 0.999, 1e-4, 0.5, 2.0],
    )
    tendon = spec.add_tendon(name="hande_opening")
    for name in FINGER_JOINTS:
        tendon.wrap_joint(name, 1.0)
    actuator = spec.add_actuator(
        name=GRIPPER_ACTUATOR,
        target="hande_opening",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        ctrlrange=[0.0, gripper.STROKE_M],
        velrange=[-gripper.SPEED_RANGE_M_S[1], gripper.SPEED_RANGE_M_S[1]],
        ffrange=[-gripper.FORCE_RANGE_N[1], gripper.FORCE_RANGE_N[1]],
        forcerange=[-grip_force_n, grip_force_n],
    )
    actuator.set_to_pid(kp=HAND_KP, dampratio=1.0, ctrlspec=SERVO_INPUTS)
    actuator.ctrllimited = actuator.forcelimited = True
    spec.add_numeric(name=FORCE_NUMERIC, data=gripper.FORCE_RANGE_N)
    spec.add_numeric(name=SPEED_NUMERIC, data=gripper.SPEED_RANGE_M_S)
