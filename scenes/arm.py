"""The UR5e and the Hand-E as MuJoCo bodies, straight from the published tables in ``cad.robot`` and ``cad.gripper``."""

from __future__ import annotations

import numpy as np

from cad import gripper, robot
from cad.spatial import Array, quat_wxyz_from_rotation, rotation_x
from scenes.contacts import ROBOT, Touches, add_primitive, pad_contact
from scenes.gl import mujoco

SHOULDER_GAINS, WRIST_GAINS = (20000.0, 800.0), (5000.0, 100.0)
"""(kp N m/rad, kv N m s/rad) of the joint servos: stiff enough for a static error of the tcp below 0.1 um."""
JOINT_ARMATURE = 0.1
"""kg m^2 of rotor and harmonic drive, seen from the joint (ours: UR publishes none). Without it the wrists' damping
outweighs their inertia within a time step, and a part in the hand feels accelerations that the hand does not make:
carried over 0.4 m it slips by up to 1.2 mm instead of 0.03 mm."""
HAND_KP = 10000.0
"""N/m of opening; the opening is the sum of both fingers' slides."""
FINGER_DAMPING, FINGER_ARMATURE = 20.0, 0.05
GRIPPER_ACTUATOR = "hande"


def add_arm(spec: mujoco.MjSpec, *, timestep_s: float, grip_force_n: float) -> None:
    """Add arm and hand to a spec's world, whose frame is ``base``, with their joints, actuators and sites."""
    links = _add_links(spec)
    _add_arm_actuators(spec)
    flange = links[-1]
    flange.add_site(name="flange", group=4)
    _add_hand(spec, flange, grip_force_n)
    for solid in (*robot.COLLISION, *gripper.COLLISION):
        contact = pad_contact(timestep_s) if solid.touches else ROBOT
        add_primitive(spec.body(solid.body), solid, Touches.ROBOT, contact)


def _add_links(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    """Bodies whose frames are the Denavit-Hartenberg frames; body i turns about z of frame i - 1."""
    links = [spec.worldbody.add_body(name=robot.BODY_NAMES[0], gravcomp=1.0)]
    dh = robot.UR5E
    for i in range(6):
        offset, R = np.array([dh.a[i], 0.0, dh.d[i]]), rotation_x(dh.alpha[i])
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
    """Position servos with velocity damping: ctrl = q + (kv / kp) qd adds velocity feed-forward."""
    for i, name in enumerate(robot.JOINT_NAMES):
        kp, kv = SHOULDER_GAINS if i < 3 else WRIST_GAINS
        limit = robot.TORQUE_LIMIT_NM[i]
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=[-limit, limit]
        )
        actuator.set_to_position(kp=kp, kv=kv)
        actuator.forcelimited = True


def _add_hand(spec: mujoco.MjSpec, flange: mujoco.MjsBody, grip_force_n: float) -> None:
    base = flange.add_body(name="hande_base", gravcomp=1.0)
    com = np.average(
        [gripper.BODY_COM_M, (0, 0, gripper.COUPLING_HEIGHT_M / 2)],
        axis=0,
        weights=[gripper.BODY_MASS_KG, gripper.COUPLING_MASS_KG],
    )
    set_inertia(base, gripper.BODY_MASS_KG + gripper.COUPLING_MASS_KG, com, gripper.BODY_MOMENTS_KG_M2)
    base.add_site(name="tcp", pos=gripper.T_FLANGE_TCP[:3, 3], group=4)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        _add_finger(base, f"hande_{side}", sign)
    _couple_fingers(spec, grip_force_n)


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
    tendon.wrap_joint("hande_left", 1.0)
    tendon.wrap_joint("hande_right", 1.0)
    actuator = spec.add_actuator(
        name=GRIPPER_ACTUATOR,
        target="hande_opening",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        ctrlrange=[0.0, gripper.STROKE_M],
        forcerange=[-grip_force_n, grip_force_n],
    )
    actuator.set_to_position(kp=HAND_KP, dampratio=1.0)
    actuator.ctrllimited = actuator.forcelimited = True
