"""Calibrated kinematics: what the controller's and ROS's files say, and where a calibrated arm's links are."""

import numpy as np
import pytest

from cad.robot import UR5E, DhTable, forward_kinematics, jacobian, link_frames, rest_frames
from cad.robot_calibration import ROS_LINKS, CalibrationFileError, read_dh_calibration, table_from_axes
from cad.spatial import inverse, rotation_from_rotvec, rotation_z, rotvec_from_rotation, transform


def measured_axes(rng, shift_m=0.5e-3, tilt=2e-3):
    """Joint axes and flange of an arm built with errors, all encoders at zero."""
    frames = forward_kinematics(np.zeros(6)).copy()
    for i in range(1, 6):
        frames[i] = frames[i] @ transform(rotation_from_rotvec(rng.normal(0, tilt, 3)), rng.normal(0, shift_m, 3))
    frames[6] = frames[5] @ transform(rotation_z(1e-3), [0.0, 0.0, UR5E.d[5] + 2e-4])
    return frames


def conf(table, status=2, **change):
    rows = {name: np.array(getattr(table, name)) - getattr(UR5E, name) for name in ("theta", "a", "d", "alpha")}
    rows |= change
    lines = ["[mounting]"]
    lines += [f"delta_{name} = [ {', '.join(f'{v:.18g}' for v in row)}]" for name, row in rows.items()]
    lines += [f"calibration_status = {status} # 0 == notInitialized / 1 == notLinearised / 2 == Linearised"]
    return "\n".join([*lines, "joint_checksum = [ 0x1, 0x2, 0x3, 0x4, 0x5, 0x6]", "", "[tool]", "x = 1"])


def ros(frames):
    """The chain of ur_calibration: link i + 1's frame in link i's, as roll, pitch, yaw."""
    chain = [transform(rotation_z(0.2), [0.0, 0.0, 0.16]), *frames[1:5], frames[6]]
    lines, before = ["kinematics:"], np.eye(4)
    for name, T in zip(ROS_LINKS, chain, strict=True):
        M = inverse(before) @ T
        roll, pitch, yaw = (
            np.arctan2(M[2, 1], M[2, 2]),
            -np.arcsin(np.clip(M[2, 0], -1, 1)),
            np.arctan2(M[1, 0], M[0, 0]),
        )
        values = zip(("x", "y", "z", "roll", "pitch", "yaw"), (*M[:3, 3], roll, pitch, yaw), strict=True)
        lines += [f"  {name}:", *(f"    {key}: {value:.17g}" for key, value in values)]
        before = T
    return "\n".join([*lines, "  hash: calib_123"])


@pytest.fixture
def axes():
    return measured_axes(np.random.default_rng(5))


def test_table_of_measured_axes_is_that_arm_at_every_pose(axes):
    """Product of exponentials about the measured axes against the table's chain."""
    table = table_from_axes(axes)
    assert max(np.abs(table.d)) > 10.0  # nearly parallel axes meet far away, as in real files
    for q in np.random.default_rng(6).uniform(-2 * np.pi, 2 * np.pi, (100, 6)):
        T = np.eye(4)
        for i in range(6):
            T = T @ axes[i] @ transform(rotation_z(q[i])) @ inverse(axes[i])
        np.testing.assert_allclose(forward_kinematics(q, table)[6], T @ axes[6], atol=1e-11)


def test_nominal_axes_give_the_nominal_arm():
    table = table_from_axes(forward_kinematics(np.zeros(6)))
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 6)):
        np.testing.assert_allclose(forward_kinematics(q, table)[6], forward_kinematics(q)[6], atol=1e-13)
    assert max(np.abs(table.d)) < 0.2


@pytest.mark.parametrize("seed", range(5))
def test_both_files_say_the_same_arm(seed, tmp_path):
    axes = measured_axes(np.random.default_rng(seed))
    table = table_from_axes(axes)
    (tmp_path / "calibration.conf").write_text(conf(table))
    (tmp_path / "my_robot.yaml").write_text(ros(axes))
    for name in ("calibration.conf", "my_robot.yaml"):
        read = read_dh_calibration(tmp_path / name)
        for q in np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 6)):
            np.testing.assert_allclose(forward_kinematics(q, read)[6], forward_kinematics(q, table)[6], atol=1e-10)


def test_deltas_are_added_to_the_nominal_table(tmp_path):
    small = DhTable(
        a=tuple(np.array(UR5E.a) + 1e-4),
        d=tuple(np.array(UR5E.d) - 2e-4),
        alpha=tuple(np.array(UR5E.alpha) + 3e-4),
        theta=(1e-4, 2e-4, -3e-4, 0.0, 5e-4, 2 * np.pi),
    )
    (tmp_path / "calibration.conf").write_text(conf(small))
    read = read_dh_calibration(tmp_path / "calibration.conf")
    for name in ("a", "d", "alpha", "theta"):
        np.testing.assert_allclose(getattr(read, name), getattr(small, name), rtol=0, atol=1e-15)


def test_links_stay_where_the_nominal_arms_are_and_the_flange_is_exact(axes):
    table = table_from_axes(axes)
    for q in np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 6)):
        frames, nominal = link_frames(q, table), forward_kinematics(q)
        np.testing.assert_allclose(frames[6], forward_kinematics(q, table)[6], atol=1e-11)
        assert np.linalg.norm((frames - nominal)[:, :3, 3], axis=1).max() < 0.015
        assert np.abs(frames - nominal)[:, :3, :3].max() < 0.05
        far = np.linalg.norm((forward_kinematics(q, table) - nominal)[:, :3, 3], axis=1).max()
        assert far > 10.0  # the table's own frames are no place for a body


def test_link_frames_turn_about_the_axes_of_the_table(axes):
    """z of link frame i is the axis of joint i + 1, direction and place."""
    table = table_from_axes(axes)
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, 6)
    for ours, dh in zip(link_frames(q, table)[:6], forward_kinematics(q, table)[:6], strict=True):
        np.testing.assert_allclose(ours[:3, 2], dh[:3, 2], atol=1e-12)
        apart = ours[:3, 3] - dh[:3, 3]
        np.testing.assert_allclose(np.cross(apart, dh[:3, 2]), 0.0, atol=1e-9)


def test_link_frames_of_the_nominal_arm_are_its_denavit_hartenberg_frames():
    np.testing.assert_allclose(rest_frames(), forward_kinematics(np.zeros(6)), atol=1e-15)
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, 6)
    np.testing.assert_allclose(link_frames(q), forward_kinematics(q), atol=1e-14)


def test_jacobian_of_a_calibrated_arm_is_the_derivative(axes):
    table, step = table_from_axes(axes), 1e-6
    for q in np.random.default_rng(8).uniform(-np.pi, np.pi, (10, 6)):
        for i, unit in enumerate(np.eye(6)):
            high, low = (forward_kinematics(q + s * step * unit, table)[6] for s in (1, -1))
            angular = rotvec_from_rotation(high[:3, :3] @ low[:3, :3].T)
            slope = np.concatenate([high[:3, 3] - low[:3, 3], angular]) / (2 * step)
            np.testing.assert_allclose(jacobian(q, table)[:, i], slope, atol=1e-6)


SIX = "[ 0, 0, 0, 0, 0, 0]"


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("calibration.conf", "", r"no section \[mounting\]"),
        ("calibration.conf", "delta_a = 3", "no INI file"),
        ("calibration.conf", f"[mounting]\ndelta_theta = {SIX}", "has no delta_a"),
        ("calibration.conf", f"[mounting]\ndelta_theta = {SIX}\ndelta_a = [0, 1]", "delta_a = .* needs 6"),
        ("calibration.conf", "[mounting]\ndelta_theta = [1, 2, 3, x, 5, 6]", "delta_theta = .* no list of numbers"),
        ("calibration.conf", "[mounting]\ndelta_theta = [1, 2, 3, nan, 5, 6]", "6 finite numbers"),
        ("calibration.conf", conf(UR5E, status=0), "calibration_status is 0"),
        ("calibration.conf", conf(UR5E, d=[0, 0, 0, 0.03, 0, 0]), "joint 5 is 30.0 mm .* another arm model"),
        ("calibration.conf", conf(UR5E, theta=[0, 0.1, 0, 0, 0, 0]), "axis of joint 3 is 42.5 mm"),
        ("calibration.conf", conf(UR5E, d=[0, 0, 0, 0, 0, 0.02]), "the flange is 20.0 mm"),
        ("robot.yaml", "kinematics: [", "no YAML file"),
        ("robot.yaml", "joints: 3", "no mapping 'kinematics'"),
        ("robot.yaml", "kinematics: {shoulder: {x: 0}}", "kinematics/shoulder is"),
    ],
)
def test_unusable_files_are_refused_in_one_line(name, text, says, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationFileError, match=says) as caught:
        read_dh_calibration(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CalibrationFileError, match=r"none\.conf cannot be read"):
        read_dh_calibration(tmp_path / "none.conf")
