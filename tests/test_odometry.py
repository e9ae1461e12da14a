"""Odometry increments: composition, noise that adds up, and first-order covariances against simulation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import OdometryIncrement, OdometryNoise, SkyfixError, Trajectory, accumulate, increments_at, se2

SECOND = 1_000_000_000
NOISE = OdometryNoise(0.05, 0.03, 0.004, 0.02, 0.003)


def increment(stamp, delta, covariance=None):
    return OdometryIncrement(
        stamp, np.asarray(delta, dtype=float), np.zeros((3, 3)) if covariance is None else covariance
    )


def winding_drive(count=40, seed=0):
    rng = np.random.default_rng(seed)
    steps = np.column_stack([rng.uniform(0.5, 1.5, count), rng.normal(0, 0.02, count), rng.normal(0, 0.1, count)])
    poses = [np.array([5.0, -2.0, 2.8])]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return Trajectory(np.arange(count + 1) * SECOND // 10, np.array(poses), frame_id="odometry")


def test_increments_lead_from_the_first_pose_to_the_last_whatever_the_frame():
    drive = winding_drive()
    stamps = drive.stamp_ns[::3]
    increments = increments_at(stamps, drive, NOISE)
    assert [one.stamp_ns for one in increments] == list(stamps[1:])
    pose = np.array([100.0, 50.0, -1.0])  # another frame altogether
    for one in increments:
        pose = se2.compose(pose, one.delta)
    expected = se2.compose(
        np.array([100.0, 50.0, -1.0]), se2.between(drive.poses[0], drive.interpolate(stamps[-1:])[0])
    )
    np.testing.assert_allclose(se2.between(pose, expected), 0.0, atol=1e-9)


def test_increments_between_the_odometry_s_own_stamps():
    drive = Trajectory(np.array([0, SECOND]), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    (first, second) = increments_at([0, SECOND // 4, SECOND // 2], drive, NOISE)
    np.testing.assert_allclose(first.delta, [0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(second.covariance, NOISE.covariance([0.5, 0.0, 0.0], 0.25), atol=1e-15)


def test_accumulated_deltas_are_the_motion_from_end_to_end():
    drive = winding_drive()
    total = accumulate(increments_at(drive.stamp_ns, drive, NOISE))
    np.testing.assert_allclose(se2.between(total.delta, se2.between(drive.poses[0], drive.poses[-1])), 0.0, atol=1e-9)
    assert total.stamp_ns == drive.stamp_ns[-1]


@given(st.integers(1, 12), st.floats(-3.0, 3.0), st.floats(0.1, 40.0), st.floats(0.0, 20.0))
def test_a_straight_drive_is_as_uncertain_in_pieces_as_in_one(pieces, direction, distance, seconds):
    delta = distance * np.array([np.cos(direction), np.sin(direction), 0.0])
    part = NOISE.covariance(delta / pieces, seconds / pieces)
    total = accumulate([increment(i, delta / pieces, part) for i in range(pieces)])
    np.testing.assert_allclose(total.covariance, NOISE.covariance(delta, seconds), rtol=1e-9, atol=1e-12)


def test_accumulated_covariance_is_that_of_simulated_drives():
    drive = winding_drive()
    increments = increments_at(drive.stamp_ns, drive, NOISE)
    rng = np.random.default_rng(1)
    ends = np.zeros((20_000, 3))
    for one in increments:
        error = rng.standard_normal(ends.shape) @ np.linalg.cholesky(one.covariance).T
        ends = se2.compose(ends, one.delta + error)
    _, simulated = se2.weighted_mean_and_covariance(ends, np.ones(len(ends)))
    stated = accumulate(increments).covariance
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert (np.abs(simulated - stated) < 0.04 * scale).all()  # 4 sigma of a variance from 20,000 draws, and curvature


def test_noise_grows_along_and_across_the_motion():
    moving = OdometryNoise(0.1, 0.02, 0.0, 0.0, 0.0, 0.0)
    ahead = moving.covariance([9.0, 0.0, 0.0])
    np.testing.assert_allclose(np.sqrt(np.diag(ahead)), [0.3, 0.06, 0.0])
    left = moving.covariance([0.0, 9.0, 0.0])
    np.testing.assert_allclose(np.sqrt(np.diag(left)), [0.06, 0.3, 0.0])
    still = OdometryNoise(0.1, 0.1, 0.1, 0.1, 0.02, 0.003).covariance(np.zeros(3), seconds=4.0)
    np.testing.assert_allclose(np.sqrt(np.diag(still)), [0.04, 0.04, 0.006])
    turning = OdometryNoise(0.0, 0.0, 0.0, 0.05, 0.0, 0.0)
    for turn in (-1.44, 1.44):
        np.testing.assert_allclose(np.sqrt(np.diag(turning.covariance([0.0, 0.0, turn]))), [0.0, 0.0, 0.06])


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-4, 4), st.floats(0, 10))
def test_noise_is_always_a_covariance(x, y, yaw, seconds):
    covariance = NOISE.covariance([x, y, yaw], seconds)
    np.testing.assert_array_equal(covariance.shape, (3, 3))
    assert np.linalg.eigvalsh(covariance).min() >= -1e-15
    OdometryIncrement(0, np.array([x, y, yaw]), covariance)


def test_bad_increments_are_refused():
    lopsided = np.eye(3)
    lopsided[0, 1] = 0.5
    for word, call in {
        "delta": lambda: increment(0, [np.nan, 0.0, 0.0]),
        "delta: expected": lambda: increment(0, [0.0, 0.0]),
        "symmetric matrix": lambda: increment(0, np.zeros(3), lopsided),
        "semidefinite": lambda: increment(0, np.zeros(3), -np.eye(3)),
        "at least one": lambda: accumulate([]),
        "stamp after": lambda: accumulate([increment(5, np.zeros(3)), increment(5, np.zeros(3))]),
        "seconds: expected zero or more, got -5": lambda: OdometryNoise().covariance(np.zeros(3), -5.0),
        "lateral": lambda: OdometryNoise(lateral_m_per_sqrt_m=-1.0),
        "expected stamps in": lambda: increments_at([0, 5 * SECOND], winding_drive(5), NOISE),
        "increasing": lambda: increments_at([1, 0], winding_drive(5), NOISE),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_yaw_of_an_increment_is_wrapped():
    assert increment(0, [0.0, 0.0, 2 * np.pi + 0.1]).delta[2] == pytest.approx(0.1)
