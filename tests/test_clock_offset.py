"""The odometry's clock: found where turns show it, left alone where nothing does."""

import numpy as np
import pytest

from fusion import GaussianMixture, OdometryNoise, SmootherResult, Trajectory, UniformPrior, se2, smooth
from fusion.odometry import increments_at
from sequences.clock_offset import shifted, with_best_offset

SECOND = 1_000_000_000


def drive(turning: float) -> Trajectory:
    """10 m/s for 40 s at 20 Hz, weaving with a yaw rate of so many radians a second."""
    t = np.arange(0, 40, 0.05)
    yaw = turning * 8.0 / (2 * np.pi) * (1 - np.cos(2 * np.pi * t / 8.0))
    step = 0.5 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (step[:-1] + step[1:]), axis=0)])
    return Trajectory((t * SECOND).astype(np.int64), np.column_stack([xy, yaw]))


def smoothed(turning: float, clock_s: float, seed: int) -> tuple[SmootherResult, float, np.ndarray]:
    """A drive whose odometry is stamped `clock_s` too early, smoothed with the best offset."""
    truth = drive(turning)
    rng = np.random.default_rng(seed)
    stamps = truth.stamp_ns[20:-20:10]
    poses = truth.interpolate(stamps)
    covariance = np.diag([0.3, 0.3, np.deg2rad(1.0)]) ** 2
    seen = [
        GaussianMixture(np.ones(1), (pose + rng.multivariate_normal(np.zeros(3), covariance))[None], covariance[None])
        for pose in poses
    ]
    odometry = Trajectory(truth.stamp_ns - round(clock_s * SECOND), truth.poses)
    initial = Trajectory(stamps, poses, np.repeat(covariance[None], len(stamps), axis=0))
    prior = UniformPrior(poses[0], 5.0, 0.2)

    def smoothing(offset_s: float) -> SmootherResult:
        motions = increments_at(stamps, shifted(odometry, offset_s), OdometryNoise())
        return smooth(stamps, motions, seen, prior, initial)

    result, offset = with_best_offset(smoothing)
    heading = np.abs(se2.wrap(result.trajectory.poses[:, 2] - poses[:, 2]))
    return result, offset, heading


@pytest.mark.parametrize("clock_s", [-0.17, 0.12, 0.25])
def test_an_offset_is_found_in_turns(clock_s: float) -> None:
    _, offset, heading = smoothed(0.4, clock_s, seed=1)
    assert offset == pytest.approx(clock_s, abs=0.03)
    assert np.rad2deg(heading.mean()) < 0.5


@pytest.mark.parametrize(("turning", "clock_s"), [(0.4, 0.0), (0.0, 0.2)])
def test_without_evidence_the_clock_is_left_alone(turning: float, clock_s: float) -> None:
    """A right clock stays, and on a straight road at constant speed no clock can be told from another."""
    for seed in range(3):
        assert smoothed(turning, clock_s, seed)[1] == 0.0


def test_a_shifted_odometry_moves_alike_and_goes_on_at_its_ends() -> None:
    odometry = drive(0.3)
    moved = shifted(odometry, 0.13)
    at = odometry.stamp_ns[5:-5:7]
    np.testing.assert_allclose(moved.interpolate(at + round(0.13 * SECOND)), odometry.interpolate(at), atol=1e-6)
    first, last = moved.span_ns
    assert first < odometry.span_ns[0]
    assert last > odometry.span_ns[1]
    edge = moved.interpolate(np.array([last - SECOND // 5, last]))
    assert np.hypot(*(edge[1] - edge[0])[:2]) == pytest.approx(2.0, rel=0.02)
