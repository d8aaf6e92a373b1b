import numpy as np
import pytest

from cad.spatial import inverse, rotation_angle, rotation_from_rotvec, rotvec_from_rotation, transform
from twin.profiles import JointPath, LinearPath, ProfileError, Trapezoid, sample_times, speed_for, steps_per_period


@pytest.mark.parametrize("length", [1e-6, 0.003, 0.1, 2.5])
def test_trapezoid_keeps_its_limits_and_arrives(length):
    profile = Trapezoid(length=length, speed=0.5, acceleration=2.0)
    t = np.linspace(0.0, profile.duration_s, 2001)
    s, v, a = np.array([profile.at(x) for x in t]).T
    assert s[0] == 0.0 and s[-1] == pytest.approx(length, rel=1e-12)
    assert (np.diff(s) >= 0).all()
    assert v.max() <= 0.5 + 1e-12 and np.abs(a).max() <= 2.0
    # the speed is the derivative of the distance, by central differences
    np.testing.assert_allclose(np.gradient(s, t)[2:-2], v[2:-2], atol=2.1 * (t[1] - t[0]))


def test_trapezoid_is_as_fast_as_its_limits_allow():
    assert Trapezoid(length=1.0, speed=0.5, acceleration=1.0).duration_s == pytest.approx(2.5)
    assert Trapezoid(length=0.16, speed=0.5, acceleration=1.0).duration_s == pytest.approx(0.8)
    assert Trapezoid(length=0.0, speed=0.5, acceleration=1.0).duration_s == 0.0


@pytest.mark.parametrize("bad", [{"speed": 0.0}, {"acceleration": -1.0}, {"length": np.nan}, {"speed": np.inf}])
def test_nonsense_is_refused_by_name(bad):
    with pytest.raises(ProfileError, match=str(next(iter(bad.values())))):
        Trapezoid(**({"length": 1.0, "speed": 1.0, "acceleration": 1.0} | bad))


def test_joints_start_and_stop_together_and_the_leading_one_has_the_given_speed():
    path = JointPath(q_start=np.zeros(3), q_end=np.array([1.0, -2.0, 0.5]), speed=1.0, acceleration=4.0)
    peak = np.max([np.abs(path.at(t)[1]) for t in np.linspace(0, path.duration_s, 500)], axis=0)
    np.testing.assert_allclose(peak, [0.5, 1.0, 0.25], rtol=1e-9)
    for t in np.linspace(0, path.duration_s, 50):
        q = path.at(t)[0]
        np.testing.assert_allclose(q, q[1] * np.array([-0.5, 1.0, -0.25]), atol=1e-12)
    np.testing.assert_allclose(path.at(path.duration_s + 1)[0], path.q_end)


def test_joint_path_of_no_length_stays():
    path = JointPath(q_start=np.ones(6), q_end=np.ones(6), speed=1.0, acceleration=1.0)
    assert path.duration_s == 0.0
    np.testing.assert_array_equal(path.at(0.0)[0], np.ones(6))


def test_linear_path_is_a_straight_line_about_one_axis():
    rng = np.random.default_rng(0)
    start = transform(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    end = transform(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    path = LinearPath(T_base_start=start, T_base_end=end, speed=0.5, acceleration=2.0)
    line = end[:3, 3] - start[:3, 3]
    angle = rotation_angle(start[:3, :3], end[:3, :3])
    axis = rotvec_from_rotation(start[:3, :3].T @ end[:3, :3]) / angle
    for t in np.linspace(0, path.duration_s, 30):
        T = path.at(t)
        share = np.linalg.norm(T[:3, 3] - start[:3, 3]) / np.linalg.norm(line)
        np.testing.assert_allclose(T[:3, 3], start[:3, 3] + share * line, atol=1e-12)
        turned = rotvec_from_rotation((inverse(start) @ T)[:3, :3])
        np.testing.assert_allclose(turned, share * angle * axis, atol=1e-9)
    np.testing.assert_allclose(path.at(path.duration_s), end, atol=1e-12)


def test_control_period_must_be_a_whole_number_of_steps():
    assert steps_per_period(0.002, 0.0005) == 4
    with pytest.raises(ProfileError, match=r"0\.002 s.*0\.0015 s"):
        steps_per_period(0.002, 0.0015)
    with pytest.raises(ProfileError, match=r"0\.002 s.*0\.01 s"):
        steps_per_period(0.002, 0.01)


def test_sample_times_cover_the_move():
    times = list(sample_times(0.0101, 0.002))
    np.testing.assert_allclose(times, [0.002, 0.004, 0.006, 0.008, 0.010, 0.012])
    assert len(list(sample_times(0.01, 0.002))) == 5
    assert list(sample_times(0.0, 0.002)) == [0.002]


def test_speed_for_a_duration():
    speed = speed_for(0.7, 2.5, 1.3)
    assert Trapezoid(length=0.7, speed=speed, acceleration=2.5).duration_s == pytest.approx(1.3)
    assert speed_for(10.0, 1.0, 0.1) == np.inf
