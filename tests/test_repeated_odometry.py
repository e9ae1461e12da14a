"""An odometry that arrives more often than it is computed, and velocities that no vehicle has."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import MotionKind, OdometryLimits, OdometryNoise, Tracker, UniformPrior
from fusion.tracking.odometry_buffer import OdometryBuffer, OdometrySample

NOISE, LIMITS = OdometryNoise(), OdometryLimits()
FIFTIETH = 20_000_000
SPEED = 15.0


def held_pose(index: int) -> np.ndarray:
    """At 15 m/s, published at 50 Hz, computed at 10 Hz: 1.5 m at once, which would be 75 m/s."""
    return np.array([SPEED * 0.1 * (index // 5), 0.0, 0.0])


def buffer(indices, pose=held_pose, step_ns=FIFTIETH) -> OdometryBuffer:
    made = OdometryBuffer(NOISE, LIMITS)
    for index in indices:
        made.insert(OdometrySample(step_ns * index, pose(index)))
    return made


@given(st.permutations(range(16)))
def test_repeated_poses_are_no_standstill_before_a_jump_in_whatever_order_they_arrive(order):
    held = buffer(order)
    assert +held.kind_counts == {MotionKind.START: 1, MotionKind.DRIVEN: 15}
    np.testing.assert_allclose(held.motion(0, 15 * FIFTIETH).delta, [4.5, 0.0, 0.0], atol=1e-9)


def test_a_jump_after_repeated_poses_is_one_where_the_time_is_too_short_or_too_long():
    far = buffer(range(6), lambda index: held_pose(index) * 10.0)  # 15 m within a tenth of a second
    assert far.kind_counts[MotionKind.RESET] == 1
    stood = buffer(range(60), lambda index: np.array([10.0 * (index == 59), 0.0, 0.0]))  # for 1.2 s
    assert stood.kind_counts[MotionKind.RESET] == 1


def test_what_was_repeated_is_known_after_the_beginning_was_forgotten_and_in_a_file():
    held = buffer([0, 1, 2, 3, 4, 5, 6, 7, 9])
    held.forget_before(7 * FIFTIETH)
    for one in (held, OdometryBuffer.from_tree(held.to_tree(), NOISE, LIMITS)):
        for index in (8, 10, 11):
            one.insert(OdometrySample(FIFTIETH * index, held_pose(index)))
        assert one.kind_counts[MotionKind.RESET] == 0


def test_a_tracker_follows_an_odometry_that_repeats_itself(tmp_path):
    tracker = Tracker.from_prior(UniformPrior(np.zeros(3), 2.0, 0.1), 500, seed=3)
    for index in range(300):
        if index == 157:  # within a run
            tracker.save(tmp_path / "tracker.npz")
            tracker = Tracker.load(tmp_path / "tracker.npz")
        tracker.add_odometry(FIFTIETH * index, held_pose(index))
    assert tracker.statistics.resets == 0
    assert tracker.estimate().pose[0] == pytest.approx(held_pose(299)[0], abs=1.5)


def test_beyond_odometry_no_vehicle_is_faster_than_it_can_be():
    leaping = buffer(range(60), lambda index: np.array([0.4 * index, 0.0, 0.03 * index]), step_ns=1_000_000)
    soon = leaping.extrapolated(60 * 1_000_000)
    np.testing.assert_allclose([np.hypot(*soon.delta[:2]), soon.delta[2]], [0.06, 0.003], atol=1e-4)  # a millisecond
    assert np.hypot(*leaping.extrapolated(100_000_000_000).delta[:2]) <= 600.0


def test_two_samples_a_moment_apart_tell_no_velocity():
    jittered = buffer(range(2), lambda index: np.array([0.4 * index, 0.0, 0.0]), step_ns=1000)
    ahead = jittered.extrapolated(1_000_000_000)
    np.testing.assert_array_equal(ahead.delta, 0.0)
    np.testing.assert_allclose(ahead.covariance, LIMITS.reset_covariance(1.0 - 1e-6), rtol=1e-12)
    known = buffer(range(3), lambda index: np.array([0.4 * index, 0.0, 0.0]), step_ns=30_000_000).extrapolated(
        90_000_000
    )
    assert known.delta[0] == pytest.approx(0.4)
