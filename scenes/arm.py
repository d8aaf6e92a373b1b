"""The UR5e and the Hand-E as MuJoCo bodies, straight from the published tables in ``cad.robot`` and ``cad.gripper``."""

from __future__ import annotations

import numpy as np

from cad import gripper, robot
from cad.spatial import Array, quat_wxyz_from_rotation, rotation_x
from scenes.contacts import ROBOT, Contact, Touches, make_collision, pad_contact
from scenes.gl import mujoco

SHOULDER_GAINS, WRIST_GAINS = (20000.0, 800.0), (5000.0, 100.0)
"""(kp N m/rad, kv N m s/rad) of the joint servos: stiff enough for a static error of the tcp below 0.1 um."""
HAND_KP = 10000.0
"""N/m of opening; the opening is the sum of both fingers' slides."""
FINGER_DAMPING, FINGER_ARMATURE = 20.0, 0.05
GRIPPER_ACTUATOR = "hande"
CAPSULE, CYLINDER, BOX = (
    mujoco.mjtGeom.mjGEOM_CAPSULE.value,
    mujoco.mjtGeom.mjGEOM_CYLINDER.value,
    mujoco.mjtGeom.mjGEOM_BOX.value,
)
ARM_GEOMS = (
    ("arm_base", 0, CYLINDER, 0.075, (0, 0, 0.0), (0, 0, 0.099)),
    ("arm_shoulder", 1, CYLINDER, 0.060, (0, -0.060, 0), (0, 0.060, 0)),
    ("arm_shoulder_side", 1, CYLINDER, 0.058, (0, 0, 0), (0, 0, 0.07)),
    ("arm_upper_arm", 2, CAPSULE, 0.056, (0.425, 0, 0.136), (0, 0, 0.136)),
    ("arm_elbow", 2, CYLINDER, 0.050, (0, 0, 0.065), (0, 0, 0.19)),
    ("arm_forearm", 3, CAPSULE, 0.046, (0.3922, 0, 0.016), (0, 0, 0.016)),
    ("arm_wrist_1", 4, CYLINDER, 0.040, (0, -0.045, 0), (0, 0.060, 0)),
    ("arm_wrist_2", 5, CYLINDER, 0.040, (0, -0.060, 0), (0, 0.045, 0)),
    ("arm_wrist_3", 6, CYLINDER, 0.038, (0, 0, -0.040), (0, 0, 0)),
)
"""Name, link, type, radius and axis end points in the link's frame of the solids that stand for the arm in contact."""


def add_arm(spec: mujoco.MjSpec, *, timestep_s: float, grip_force_n: float) -> None:
    """Add arm and hand to a spec's world, whose frame is ``base``, with their joints, actuators and sites."""
    links = _add_links(spec)
    _add_arm_geoms(links)
    _add_arm_actuators(spec)
    flange = links[-1]
    flange.add_site(name="flange", group=4)
    _add_hand(spec, flange, timestep_s, grip_force_n)


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


def _add_arm_geoms(links: list[mujoco.MjsBody]) -> None:
    for name, link, kind, radius, start, end in ARM_GEOMS:
        geom = links[link].add_geom(name=name, type=kind, size=[radius, 0, 0], fromto=[*start, *end])
        make_collision(geom, Touches.ROBOT, ROBOT)


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


def _add_hand(spec: mujoco.MjSpec, flange: mujoco.MjsBody, timestep_s: float, grip_force_n: float) -> None:
    base = flange.add_body(name="hande_base", gravcomp=1.0)
    com = np.average(
        [gripper.BODY_COM_M, (0, 0, gripper.COUPLING_HEIGHT_M / 2)],
        axis=0,
        weights=[gripper.BODY_MASS_KG, gripper.COUPLING_MASS_KG],
    )
    set_inertia(base, gripper.BODY_MASS_KG + gripper.COUPLING_MASS_KG, com, gripper.BODY_MOMENTS_KG_M2)
    top = gripper.COUPLING_HEIGHT_M + gripper.BODY_HEIGHT_M
    housing = base.add_geom(
        name="hand_body", type=CYLINDER, size=[gripper.BODY_RADIUS_M, 0, 0], fromto=[0, 0, 0, 0, 0, top]
    )
    make_collision(housing, Touches.ROBOT, ROBOT)
    base.add_site(name="tcp", pos=gripper.T_FLANGE_TCP[:3, 3], group=4)
    _add_finger(base, "left", 1.0, pad_contact(timestep_s))
    _add_finger(base, "right", -1.0, pad_contact(timestep_s))
    _couple_fingers(spec, grip_force_n)


def _add_finger(base: mujoco.MjsBody, side: str, sign: float, pad: Contact) -> None:
    """One finger; its body frame coincides with ``tcp`` while the hand is closed."""
    body = base.add_body(name=f"hande_{side}", pos=gripper.T_FLANGE_TCP[:3, 3], gravcomp=1.0)
    joint = body.add_joint(
        name=f"hande_{side}",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[sign, 0.0, 0.0],
        range=gripper.FINGER_RANGE_M,
        armature=FINGER_ARMATURE,
    )
    joint.limited = True
    joint.damping[0] = FINGER_DAMPING
    carriage = np.array([gripper.CARRIAGE_LENGTH_M, gripper.CARRIAGE_WIDTH_M, gripper.CARRIAGE_HEIGHT_M]) / 2
    root = gripper.FINGER_ROOT_THICKNESS_M / 2
    blade_top = -gripper.PAD_HEIGHT_M
    solids = {
        f"hand_{side}_carriage": (
            [sign * (gripper.CARRIAGE_GAP_M + carriage[0]), 0.0, -gripper.FINGER_LENGTH_M - carriage[2]],
            carriage,
        ),
        f"hand_{side}_finger": (
            [sign * root, 0.0, (blade_top - gripper.FINGER_LENGTH_M) / 2],
            [root, gripper.PAD_WIDTH_M / 2, (gripper.FINGER_LENGTH_M + blade_top) / 2],
        ),
    }
    for name, (centre, half) in solids.items():
        make_collision(body.add_geom(name=name, type=BOX, pos=centre, size=half), Touches.ROBOT, ROBOT)
    T_pad = gripper.T_TCP_LEFT_PAD if sign > 0 else gripper.T_TCP_RIGHT_PAD
    pad_geom = body.add_geom(name=f"pad_{side}", type=BOX, pos=T_pad[:3, 3], size=gripper.PAD_HALF_EXTENTS_M)
    make_collision(pad_geom, Touches.ROBOT, pad)
    mass = gripper.CARRIAGE_MASS_KG + gripper.FINGER_MASS_KG
    moments = mass * np.array([carriage[1] ** 2 + carriage[2] ** 2, carriage[0] ** 2 + carriage[2] ** 2, 0.0]) / 3
    moments[2] = mass * (carriage[0] ** 2 + carriage[1] ** 2) / 3
    set_inertia(body, mass, solids[f"hand_{side}_carriage"][0], moments)


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
