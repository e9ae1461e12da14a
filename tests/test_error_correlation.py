"""Correlation of errors over distance: recovered from simulated drives, and put right in a filter."""

import numpy as np
import pytest
from scipy.stats import chi2

from fusion import (
    TRANSLOCNET_KITTI,
    EmulatorSettings,
    ErrorProfile,
    LikelihoodEmulator,
    OdometryIncrement,
    ParticleFilter,
    SkyfixError,
    estimate_error_correlation,
    se2,
)
from fusion.consistency import correlated_error_temperature, mean_nees_bounds, nees, nis
from fusion.error_correlation import fit_correlation_length


def driven(length_m, count, seed, step_m=2.0, scale=(0.8, 0.4, 0.02)):
    """Errors (N, 3) of an Ornstein-Uhlenbeck process over uneven steps, and the distances (N,)."""
    rng = np.random.default_rng(seed)
    steps = rng.exponential(step_m, count)
    errors = np.empty((count, 3))
    errors[0] = rng.standard_normal(3)
    for i in range(1, count):
        rho = np.exp(-steps[i] / length_m) if length_m else 0.0
        errors[i] = rho * errors[i - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(3)
    return errors * scale, np.cumsum(steps)


@pytest.mark.parametrize("length", [3.0, 10.0, 30.0])
def test_the_length_is_recovered(length):
    """3000 frames of 2 m, five drives: within 15 % on average and 35 % each (30 m: 200 lengths in a drive)."""
    drives = [driven(length, 3000, seed) for seed in range(5)]
    found = np.array([estimate_error_correlation(*each, max_distance_m=4 * length).length_m for each in drives])
    assert found.mean() == pytest.approx(length, rel=0.15)
    np.testing.assert_allclose(found, length, rtol=0.35)


def test_independent_errors_have_no_length():
    result = estimate_error_correlation(*driven(0.0, 3000, 0), max_distance_m=40.0)
    assert result.temperature(2.0) < 1.15
    assert np.abs(result.correlation).max() < 5 / np.sqrt(result.pairs.min())


@pytest.mark.parametrize("share", [0.05, 0.15])
def test_false_modes_do_not_hide_it(share):
    """Frames that are 30 standard deviations off, at random: the plain autocorrelation is lost, this one is not."""
    errors, travelled = driven(10.0, 4000, 1)
    rng = np.random.default_rng(2)
    false = rng.random(4000) < share
    errors[false] += rng.normal(0, 30, (int(false.sum()), 3)) * [0.8, 0.4, 0.02]
    result = estimate_error_correlation(errors, travelled, max_distance_m=40.0)
    assert result.length_m == pytest.approx(10.0, rel=0.3)
    assert result.set_apart == pytest.approx(share, abs=0.03)
    centred = errors - errors.mean(axis=0)
    plain = (centred[1:] * centred[:-1]).mean() / (centred**2).mean()
    assert plain < 0.2 < 0.6 < result.correlation[0]


def test_correlations_are_those_of_the_process_in_every_bin():
    result = estimate_error_correlation(*driven(10.0, 20_000, 3), max_distance_m=30.0, bins=15)
    np.testing.assert_allclose(result.correlation, np.exp(-result.distance_m / 10.0), atol=0.06)
    assert (np.diff(result.distance_m) > 0).all()
    assert result.temperature(5.0) == correlated_error_temperature(5.0, result.length_m)


def test_units_and_offsets_do_not_matter():
    errors, travelled = driven(10.0, 500, 4)
    a = estimate_error_correlation(errors, travelled, max_distance_m=30.0)
    b = estimate_error_correlation(errors * [100.0, 1.0, 57.0] + 3.0, travelled + 7.0, max_distance_m=30.0)
    assert a.length_m == pytest.approx(b.length_m)


def test_pairs_are_made_within_a_drive():
    """The same errors in ten drives of 200 m: with the drives told, the length; taken as one drive, still distances
    fall and that is refused."""
    parts = [driven(10.0, 100, seed) for seed in range(10)]
    errors = np.concatenate([part[0] for part in parts])
    travelled = np.concatenate([part[1] for part in parts])
    drives = np.repeat(np.arange(10), 100)
    result = estimate_error_correlation(errors, travelled, max_distance_m=30.0, drives=drives)
    assert result.length_m == pytest.approx(10.0, rel=0.35)
    with pytest.raises(SkyfixError, match="step back"):
        estimate_error_correlation(errors, travelled, max_distance_m=30.0)


@pytest.mark.parametrize("length", [0.5, 7.0, 90.0])
def test_an_exact_curve_is_fitted_exactly(length):
    distance = np.linspace(0.5, 40.0, 30)
    assert fit_correlation_length(distance, np.exp(-distance / length), np.ones(30)) == pytest.approx(length, rel=1e-3)
    assert fit_correlation_length(distance, np.full(30, -0.2), np.ones(30)) == 0.0


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_bounds_hold_the_mean_nees_as_often_as_they_say(rho):
    """4000 drives of 200 frames of autoregressive errors: 95 % of the means inside, to within 1.5 points."""
    rng = np.random.default_rng(5)
    errors = np.empty((200, 4000, 3))
    errors[0] = rng.standard_normal((4000, 3))
    for i in range(1, 200):
        errors[i] = rho * errors[i - 1] + np.sqrt(1 - rho**2) * rng.standard_normal((4000, 3))
    means = (errors**2).sum(axis=2).mean(axis=0)
    low, high = mean_nees_bounds(200, 3, 0.95, rho)
    assert ((means > low) & (means < high)).mean() == pytest.approx(0.95, abs=0.015)
    if rho:
        low, high = mean_nees_bounds(200, 3)
        assert ((means > low) & (means < high)).mean() < 0.75  # taken for independent, they are not


def test_bounds_without_correlation_are_chi_square_s():
    low, high = mean_nees_bounds(50, 3)
    assert (low, high) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 150) / 50))
    assert low < 3.0 < high


def test_nis_of_a_consistent_prediction_is_the_dimension():
    rng = np.random.default_rng(6)
    predicted, measured = np.diag([2.0, 1.0, 0.1]) ** 2, np.diag([0.5, 0.7, 0.05]) ** 2
    innovations = rng.multivariate_normal(np.zeros(3), predicted + measured, 3000)
    many = (np.repeat(each[None], 3000, axis=0) for each in (predicted, measured))
    low, high = mean_nees_bounds(3000, 3, 0.999)
    assert low < nis(innovations, *many).mean() < high


def tracked(handled, seed, rho=0.9, steps=400):
    """NEES per degree of freedom of a filter on emulated measurements whose errors repeat from frame to frame."""
    profile = ErrorProfile("emulated Gaussian", (0.8, 0.8, 0.03), (0.8, 0.8, 0.03), 0.0)
    rng = np.random.default_rng(seed)
    motion = np.diag([0.05, 0.05, 0.002]) ** 2
    emulator = LikelihoodEmulator(profile, seed, EmulatorSettings(step_correlation=rho))
    temperature = (1.0 + rho) / (1.0 - rho) if handled else 1.0
    truth = np.zeros(3)
    particles = ParticleFilter(rng.multivariate_normal(truth, np.diag([0.8, 0.8, 0.03]) ** 2, 600), seed)
    errors, covariances = [], []
    for step in range(steps):
        delta = np.array([0.5, 0.0, 0.05])
        truth = se2.compose(truth, delta + rng.multivariate_normal(np.zeros(3), motion))
        particles.predict(OdometryIncrement(step, delta, motion))
        particles.update(emulator.measure(truth), temperature if step else 1.0)
        if step >= 50:
            estimate = particles.estimate(step)
            error = estimate.pose - truth
            error[2] = se2.wrap(error[2])
            errors.append(error)
            covariances.append(estimate.covariance)
    return nees(np.array(errors), np.array(covariances)).mean() / 3


def test_repeating_errors_are_put_right_in_a_filter():
    """Correlation 0.9 from step to step, four fixed seeds of 400 steps: NEES per degree of freedom in [0.8, 1.25]."""
    assert 0.8 <= np.mean([tracked(True, seed) for seed in range(4)]) <= 1.25
    assert np.mean([tracked(False, seed) for seed in range(1)]) > 3.0


def test_the_emulator_s_correlation_is_found_again():
    """Emulated TransLocNet with a length of 12 m, tails and all: within 30 %."""
    emulator = LikelihoodEmulator(TRANSLOCNET_KITTI, 7, EmulatorSettings(correlation_length_m=12.0))
    truth = np.array([5.0, 5.0, 1.0])
    answers = np.array([emulator.measure(truth, 2.0).answer for _ in range(4000)])
    errors = se2.between(truth[None], answers)
    result = estimate_error_correlation(errors[:, :2], 2.0 * np.arange(4000), max_distance_m=40.0)
    assert result.length_m == pytest.approx(12.0, rel=0.3)


def test_bad_input_is_refused_in_one_line():
    errors, travelled = driven(5.0, 100, 8)
    for word, call in {
        "travelled": lambda: estimate_error_correlation(errors, travelled[1:], max_distance_m=10.0),
        "errors: expected finite": lambda: estimate_error_correlation(errors * np.nan, travelled, max_distance_m=10.0),
        "drives": lambda: estimate_error_correlation(errors, travelled, max_distance_m=10.0, drives=[1, 2]),
        "max_distance_m": lambda: estimate_error_correlation(errors, travelled, max_distance_m=0.0),
        "bins": lambda: estimate_error_correlation(errors, travelled, max_distance_m=1.0, bins=0),
        "outlier_sigmas": lambda: estimate_error_correlation(errors, travelled, max_distance_m=1.0, outlier_sigmas=0.0),
        "20 frames": lambda: estimate_error_correlation(errors[:10], travelled[:10], max_distance_m=10.0),
        "20 pairs": lambda: estimate_error_correlation(errors, 100.0 * travelled, max_distance_m=1e-3),
        "weights": lambda: fit_correlation_length([1.0], [0.5], [0.0]),
        "some > 0": lambda: fit_correlation_length([0.0], [0.5], [1.0]),
        "count": lambda: mean_nees_bounds(0, 3),
        "level": lambda: mean_nees_bounds(5, 3, 1.0),
        "correlation": lambda: mean_nees_bounds(5, 3, 0.95, 1.0),
        "predicted": lambda: nis(np.zeros((2, 3)), np.zeros((1, 3, 3)), np.zeros((2, 3, 3))),
        "positive definite": lambda: nis(np.zeros((1, 3)), np.zeros((1, 3, 3)), np.zeros((1, 3, 3))),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
