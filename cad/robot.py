"""The UR5e: Denavit-Hartenberg table, forward and inverse kinematics, limits and link inertias.

Frame ``base`` is UR's own base frame (z up); frame ``i`` follows joint ``i`` in the standard Denavit-Hartenberg
convention, ``T_(i-1)_i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha)``; frame 6 is the flange, +z out of it. With all joints
at zero the arm is stretched along -x.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cad.parts import CadError
from cad.primitives import Primitive, box_between, cylinder_between
from cad.spatial import Array, inverse, rotation_z, transform, wrap_angle


class RobotModelError(CadError):
    """A joint vector or kinematic table that the arm model cannot use."""


@dataclass(frozen=True, kw_only=True)
class DhTable:
    """Standard Denavit-Hartenberg parameters of a six-joint arm: ``a``, ``d`` in metres, ``alpha``, ``theta`` in rad.

    ``theta`` is added to the joints' encoder angles. A calibrated arm's middle axes are all but parallel, so its table
    may hold ``d`` of hundreds of metres that cancel; :func:`link_frames` says where the links are.
    """

    a: tuple[float, ...]
    d: tuple[float, ...]
    alpha: tuple[float, ...]
    theta: tuple[float, ...] = (0.0,) * 6

    def __post_init__(self) -> None:
        for name, values in vars(self).items():
            if len(values) != 6 or not np.isfinite(values).all():
                raise RobotModelError(f"{name} = {values}: it needs 6 finite numbers, one a joint")


UR5E = DhTable(
    a=(0.0, -0.425, -0.3922, 0.0, 0.0, 0.0),
    d=(0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996),
    alpha=(np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0),
)
"""Nominal UR5e: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article). A real
arm adds its own calibrated deltas (``cad.robot_calibration``), which move its flange by some millimetres."""

JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
BODY_NAMES = (
    "ur5e_base",
    "ur5e_shoulder",
    "ur5e_upper_arm",
    "ur5e_forearm",
    "ur5e_wrist_1",
    "ur5e_wrist_2",
    "ur5e_wrist_3",
)
"""Body ``BODY_NAMES[i]`` is fixed to frame ``i`` of :func:`link_frames`; ``ur5e_base`` to frame ``base``."""

JOINT_RANGE_RAD = (-2 * np.pi, 2 * np.pi)
"""+-360 degrees on every joint: Universal Robots, "UR5e user manual", technical specifications."""
SPEED_LIMIT_RAD_S = (np.pi,) * 6
"""180 degrees/s on every joint: Universal Robots, "UR5e user manual", technical specifications."""
TORQUE_LIMIT_NM = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
"""Universal Robots, "Max. joint torques" (support article): joint size 3 of base, shoulder, elbow; size 1 of wrists."""
PAYLOAD_KG = 5.0
"""Universal Robots, "UR5e user manual", technical specifications."""
REACH_M = 0.85
"""Universal Robots, "UR5e user manual", technical specifications."""


@dataclass(frozen=True, kw_only=True)
class LinkInertia:
    """Mass in kg, centre of mass (3,) in the link's frame, moments (3,) in kg m^2 about it along the frame's axes."""

    mass_kg: float
    com_m: tuple[float, float, float]
    moments_kg_m2: tuple[float, float, float]


def _cylinder(
    mass_kg: float, com_m: tuple[float, float, float], axis: int, radius: float, length: float
) -> LinkInertia:
    """Moments of a solid cylinder of the published mass around the published centre of mass."""
    across = mass_kg * (3 * radius**2 + length**2) / 12
    moments = [across, across, across]
    moments[axis] = mass_kg * radius**2 / 2
    return LinkInertia(mass_kg=mass_kg, com_m=com_m, moments_kg_m2=(moments[0], moments[1], moments[2]))


LINK_INERTIAS = (
    _cylinder(3.761, (0.0, -0.02561, 0.00193), axis=1, radius=0.060, length=0.17),
    _cylinder(8.058, (0.2125, 0.0, 0.11336), axis=0, radius=0.055, length=0.54),
    _cylinder(2.846, (0.15, 0.0, 0.0265), axis=0, radius=0.045, length=0.48),
    _cylinder(1.37, (0.0, -0.0018, 0.01634), axis=1, radius=0.042, length=0.13),
    _cylinder(1.3, (0.0, 0.0018, 0.01634), axis=1, radius=0.042, length=0.12),
    _cylinder(0.365, (0.0, 0.0, -0.001159), axis=2, radius=0.0375, length=0.045),
)
"""Links 1..6. Masses and centres of mass: Universal Robots, "DH parameters for calculations of kinematics and
dynamics". Moments are ours: solid cylinders along each link's long axis, of the housings' outer size."""

_AXES = {"x": 0, "y": 1, "z": 2}


def _housing(
    link: int, name: str, axis: str, low: float, high: float, radius: float, *, x: float = 0.0, z: float = 0.0
) -> Primitive:
    """Cylinder of a link between two heights in mm along one of the frame's axes, that axis shifted to (x, z) in mm."""
    ends = np.tile([x, 0.0, z], (2, 1))
    ends[:, _AXES[axis]] = low, high
    body = BODY_NAMES[link]
    label = f"arm_{body.removeprefix('ur5e_')}_{name}"
    return cylinder_between(label, body, ends[0] * 1e-3, ends[1] * 1e-3, radius * 1e-3)


COLLISION = (
    _housing(0, "foot", "z", 0, 12, 74.8),
    _housing(0, "column", "z", 0, 90, 60.3),
    box_between("arm_base_connector", "ur5e_base", (-0.0693, -0.0222, 0.0198), (0.0, 0.0222, 0.0522)),
    _housing(1, "upright", "y", -72.5, 61.2, 60.3),
    _housing(1, "stub", "z", 0, 72, 58.3),
    _housing(2, "shoulder", "z", 72, 201.2, 60.3, x=425),
    _housing(2, "elbow", "z", 64, 201.2, 55.3),
    _housing(2, "tube", "x", 40, 385, 50.3, z=129),
    _housing(3, "elbow", "z", -50.2, 64, 55.3, x=392.2),
    _housing(3, "wrist", "z", -34.2, 64, 43.3),
    _housing(3, "tube", "x", 30, 350, 44.3, z=7),
    _housing(4, "upright", "y", -69.3, 53.2, 43.3),
    _housing(4, "stub", "z", 0, 50, 41.3),
    _housing(5, "upright", "y", -53.2, 49.7, 43.3),
    _housing(5, "stub", "z", 0, 50, 38.3),
    _housing(6, "drum", "z", -49.6, 0, 37.8),
    _housing(6, "connector", "y", 30, 43.7, 7.3, z=-24),
)
"""Solids that enclose the housings of ``cad.models.ur5e``, each in its link's frame."""


def forward_kinematics(q: ArrayLike, dh: DhTable = UR5E) -> Array:
    """Frames ``T_base_link`` (7, 4, 4): entry 0 is the base (identity), entry i frame i, entry 6 the flange.

    ``q`` (6,) in rad. Raises RobotModelError when ``q`` has another shape.
    """
    angles = _joint_vector(q)
    frames = np.empty((7, 4, 4))
    frames[0] = np.eye(4)
    for i in range(6):
        frames[i + 1] = frames[i] @ _dh_transform(angles[i] + dh.theta[i], dh, i)
    return frames


def rest_frames(dh: DhTable = UR5E) -> Array:
    """Frames ``T_base_link`` (7, 4, 4) that the links' solids are fixed to, with all encoders at zero.

    Frame ``i`` (0..5) has its z on the axis of joint ``i + 1`` of ``dh`` and is otherwise as near as can be to frame
    ``i`` of the nominal arm, so that a link stays where it is when a calibrated table puts its frame far away along the
    axis. Frame 6 is the flange exactly. For the nominal table these are the Denavit-Hartenberg frames.
    """
    nominal, exact = forward_kinematics(np.zeros(6)), forward_kinematics(np.zeros(6), dh)
    frames = exact.copy()
    for i in range(1, 6):
        z, to_nominal = exact[i, :3, 2], nominal[i, :3, 3] - exact[i, :3, 3]
        x = nominal[i, :3, 0] - z * (z @ nominal[i, :3, 0])
        x /= np.linalg.norm(x)
        frames[i] = transform(np.stack([x, np.cross(z, x), z], axis=1), exact[i, :3, 3] + z * (z @ to_nominal))
    return frames


def link_frames(q: ArrayLike, dh: DhTable = UR5E) -> Array:
    """Frames ``T_base_link`` (7, 4, 4) of the links at ``q`` (6,) rad: :func:`rest_frames` turned about the joints."""
    angles, rest = _joint_vector(q), rest_frames(dh)
    frames = rest.copy()
    for i in range(6):
        frames[i + 1] = frames[i] @ transform(rotation_z(angles[i])) @ inverse(rest[i]) @ rest[i + 1]
    return frames


def jacobian(q: ArrayLike, dh: DhTable = UR5E) -> Array:
    """Geometric Jacobian (6, 6) of the flange in ``base``: rows are linear (m/rad), then angular velocity."""
    frames = forward_kinematics(q, dh)
    axes = frames[:6, :3, 2]
    arms = frames[6, :3, 3] - frames[:6, :3, 3]
    return np.concatenate([np.cross(axes, arms), axes], axis=1).T


def inverse_kinematics(T_base_flange: Array, dh: DhTable = UR5E, *, q6_singular: float = 0.0) -> Array:
    """All joint vectors (N, 6) in [-pi, pi) that put the flange at ``T_base_flange`` (4, 4); N is 0 to 8.

    Closed form for arms whose joints 2, 3, 4 are parallel and whose last three axes meet pairwise (the UR family):
    shoulder left/right, wrist up/down, elbow up/down. At the wrist singularity (sin q5 = 0) only q4 + q6 or q4 - q6 is
    defined and q6 = ``q6_singular`` is taken. Out of reach gives N = 0.
    Raises RobotModelError when ``dh`` is of another family.
    """
    _check_family(dh)
    solutions = []
    for q1 in _shoulder_angles(T_base_flange, dh):
        T_1_flange = inverse(_dh_transform(q1, dh, 0)) @ T_base_flange
        for q5, q6 in _wrist_angles(T_1_flange, q6_singular):
            T_1_4 = T_1_flange @ inverse(_dh_transform(q5, dh, 4) @ _dh_transform(q6, dh, 5))
            solutions += [[q1, q2, q3, q4, q5, q6] for q2, q3, q4 in _planar_angles(T_1_4, dh)]
    return wrap_angle(np.reshape(solutions, (-1, 6)))


def _joint_vector(q: ArrayLike) -> Array:
    angles = np.asarray(q, dtype=np.float64)
    if angles.shape != (6,):
        raise RobotModelError(f"joint vector has shape {angles.shape}; it must be (6,), in rad, base to wrist 3")
    return angles


def _dh_transform(angle: float, dh: DhTable, i: int) -> Array:
    c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(dh.alpha[i]), np.sin(dh.alpha[i])
    return np.array(
        [
            [c, -s * ca, s * sa, dh.a[i] * c],
            [s, c * ca, -c * sa, dh.a[i] * s],
            [0.0, sa, ca, dh.d[i]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _check_family(dh: DhTable) -> None:
    zeros = (dh.a[0], *dh.a[3:], dh.d[1], dh.d[2], *dh.theta)
    if any(zeros) or not np.allclose(dh.alpha, UR5E.alpha, rtol=0, atol=1e-12):
        raise RobotModelError(
            f"no closed form for {dh}: a[0], a[3:], d[1], d[2] and theta must be 0 and alpha {UR5E.alpha}; "
            "use a numeric solver for calibrated tables"
        )


def _shoulder_angles(T_base_flange: Array, dh: DhTable) -> list[float]:
    """Both q1 that put the wrist centre (origin of frame 5) at distance d4 from the shoulder plane."""
    x, y = (T_base_flange[:3, 3] - dh.d[5] * T_base_flange[:3, 2])[:2]
    square = x**2 + y**2 - dh.d[3] ** 2
    if square < 0:
        return []
    return [float(np.arctan2(y, x) + np.arctan2(dh.d[3], side * np.sqrt(square))) for side in (1, -1)]


def _wrist_angles(T_1_flange: Array, q6_singular: float) -> list[tuple[float, float]]:
    """Both (q5, q6). The z row of R_1_flange is (sin q5 cos q6, -sin q5 sin q6, cos q5)."""
    u, v, w = T_1_flange[2, :3]
    sine = float(np.hypot(u, v))
    if sine < 1e-9:
        return [(float(np.arctan2(0.0, w)), q6_singular)]
    return [(float(np.arctan2(side * sine, w)), float(np.arctan2(-side * v, side * u))) for side in (1, -1)]


def _planar_angles(T_1_4: Array, dh: DhTable) -> list[tuple[float, float, float]]:
    """Both (q2, q3, q4) of the planar arm with links a2, a3 that ends at the origin of frame 4."""
    x, y = T_1_4[:2, 3]
    a2, a3 = dh.a[1], dh.a[2]
    cosine = (x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3)
    if abs(cosine) > 1 + 1e-12:
        return []
    sine = np.sqrt(max(0.0, 1 - cosine**2))
    total = np.arctan2(T_1_4[1, 0], T_1_4[0, 0])
    found = []
    for s3 in (sine, -sine):
        q3 = np.arctan2(s3, cosine)
        q2 = np.arctan2(y, x) - np.arctan2(a3 * s3, a2 + a3 * cosine)
        found.append((float(q2), float(q3), float(total - q2 - q3)))
    return found
