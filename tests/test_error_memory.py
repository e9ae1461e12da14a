"""Errors that repeat: a filter that remembers them claims what it has, in closed form and with particles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import EmulatorSettings, LikelihoodEmulator, OdometryIncrement, ParticleFilter, SkyfixError, se2
from fusion.consistency import correlated_error_temperature, error_correlation, nees
from fusion.emulation.error_profile import ErrorProfile
from fusion.error_memory import ErrorMemory, smoothing_temperature


def claims(drift, variance, distances, length, temperature_of):
    """True over claimed variance of a scalar Kalman filter, step by step, by the exact recursion; and the truth."""
    claimed = true = 100.0
    shared, memory, ratios = 0.0, ErrorMemory(), []
    for step, distance in enumerate(distances):
        claimed, true = claimed + drift * distance, true + drift * distance
        rho = error_correlation(distance, length) if step else 0.0
        temperature = temperature_of(memory, rho, claimed)
        gain = claimed / (claimed + temperature * variance)
        true = (1 - gain) ** 2 * true + gain**2 * variance + 2 * (1 - gain) * gain * rho * shared * variance
        shared = (1 - gain) * rho * shared + gain
        memory = memory.after(rho, temperature, [[claimed]], [[(1 - gain) * claimed]])
        claimed *= 1 - gain
        ratios.append(true / claimed)
    return np.array(ratios), true


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize(("drift", "variance"), [(0.01, 4.0), (0.3, 1.0), (1.0, 1.0)])
def test_a_linear_filter_claims_its_true_variance(drift, variance, irregular):
    """Correlation 0.9 a step: from the first measurement on within 6 %, later within 1 %; and it errs less."""
    distances = np.random.default_rng(0).uniform(0.1, 1.9, 300) if irregular else np.ones(300)
    length = -1.0 / np.log(0.9)
    ratios, true = claims(
        drift, variance, distances, length, lambda memory, rho, claimed: memory.temperature(rho, [[claimed]])
    )
    assert np.abs(ratios - 1.0).max() < 0.06
    assert np.abs(ratios[50:] - 1.0).mean() < 0.01

    def asymptotic(memory, rho, claimed):
        return (1 + rho) / (1 - rho)

    cautious, its_true = claims(drift, variance, distances, length, asymptotic)
    assert cautious[50:].mean() < 0.98
    assert true < its_true
    proud, _ = claims(drift, variance, distances, length, lambda memory, rho, claimed: 1.0)
    assert proud[50:].mean() > 1.5


def smoother_ratio(drift, variance, distances, length, smoothing):
    """True over claimed variance of the batch smoother of a scalar random walk, away from the ends."""
    claimed, memory, temperatures = 100.0, ErrorMemory(), []
    for step, distance in enumerate(distances):
        claimed += drift * distance
        rho = error_correlation(distance, length) if step else 0.0
        temperature = memory.temperature(rho, [[claimed]])
        gain = claimed / (claimed + temperature * variance)
        memory = memory.after(rho, temperature, [[claimed]], [[(1 - gain) * claimed]])
        claimed *= 1 - gain
        temperatures.append(smoothing(rho, temperature))
    steps = np.diff(np.eye(len(distances)), axis=0) / np.sqrt(drift * distances[1:, None])
    information = steps.T @ steps
    information[0, 0] += 1.0 / (100.0 + drift * distances[0])
    weights = np.diag(1.0 / (np.array(temperatures) * variance))
    covariance = np.linalg.inv(information + weights)
    way = np.cumsum(distances)
    errors = variance * np.exp(-np.abs(way[:, None] - way) / length)
    gains = covariance @ weights
    true = covariance @ information @ covariance + gains @ errors @ gains.T
    return (np.diag(true) / np.diag(covariance))[40:-40]


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize(("drift", "variance"), [(0.01, 4.0), (0.03, 1.0), (0.3, 1.0), (1.0, 1.0)])
def test_a_linear_smoother_claims_its_true_variance(drift, variance, irregular):
    """Correlation 0.9 a step: within 0.5 % at regular steps, 9 % at others; by a filter's temperatures it claims too
    little, most where it forgets soonest."""
    distances = np.random.default_rng(0).uniform(0.1, 1.9, 200) if irregular else np.ones(200)
    length = -1.0 / np.log(0.9)
    ratios = smoother_ratio(drift, variance, distances, length, smoothing_temperature)
    assert abs(ratios.mean() - 1.0) < (0.09 if irregular else 0.005)
    by_filter = smoother_ratio(drift, variance, distances, length, lambda rho, temperature: temperature)
    assert by_filter.mean() > (1.3 if drift >= 0.3 else 1.04)


@given(rho=st.floats(0.0, 1.0), temperature=st.floats(1.0, 1000.0))
def test_a_smoother_flattens_more_than_a_filter_and_less_than_one_that_forgets_nothing(rho, temperature):
    largest = (1 + rho) / max(1 - rho, 1e-3)
    found = smoothing_temperature(rho, temperature)
    assert temperature <= found <= max(temperature, largest)
    assert smoothing_temperature(0.0, temperature) == temperature
    assert smoothing_temperature(rho, 1.0) == 1.0


def test_a_filter_of_small_gain_comes_to_the_well_known_temperature():
    """Drift of 1e-6: the share that is left of a prediction is nearly 1."""
    found = []

    def remembered(memory, rho, claimed):
        found.append(memory.temperature(rho, [[claimed]]))
        return found[-1]

    claims(1e-6, 1.0, np.full(4000, 2.0), 10.0, remembered)
    assert found[0] == 1.0
    assert found[-1] == pytest.approx(correlated_error_temperature(2.0, 10.0), rel=0.02)


@pytest.mark.parametrize(
    "settings", [EmulatorSettings(step_correlation=0.9), EmulatorSettings(correlation_length_m=12.0)]
)
def test_particles_with_gaussian_errors_that_repeat_are_honest(settings):
    """NEES over 6 drives of 200 irregular steps: within 25 % of that with independent errors; unhandled above twice."""
    profile = ErrorProfile("emulated Gaussian", (2.0, 1.5, 0.035), (2.0, 1.5, 0.035), 0.0)
    covariance = np.diag([0.2, 0.15, 0.008]) ** 2

    def drive(seed, settings, handled):
        rng = np.random.default_rng([seed, 1])
        emulator = LikelihoodEmulator(profile, np.random.default_rng([seed, 2]), settings)
        truth, memory, values = np.zeros(3), ErrorMemory(), []
        particles = ParticleFilter(rng.normal(0.0, [2.0, 2.0, 0.05], (200, 3)), rng)
        for step in range(200):
            true = np.array([rng.uniform(1.0, 7.0), 0.0, 0.03])
            said = true - rng.multivariate_normal(np.zeros(3), covariance)
            truth = se2.compose(truth, true)
            particles.predict(OdometryIncrement(step, said, covariance))
            rho = settings.step_correlation or error_correlation(said[0], settings.correlation_length_m)
            before = particles.estimate(step).covariance
            temperature = memory.temperature(rho, before) if handled else 1.0
            particles.update(emulator.measure(truth, said[0]), temperature)
            estimate = particles.estimate(step)
            memory = memory.after(rho, temperature, before, estimate.covariance)
            error = estimate.pose - truth
            error[2] = se2.wrap(error[2])
            values.append(nees(error[None], estimate.covariance[None])[0] / 3)
        return np.mean(values[30:])

    independent = np.mean([drive(seed, EmulatorSettings(correlation_length_m=0.0), True) for seed in range(6)])
    assert 0.8 < independent < 1.35
    assert 0.8 < np.mean([drive(seed, settings, True) for seed in range(6)]) / independent < 1.25
    assert drive(0, settings, False) > 2.0 * independent


def test_a_measurement_that_did_nothing_says_nothing():
    memory = ErrorMemory().after(0.0, 1.0, np.eye(3), 0.5 * np.eye(3))
    same = memory.after(0.5, 2.0, np.eye(3), np.eye(3))
    assert same.shared == pytest.approx(0.5 * memory.shared, abs=2e-3)
    assert same.log_variance == pytest.approx(memory.log_variance, abs=0.1)
    assert memory.temperature(0.0, np.eye(3)) == 1.0
    assert 1.0 <= memory.temperature(1.0, 1e-12 * np.eye(3)) <= 1000.0


def test_bad_input_is_one_line():
    memory = ErrorMemory(0.5, 0.0)
    for word, call in {
        "correlation: expected in": lambda: memory.temperature(1.5, np.eye(3)),
        "covariance before: expected .D, D.": lambda: memory.temperature(0.5, np.eye(3)[0]),
        "covariance before: expected square and positive definite": lambda: memory.temperature(0.5, -np.eye(3)),
        "covariance after: expected": lambda: memory.after(0.5, 1.0, np.eye(3), np.eye(2)),
        "temperature: expected > 0": lambda: memory.after(0.5, 0.0, np.eye(3), np.eye(3)),
        "correlation: expected in .0, 1., got nan": lambda: smoothing_temperature(np.nan, 2.0),
        "temperature: expected at least 1, got 0.5": lambda: smoothing_temperature(0.5, 0.5),
        "distance_m: expected >= 0": lambda: error_correlation(-1.0, 2.0),
        "correlation_length_m: expected >= 0": lambda: error_correlation(1.0, np.nan),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
