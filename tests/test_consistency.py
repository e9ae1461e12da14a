"""Consistency measures: NEES and coverage of errors that are what they claim, temperature of errors that repeat."""

import numpy as np
import pytest
from filterpy.stats import NEES
from hypothesis import given
from hypothesis import strategies as st

from fusion import GaussianLikelihood, MapGrid, OdometryIncrement, ParticleFilter, SkyfixError, se2
from fusion.consistency import MAX_TEMPERATURE, correlated_error_temperature, coverage, nees


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_temperature_is_the_formula(distance, length):
    rho = np.exp(-distance / length)
    expected = min((1 + rho) / (1 - rho), MAX_TEMPERATURE)
    assert correlated_error_temperature(distance, length) == pytest.approx(expected, rel=1e-6)


def test_temperature_at_its_limits():
    assert correlated_error_temperature(5.0, 0.0) == 1.0
    assert correlated_error_temperature(0.0, 0.0) == 1.0
    assert correlated_error_temperature(0.0, 10.0) == MAX_TEMPERATURE
    assert correlated_error_temperature(1e6, 10.0) == 1.0
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(SkyfixError, match="distance_m"):
            correlated_error_temperature(bad, 10.0)
        with pytest.raises(SkyfixError, match="correlation_length_m"):
            correlated_error_temperature(1.0, bad)


def autoregression(rho, count, series, rng):
    """Unit-variance first-order autoregressions (count, series)."""
    errors = np.empty((count, series))
    errors[0] = rng.standard_normal(series)
    for i in range(1, count):
        errors[i] = rho * errors[i - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(series)
    return errors


@pytest.mark.parametrize("rho", [0.3, 0.7, 0.9])
def test_temperature_is_the_inflation_of_a_mean_s_variance(rho):
    errors = autoregression(rho, 1000, 3000, np.random.default_rng(0))
    inflation = 1000 * errors.mean(axis=0).var()
    temperature = correlated_error_temperature(-np.log(rho), 1.0)
    assert inflation == pytest.approx(temperature, rel=4 * np.sqrt(2 / 3000) + 0.02)


def test_nees_of_honest_errors_is_their_dimension():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(4000, 3, 3)) + 2 * np.eye(3)
    errors = np.einsum("nij,nj->ni", roots, rng.standard_normal((4000, 3)))
    values = nees(errors, roots @ roots.swapaxes(1, 2))
    assert values.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / 4000))
    assert coverage(values, 3) == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 4000))
    assert coverage(4.0 * values, 3) < 0.7  # standard deviations stated half as large as they are
    assert coverage(values, 3, level=0.5) == pytest.approx(0.5, abs=0.035)


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
def test_nees_is_filterpy_s(dof):
    rng = np.random.default_rng(dof)
    truth, estimate = rng.normal(size=(2, 200, dof))
    roots = rng.normal(size=(200, dof, dof)) + 3 * np.eye(dof)
    covariances = roots @ roots.swapaxes(1, 2)
    np.testing.assert_allclose(nees(estimate - truth, covariances), NEES(truth, estimate, covariances), rtol=1e-6)


def test_nees_does_not_care_about_the_axes():
    rng = np.random.default_rng(2)
    errors, covariance = rng.normal(size=(5, 3)), np.diag([1.0, 4.0, 0.1])
    turn = se2.rotation(0.7)
    straight = nees(errors, np.repeat(covariance[None], 5, axis=0))
    turned = nees(errors @ turn.T, np.repeat((turn @ covariance @ turn.T)[None], 5, axis=0))
    np.testing.assert_allclose(straight, turned)
    np.testing.assert_allclose(straight, (errors**2 / np.diag(covariance)).sum(axis=1))


def test_bad_input_is_refused():
    with pytest.raises(SkyfixError, match="positive definite"):
        nees(np.zeros((1, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(SkyfixError, match="covariances"):
        nees(np.zeros((2, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(SkyfixError, match="coverage"):
        coverage(np.array([]), 3)
    with pytest.raises(SkyfixError, match="coverage"):
        coverage(np.ones(3), 3, level=1.0)


def drive_with_repeating_errors(temperature, seed, steps=250, rho=0.9):
    """NEES per degree of freedom of a filter whose measurement errors are correlated from step to step."""
    rng = np.random.default_rng(seed)
    grid = MapGrid(200, 200, 1.0, -100.0, -100.0)
    motion_noise, measured = np.diag([0.05, 0.05, 0.002]) ** 2, np.diag([0.8, 0.8, 0.03]) ** 2
    truth = np.zeros(3)
    particles = ParticleFilter(rng.multivariate_normal(truth, measured, 1000), seed)
    measurement_errors = autoregression(rho, steps, 3, rng) * np.sqrt(np.diag(measured))
    errors, covariances = [], []
    for step in range(steps):
        delta = np.array([0.5, 0.0, 0.05])
        truth = se2.compose(truth, delta + rng.multivariate_normal(np.zeros(3), motion_noise))
        particles.predict(OdometryIncrement(step, delta, motion_noise))
        mean = truth + measurement_errors[step]
        particles.update(GaussianLikelihood(mean, measured, grid), temperature if step else 1.0)
        if step >= 50:
            estimate = particles.estimate(step)
            error = estimate.pose - truth
            error[2] = se2.wrap(error[2])
            errors.append(error)
            covariances.append(estimate.covariance)
    return nees(np.array(errors), np.array(covariances)).mean() / 3


def test_tempering_makes_a_filter_honest_when_errors_repeat():
    tempered = np.mean([drive_with_repeating_errors((1 + 0.9) / (1 - 0.9), seed) for seed in range(3)])
    plain = np.mean([drive_with_repeating_errors(1.0, seed) for seed in range(3)])
    assert plain > 3.0  # overconfident by far
    assert 0.5 < tempered < 1.7
