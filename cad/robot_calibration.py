"""A real arm's own kinematics, read from the files in which Universal Robots' arms carry them.

Every UR arm is measured in the factory. Its controller keeps the result as deltas to the nominal Denavit-Hartenberg
table (``calibration.conf`` in the controller's ``.urcontrol`` folder, an INI file); the ROS driver's ``ur_calibration``
turns the same result into a chain of six transforms (a YAML file). Both become a :class:`cad.robot.DhTable`.
"""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np
import yaml

from cad.robot import UR5E, DhTable, RobotModelError, forward_kinematics
from cad.spatial import Array, angle_between, rotation_x, rotation_z, transform

MAX_SHIFT_M, MAX_TILT = 0.010, np.radians(2.0)
"""A joint axis further from the nominal arm's than this means a file of another model. Two factory files that owners
published (a UR10 and a UR3) shift the axes by up to 4 mm and tilt them by up to 0.6 degrees; the deltas of one size on
the table of another shift them by 80 mm and more."""
CALIBRATED = 2
"""Controller's ``calibration_status`` of an arm whose deltas are in use (0: none, 1: not linearised)."""
ROS_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
PARALLEL = 1e-9
"""Axes whose directions differ by less than this (rad) have no common normal of their own."""


class CalibrationFileError(RobotModelError):
    """A calibration file that is missing, damaged, incomplete or of another arm; the message names file and entry."""


def read_dh_calibration(path: Path, nominal: DhTable = UR5E) -> DhTable:
    """The calibrated table of one arm from ``calibration.conf`` or from ROS's ``*.yaml``, told apart by the suffix.

    Raises CalibrationFileError when the file cannot be used, or when it moves an axis further from ``nominal`` than a
    factory calibration does.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise CalibrationFileError(f"{path} cannot be read: {error.strerror}; name the arm's own file") from error
    except UnicodeDecodeError as error:
        raise CalibrationFileError(f"{path} cannot be read: it is no text file; name the arm's own file") from error
    is_ros = Path(path).suffix.lower() in (".yaml", ".yml")
    try:
        table = _from_ros(text) if is_ros else _from_controller(text, nominal)
        _check_plausible(table, nominal)
    except RobotModelError as error:
        raise CalibrationFileError(f"{path}: {error}") from error
    return table


def table_from_axes(T_base_axes: Array) -> DhTable:
    """The Denavit-Hartenberg table of an arm from its joint axes with all encoders at zero.

    ``T_base_axes`` (7, 4, 4): entry 0 the base and entry 6 the flange, both exactly; of entries 1..5 only the z axis
    matters, the axis of joint 2..6 and its direction. The flange's z must lie on the axis of joint 6, as on a UR.
    Raises RobotModelError when base or flange do not fit the convention.
    """
    frames = np.array(T_base_axes, dtype=np.float64)
    for i in range(1, 6):
        frames[i] = _dh_frame(frames[i - 1], frames[i, :3, 2], frames[i, :3, 3])
    rows = [_dh_row(frames[i], frames[i + 1]) for i in range(6)]
    theta, d, a, alpha = (tuple(float(v) for v in column) for column in zip(*rows, strict=True))
    table = DhTable(a=a, d=d, alpha=alpha, theta=theta)
    off = np.abs(forward_kinematics(np.zeros(6), table)[6] - frames[6]).max()
    if off > 1e-6:
        raise RobotModelError(f"the flange's z is not on the axis of the last joint: it would be moved by {off:.1e} m")
    return table


def _dh_frame(T_base_previous: Array, z: Array, point: Array) -> Array:
    """The frame on the line (``z``, ``point``), both (3,): x along the common normal from the previous frame's z."""
    previous_z, previous = T_base_previous[:3, 2], T_base_previous[:3, 3]
    normal = np.cross(previous_z, z)
    apart = point - previous
    if np.linalg.norm(normal) < PARALLEL:
        x = apart - z * (z @ apart)
        origin = point - z * (z @ apart)
        x = x if np.linalg.norm(x) > PARALLEL else T_base_previous[:3, 0]
    else:
        origin = point + z * (np.cross(apart, previous_z) @ normal) / (normal @ normal)
        x = normal
    x = x / np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), origin)


def _dh_row(T_base_previous: Array, T_base_frame: Array) -> tuple[float, float, float, float]:
    """(theta, d, a, alpha) between two frames that meet the convention."""
    T = np.linalg.inv(T_base_previous) @ T_base_frame
    theta, alpha = np.arctan2(T[1, 0], T[0, 0]), np.arctan2(T[2, 1], T[2, 2])
    return float(theta), float(T[2, 3]), float(T[:2, 3] @ [np.cos(theta), np.sin(theta)]), float(alpha)


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _from_controller(text: str, nominal: DhTable) -> DhTable:
    """``calibration.conf``: deltas that are added to the nominal table, in its section ``[mounting]``."""
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), interpolation=None, strict=False)
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise CalibrationFileError(f"it is no INI file as a UR controller writes it: {_in_one_line(error)}") from error
    if not parser.has_section("mounting"):
        raise CalibrationFileError(f"it has no section [mounting]; its sections are {parser.sections()}")
    section = parser["mounting"]
    status = section.get("calibration_status", str(CALIBRATED)).strip()
    if status != str(CALIBRATED):
        raise CalibrationFileError(
            f"calibration_status is {status}, not {CALIBRATED}: the controller does not use these deltas; export the "
            "file again once the arm is calibrated"
        )
    theta, a, d, alpha = (_row(section, f"delta_{name}") for name in ("theta", "a", "d", "alpha"))
    return DhTable(
        a=_plus(nominal.a, a),
        d=_plus(nominal.d, d),
        alpha=_plus(nominal.alpha, alpha),
        theta=_plus(nominal.theta, theta),
    )


def _row(section: configparser.SectionProxy, key: str) -> Array:
    """Six numbers of one entry such as ``[ 0.1, 0.2, ... ]``."""
    if key not in section:
        raise CalibrationFileError(f"[mounting] has no {key}; it needs delta_theta, delta_a, delta_d, delta_alpha")
    try:
        values = [float(word) for word in section[key].strip().strip("[]").split(",")]
    except ValueError as error:
        raise CalibrationFileError(f"{key} = {section[key]!r} is no list of numbers: {error}") from error
    if len(values) != 6 or not np.isfinite(values).all():
        raise CalibrationFileError(f"{key} = {section[key]!r}: it needs 6 finite numbers, one a joint")
    return np.array(values)


def _plus(nominal: tuple[float, ...], delta: Array) -> tuple[float, ...]:
    return tuple(float(v) for v in np.array(nominal) + delta)


def _from_ros(text: str) -> DhTable:
    """``ur_calibration``'s file: each joint's frame in the one before as x, y, z (m) and roll, pitch, yaw (rad)."""
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationFileError(f"it is no YAML file: {_in_one_line(error)}") from error
    links = document.get("kinematics") if isinstance(document, dict) else None
    if not isinstance(links, dict):
        raise CalibrationFileError("it has no mapping 'kinematics' as ROS's ur_calibration writes it")
    # joint i turns about z of its own frame, so axis i + 1 is the z of frame i here
    frames = [np.eye(4)]
    for name in ROS_LINKS:
        frames.append(frames[-1] @ _ros_transform(links, name))
    if np.abs(frames[1][:2, [2, 3]]).max() > 1e-9:
        raise CalibrationFileError("the shoulder's z is not the base's z: the chain does not start at a UR's base")
    return table_from_axes(np.stack([np.eye(4), *frames[2:], frames[6]]))


def _ros_transform(links: dict, name: str) -> Array:
    entry = links.get(name)
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    if not isinstance(entry, dict) or not all(isinstance(entry.get(key), int | float) for key in keys):
        raise CalibrationFileError(f"kinematics/{name} is {entry!r}; it needs the numbers {', '.join(keys)}")
    roll, pitch, yaw = (float(entry[key]) for key in keys[3:])
    c, s = np.cos(pitch), np.sin(pitch)
    tilt = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return transform(rotation_z(yaw) @ tilt @ rotation_x(roll), [float(entry[key]) for key in keys[:3]])


def _check_plausible(table: DhTable, nominal: DhTable) -> None:
    """Raise RobotModelError when an axis or the flange is further from the nominal arm's than calibrations are."""
    ours, theirs = forward_kinematics(np.zeros(6), table), forward_kinematics(np.zeros(6), nominal)
    for i in range(1, 7):
        z, apart = ours[i, :3, 2], theirs[i, :3, 3] - ours[i, :3, 3]
        shift = float(np.linalg.norm(apart if i == 6 else apart - z * (z @ apart)))
        tilt = float(angle_between(z, theirs[i, :3, 2]))
        if shift > MAX_SHIFT_M or tilt > MAX_TILT:
            what = "the flange" if i == 6 else f"the axis of joint {i + 1}"
            raise RobotModelError(
                f"with all joints at zero {what} is {1e3 * shift:.1f} mm and {np.degrees(tilt):.2f} degrees from the "
                f"nominal arm's, more than {1e3 * MAX_SHIFT_M:.0f} mm and {np.degrees(MAX_TILT):.0f} degrees: the file "
                "is damaged or belongs to another arm model"
            )
