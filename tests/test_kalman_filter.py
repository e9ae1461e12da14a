"""The unscented Kalman filter: exact where a Kalman filter is, honest about its one mode, unharmed by bad input."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    KalmanFilter,
    KalmanFilterSettings,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    SkyfixError,
    UniformPrior,
    se2,
)

GRID = MapGrid(81, 81, 0.5, -20.25, -20.25)
MEASURED = np.diag([0.6, 0.4, 0.03]) ** 2
SURE = KalmanFilterSettings(outlier_probability=1e-12, gate_probability=1 - 1e-9)


def increment(stamp, delta, covariance):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), covariance)


def at(pose, covariance=MEASURED):
    return GaussianLikelihood(np.asarray(pose, dtype=float), covariance, GRID)


def two_places(first=0.0, second=-1.0):
    """Peaks at (0, 0, 0) and (6, 2, 0), of ln heights `first` and `second`."""
    x, y = GRID.centres()
    yaw = 2 * np.pi * np.arange(72) / 72
    heading = (np.cos(yaw) - 1.0) / 0.1**2
    scores = [
        height - 0.5 * ((x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2) + heading
        for x0, y0, height in ((0.0, 0.0, first), (6.0, 2.0, second))
    ]
    return LikelihoodVolume.from_scores(np.logaddexp(*scores), GRID)


def test_it_is_the_kalman_filter_where_that_is_exact():
    """Mean, covariance and evidence of a drive at small headings, against the equations written out."""
    mean, covariance = np.zeros(3), np.diag([0.5, 0.5, 0.002]) ** 2
    motion, delta, noise = np.diag([0.1, 0.1, 0.0005]) ** 2, np.array([0.4, 0.0, 0.0]), np.diag([0.6, 0.4, 0.02]) ** 2
    rng = np.random.default_rng(0)
    one = KalmanFilter(mean, covariance, SURE)
    expected = evidence = 0.0
    jacobian = np.eye(3)
    jacobian[1, 2] = delta[0]
    for step in range(25):
        mean, covariance = jacobian @ mean + delta, jacobian @ covariance @ jacobian.T + motion
        one.predict(increment(step, delta, motion))
        measured = np.array([0.4 * (step + 1), 0.1, 0.0]) + rng.normal(0, [0.6, 0.4, 0.02])
        spread = covariance + noise
        innovation = measured - mean
        expected -= 0.5 * (innovation @ np.linalg.solve(spread, innovation) + np.linalg.slogdet(2 * np.pi * spread)[1])
        gain = covariance @ np.linalg.inv(spread)
        mean, covariance = mean + gain @ innovation, covariance - gain @ covariance
        evidence += one.update(at(measured, noise)).log_evidence
    estimate = one.estimate(9, max_modes=2)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((estimate.pose - mean) / sigma, 0.0, atol=2e-3)
    np.testing.assert_allclose(
        estimate.covariance / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=2e-3
    )
    assert evidence == pytest.approx(expected, abs=2e-3)
    assert (estimate.stamp_ns, estimate.lost_score, len(estimate.modes)) == (9, 0.0, 1)
    assert one.estimate(9).modes is None


def test_prediction_turns_the_noise_into_the_map():
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.001], [0.0, 0.001, 0.0004]])
    one = KalmanFilter([3.0, 4.0, np.pi / 2], np.zeros((3, 3)))
    one.predict(increment(0, [2.0, 1.0, 0.1], covariance))
    estimate = one.estimate(0)
    np.testing.assert_allclose(estimate.pose, [2.0, 6.0, np.pi / 2 + 0.1], atol=1e-6)
    turn = se2.rotation(np.pi / 2)
    np.testing.assert_allclose(estimate.covariance, turn @ covariance @ turn.T, atol=1e-6)


def test_headings_at_the_seam_are_averaged_on_the_circle():
    one = KalmanFilter([0.0, 0.0, np.pi - 0.02], np.diag([1.0, 1.0, 0.01]))
    one.predict(increment(0, [1.0, 0.0, 0.05], np.diag([0.01, 0.01, 0.0001])))
    one.update(at([-1.0, 0.0, -np.pi + 0.06], np.diag([1.0, 1.0, 0.01])))
    estimate = one.estimate(0)
    assert abs(se2.wrap(estimate.pose[2] - np.pi - 0.045)) < 0.01
    assert estimate.covariance[2, 2] < 0.006


def test_it_takes_the_heaviest_mode_within_the_gate_and_none_beyond():
    wide = KalmanFilter([3.0, 1.0, 0.0], np.diag([9.0, 9.0, 0.1]))
    wide.update(two_places(second=-1.0))
    np.testing.assert_allclose(wide.estimate(0).pose[:2], [0.3, 0.1], atol=0.15)  # the heavier of two within
    near = KalmanFilter([5.5, 2.0, 0.0], np.diag([0.3, 0.3, 0.01]))
    near.update(two_places(second=-1.0))
    assert near.estimate(0).pose[0] > 5.5  # the lighter is the only one within
    lost = KalmanFilter([-15.0, -15.0, 0.0], np.diag([0.3, 0.3, 0.01]))
    before = lost.estimate(0)
    report = lost.update(two_places())
    np.testing.assert_array_equal(lost.estimate(0).pose, before.pose)
    np.testing.assert_array_equal(lost.estimate(0).covariance, before.covariance)
    assert report.log_evidence == pytest.approx(np.log(0.05) - np.log(GRID.area_m2 * 2 * np.pi))


def test_temperature_weighs_measurements_down():
    """Two measurements at T = 2 say what one says at T = 1."""
    once, twice = (KalmanFilter(np.zeros(3), np.diag([1.0, 1.0, 0.01])) for _ in range(2))
    once.update(at([0.3, 0.2, 0.01]))
    for _ in range(2):
        twice.update(at([0.3, 0.2, 0.01]), temperature=2.0)
    np.testing.assert_allclose(once.estimate(0).pose, twice.estimate(0).pose, atol=1e-6)
    np.testing.assert_allclose(once.estimate(0).covariance, twice.estimate(0).covariance, atol=1e-6)


def test_a_start_from_a_box_has_its_moments():
    prior = UniformPrior(np.array([1.0, 2.0, 3.0]), 4.0, 0.3)
    estimate = KalmanFilter.from_prior(prior).estimate(0)
    np.testing.assert_allclose(estimate.pose, prior.mean)
    np.testing.assert_allclose(estimate.covariance, prior.covariance, atol=1e-8)


class Broken(GaussianLikelihood):
    """Its modes cannot be had."""

    __slots__ = ()

    def modes(self, k):
        if k > 1:
            raise SkyfixError("mixture means: expected finite values, got 3 of 3 not finite")
        return GaussianLikelihood.modes(self, k)


def test_bad_input_is_one_line_and_leaves_the_filter_as_it_was():
    one = KalmanFilter(np.zeros(3), np.eye(3))
    one.update(at(np.zeros(3)))
    before = one.estimate(0)
    for word, call in {
        "outlier_probability: expected in": lambda: KalmanFilterSettings(outlier_probability=0.0),
        "gate_probability: expected in": lambda: KalmanFilterSettings(gate_probability=1.0),
        "max_modes: expected >= 1": lambda: KalmanFilterSettings(max_modes=0),
        "mean: expected .3,.": lambda: KalmanFilter(np.zeros(2), np.eye(3)),
        "mean: expected finite": lambda: KalmanFilter(np.full(3, np.nan), np.eye(3)),
        "covariance: expected .3, 3.": lambda: KalmanFilter(np.zeros(3), np.eye(2)),
        "covariance: expected a symmetric": lambda: KalmanFilter(np.zeros(3), np.eye(3) + np.eye(3, k=1)),
        "covariance: expected positive": lambda: KalmanFilter(np.zeros(3), -np.eye(3)),
        "temperature: expected > 0": lambda: one.update(at(np.zeros(3)), temperature=np.nan),
        "mixture means: expected finite": lambda: one.update(Broken(np.zeros(3), MEASURED, GRID)),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
    after = one.estimate(0)
    np.testing.assert_array_equal(after.pose, before.pose)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.log_evidence == before.log_evidence
