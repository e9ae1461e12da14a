"""Odometry that knows nothing of the heading: the cloud's headings become uniform, and it stays where it can be."""

from __future__ import annotations

from math import pi

import numba
import numpy as np
import pytest
from scipy.stats import kstest

from fusion import OdometryIncrement, ParticleFilter, Tracker, UniformPrior, se2
from fusion.kernels.float_math import KERNEL, MOST_TURNS, within_a_turn
from fusion.particles.moments import lower_root, motion_root

COUNT = 20_000
LIMIT = 4.5 / np.sqrt(COUNT)


@numba.njit(**{**KERNEL, "cache": False})
def all_within_a_turn(angles, result):
    for j in range(len(angles)):
        result[j] = within_a_turn(angles[j])


def moved(covariance, turn=0.0) -> ParticleFilter:
    """Particles at the origin, headings near 2 rad, after standing still by an odometry of such a covariance."""
    particles = np.zeros((COUNT, 3))
    particles[:, 2] = 2.0
    one = ParticleFilter(particles, 5)
    one.predict(OdometryIncrement(1, np.array([0.0, 0.0, turn]), np.asarray(covariance, np.float64)))
    return one


def test_whole_turns_are_taken_away_and_nothing_else():
    angles = np.linspace(-MOST_TURNS * 2.0 * pi, MOST_TURNS * 2.0 * pi, 100_001).astype(np.float32)
    result = np.empty_like(angles)
    all_within_a_turn(angles, result)
    assert np.abs(result).max() < pi + 1e-4
    np.testing.assert_allclose(np.exp(1j * result), np.exp(1j * angles.astype(np.float64)), atol=1e-5)
    within = np.abs(angles) < pi - 1e-4
    np.testing.assert_array_equal(result[within], angles[within])


@pytest.mark.parametrize("variance", [(2.0 * pi) ** 2, 100.0, 1e6, 1e8, 1e300])
def test_an_unknown_heading_is_uniform_on_the_circle(variance):
    one = moved(np.diag([0.0, 0.0, variance]))
    yaw = one.particles[:, 2]
    assert kstest(yaw, "uniform", (-pi, 2.0 * pi)).pvalue > 1e-4
    assert yaw.var() == pytest.approx(pi**2 / 3.0, rel=0.03)
    one.predict(OdometryIncrement(2, np.array([10.0, 0.0, 0.0]), np.zeros((3, 3))))
    np.testing.assert_allclose(np.hypot(*one.particles[:, :2].T), 10.0, atol=1e-4)
    assert one.estimate(2).covariance[0, 0] == pytest.approx(50.0, rel=0.03)


@pytest.mark.parametrize("variance", [0.05, 0.2, 1.0, 4.0])
def test_a_wide_heading_is_a_wrapped_normal(variance):
    """The first two coefficients of its characteristic function, on either side of where the kernel begins to wrap."""
    off = np.exp(1j * (moved(np.diag([0.0, 0.0, variance]), turn=-2.5).particles[:, 2] + 0.5))
    for order in (1, 2):
        assert abs((off**order).mean() - np.exp(-0.5 * order**2 * variance)) < LIMIT


def test_what_a_wide_heading_shares_with_the_position_is_kept():
    """``E[x sin(t)] = cov(x, t) exp(-var(t) / 2)`` for joint normals."""
    covariance = np.array([[4.0, 0.0, 1.8], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    covariance[2, 0] = covariance[0, 2]
    one = moved(covariance)
    forward = se2.between(np.array([0.0, 0.0, 2.0]), one.particles)
    assert (forward[:, 0] * np.sin(forward[:, 2])).mean() == pytest.approx(1.8 * np.exp(-0.5), abs=2.0 * LIMIT)
    assert forward[:, 0].var() == pytest.approx(4.0, rel=0.05)


def test_the_root_of_a_motion_keeps_correlations_and_ordinary_noise():
    covariance = np.array([[4.0, 0.6, 300.0], [0.6, 1.0, -100.0], [300.0, -100.0, 1e5]])
    root = np.array(motion_root(covariance.tolist())).reshape(3, 3)
    capped = root @ root.T
    scale = np.sqrt(np.diag(covariance) / np.diag(capped))
    np.testing.assert_allclose(capped * np.outer(scale, scale), covariance, rtol=1e-12)
    assert capped[2, 2] == pytest.approx((2.0 * pi) ** 2)
    ordinary = np.diag([1.0, 2.0, 3.0]).tolist()
    assert motion_root(ordinary) == lower_root(ordinary)


def test_a_tracker_lives_on_odometry_that_knows_nothing():
    """Variances of a million, as a driver reports what it does not measure; the covariance says it all."""
    one = Tracker.from_prior(UniformPrior(np.zeros(3), 5.0, 0.3), 500)
    for i in range(40):
        one.add_increment(OdometryIncrement(i * 10**8, np.array([0.1, 0.0, 0.0]), 1e6 * np.eye(3)))
    estimate = one.estimate()
    assert np.isfinite(estimate.pose).all()
    assert np.sqrt(np.diag(estimate.covariance)[:2]) == pytest.approx([np.sqrt(39.0) * 1e3] * 2, rel=0.15)
    assert one.statistics.odometry == 40
