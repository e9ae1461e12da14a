"""Bridges of odometry between two known poses: its conditional density, and ends that join."""

import numpy as np

from fusion import OdometryIncrement, accumulate, se2
from fusion.particles.odometry_bridge import bridge


def increment(stamp, delta, covariance):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), covariance)


def test_bridges_are_the_conditional_of_the_odometry():
    """Against importance sampling: free walks, weighted by how near they end; tolerances of five errors."""
    steps = [
        increment(1, [1.0, 0.0, 0.3], np.diag([0.1, 0.05, 0.05]) ** 2),
        increment(2, [1.0, 0.1, 0.4], np.diag([0.2, 0.05, 0.02]) ** 2),
        increment(3, [0.5, 0.0, -0.2], np.diag([0.1, 0.1, 0.05]) ** 2),
    ]
    total, start, rng = accumulate(steps), np.array([3.0, -2.0, 3.0]), np.random.default_rng(12)
    end = se2.compose(start, total.delta + np.array([0.15, -0.1, 0.06]))
    count = 400_000
    pose, walk = np.repeat(start[None], count, axis=0), []
    for step in steps:
        pose = se2.compose(pose, step.delta + rng.multivariate_normal(np.zeros(3), step.covariance, count))
        walk.append(pose)
    miss = se2.between(end[None], pose)
    weights = np.exp(-0.5 * (miss**2 / np.array([0.03, 0.03, 0.012]) ** 2).sum(axis=1))
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert effective > 1000
    drawn = bridge(np.repeat(start[None], 5000, axis=0), np.repeat(end[None], 5000, axis=0), steps, rng)
    assert drawn.shape == (5000, 2, 3)
    for k in range(2):
        mean, covariance = se2.weighted_mean_and_covariance(walk[k], weights)
        found, spread = se2.weighted_mean_and_covariance(drawn[:, k], np.ones(5000))
        off = found - mean
        off[2] = se2.wrap(off[2])
        assert (np.abs(off) < 5 * np.sqrt(np.diag(covariance) / effective)).all()
        ratio = np.sqrt(np.diag(spread) / np.diag(covariance))
        np.testing.assert_allclose(ratio, 1.0, atol=5 / np.sqrt(2 * effective) + 0.05)


def test_bridges_join_their_ends_under_any_odometry():
    rng = np.random.default_rng(13)
    steps = [increment(k, [1.0, 0.0, 0.2], np.diag([0.1, 0.03, 0.02]) ** 2 * (k % 2)) for k in range(6)]
    start = rng.normal(0, [5, 5, 2], (50, 3))
    end = se2.compose(start, accumulate(steps).delta + rng.normal(0, [0.3, 0.2, 0.05], (50, 3)))
    drawn = bridge(start, end, steps, rng)
    chain = np.concatenate([start[:, None], drawn, end[:, None]], axis=1)
    moved = se2.between(chain[:, :-1], chain[:, 1:])
    even = moved[:, [0, 2, 4]] - steps[0].delta  # the steps that claim to be perfect keep their word
    np.testing.assert_allclose(even[:, :2], 0.0, atol=2e-4)
    last = moved[:, 5] - steps[5].delta
    assert (np.abs(last) < 6 * np.array([0.1, 0.1, 0.03])).all()
