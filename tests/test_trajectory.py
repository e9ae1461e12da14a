"""Trajectory, its interpolation on SE(2), and the prior of the first pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import SkyfixError, Trajectory, UniformPrior, se2

SECOND = 1_000_000_000


def circle(count=9, speed=2.0, rate=0.4):
    """A drive on a circle, one pose a second: a constant body twist."""
    twist = np.array([speed, 0.0, rate])
    stamps = np.arange(count, dtype=np.int64) * SECOND
    return Trajectory(stamps, se2.exp(np.arange(count)[:, None] * twist)), twist


@given(st.floats(0.0, 8.0))
def test_a_constant_twist_is_interpolated_exactly(seconds):
    trajectory, twist = circle()
    stamp = round(seconds * SECOND)
    expected = se2.exp(stamp / SECOND * twist)
    got = trajectory.interpolate([stamp])[0]
    np.testing.assert_allclose(se2.between(got, expected), 0.0, atol=1e-9)


def test_interpolation_gives_the_poses_back_at_their_stamps():
    trajectory, _ = circle()
    np.testing.assert_allclose(trajectory.interpolate(trajectory.stamp_ns), trajectory.poses, atol=1e-14)


def test_interpolation_takes_the_short_way_round_the_seam():
    trajectory = Trajectory(np.array([0, SECOND]), np.array([[0, 0, np.pi - 0.1], [0, 0, -np.pi + 0.1]]))
    assert abs(trajectory.interpolate([SECOND // 2])[0, 2]) == pytest.approx(np.pi, abs=1e-12)


def test_nanoseconds_survive_today_s_epoch():
    start = 1_700_000_000 * SECOND + 1
    trajectory = Trajectory(np.array([start, start + 10]), np.array([[0.0, 0, 0], [10.0, 0, 0]]))
    np.testing.assert_allclose(trajectory.interpolate([start + 3])[0], [3.0, 0.0, 0.0], atol=1e-12)


def test_outside_the_span_is_an_error_beyond_the_tolerance():
    trajectory, _ = circle()
    np.testing.assert_allclose(trajectory.interpolate([-5], tolerance_ns=5)[0], trajectory.poses[0])
    np.testing.assert_allclose(trajectory.interpolate([8 * SECOND + 5], tolerance_ns=5)[0], trajectory.poses[-1])
    with pytest.raises(SkyfixError, match="expected stamps in"):
        trajectory.interpolate([-6], tolerance_ns=5)


def test_a_single_pose_answers_at_its_own_stamp():
    trajectory = Trajectory(np.array([7]), np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(trajectory.interpolate([7, 7]), [[1.0, 2.0, 3.0]] * 2)
    assert trajectory.length_m == 0.0


def test_length_is_that_of_the_path():
    straight = Trajectory(np.arange(5) * 10, np.array([[3.0 * i, 4.0 * i, 0.0] for i in range(5)]))
    assert straight.length_m == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("stamps", "poses", "covariances", "word"),
    [
        ([0, 0], np.zeros((2, 3)), None, "increasing"),
        ([1, 0], np.zeros((2, 3)), None, "increasing"),
        ([], np.zeros((0, 3)), None, "at least one"),
        ([0, 1], np.zeros((3, 3)), None, "poses"),
        ([0, 1], np.full((2, 3), np.nan), None, "finite"),
        ([0, 1], np.zeros((2, 3)), np.zeros((2, 2, 2)), "covariances"),
        ([0.0, 0.1], np.zeros((2, 3)), None, "int64"),
        ([0, 1], [["0", "1", "2"]] * 2, None, "numbers, got list"),
        ([0, 1], np.zeros((2, 3), dtype="datetime64[ns]"), None, "numbers, got ndarray"),
        ([0, 1], np.zeros((2, 3), dtype=complex), None, "numbers, got ndarray"),
    ],
)
def test_bad_trajectories_are_refused_in_one_line(stamps, poses, covariances, word):
    with pytest.raises(SkyfixError, match=word) as caught:
        Trajectory(np.array(stamps), poses, covariances)
    assert "\n" not in str(caught.value)


def test_a_trajectory_cannot_be_changed_from_outside():
    poses = np.zeros((2, 3))
    trajectory = Trajectory(np.array([0, 1]), poses)
    poses[0] = 9.0
    assert trajectory.poses[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        trajectory.poses[0, 0] = 1.0


def test_yaw_is_wrapped_on_entry():
    assert Trajectory(np.array([0]), np.array([[0.0, 0.0, 3 * np.pi]])).poses[0, 2] == pytest.approx(-np.pi)


def test_prior_moments_are_those_of_its_samples():
    prior = UniformPrior(np.array([5.0, -3.0, 3.1]), 20.0, 0.2)
    poses = prior.sample(20_000, np.random.default_rng(0))
    assert prior.contains(poses).all()
    mean, covariance = se2.weighted_mean_and_covariance(poses, np.ones(len(poses)))
    sigma = np.sqrt(np.diag(prior.covariance) / len(poses))
    assert (np.abs(mean[:2] - prior.mean[:2]) < 4 * sigma[:2]).all()
    assert abs(se2.wrap(mean[2] - prior.mean[2])) < 4 * sigma[2]
    np.testing.assert_allclose(np.diag(covariance), np.diag(prior.covariance), rtol=0.03)


def test_prior_knows_its_edges():
    prior = UniformPrior(np.array([0.0, 0.0, np.pi]), 1.0, 0.5)
    inside = prior.contains([[1.0, -1.0, -np.pi + 0.4], [1.1, 0.0, np.pi], [0.0, 0.0, np.pi - 0.6]])
    np.testing.assert_array_equal(inside, [True, False, False])
    assert UniformPrior(np.zeros(3), 1.0, np.pi).contains([[0.0, 0.0, 2.5]]).all()
    for half, heading in ((0.0, 0.1), (1.0, 0.0), (1.0, 4.0), (np.nan, 0.1)):
        with pytest.raises(SkyfixError, match="prior"):
            UniformPrior(np.zeros(3), half, heading)


def test_stamps_may_span_all_of_64_bits():
    assert len(Trajectory(np.array([-(2**62) - 5, 2**62 + 5]), np.zeros((2, 3)))) == 2


def test_stamps_beyond_64_bits_are_refused():
    with pytest.raises(SkyfixError, match="stamps: expected int64 nanoseconds, got 9223372036854775817"):
        Trajectory(np.array([2**63 + 5, 2**63 + 9], dtype=np.uint64), np.zeros((2, 3)))
