"""The grid filter: Bayes' rule cell by cell, agreement with other filters, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from fusion import (
    GaussianLikelihood,
    GridFilter,
    GridFilterSettings,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    OdometryNoise,
    ParticleFilter,
    ParticleFilterSettings,
    PoseLattice,
    SkyfixError,
    UniformPrior,
    se2,
)
from fusion.grids.grid_lookup import look_up
from fusion.grids.scratch import Scratch

GRID = MapGrid(41, 61, 0.5, -15.0, -10.0)
PLAIN = GridFilterSettings(outlier_probability=1e-9, kidnap_probability=0.0)


def increment(delta, covariance, stamp=1):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), np.asarray(covariance, dtype=float))


def odometry(delta, seconds=0.1):
    return increment(delta, OdometryNoise().covariance(delta, seconds))


def poses_of(lattice):
    return np.concatenate([lattice.poses(plane) for plane in range(lattice.shape[0])])


def volume(scores=None, bins=36, grid=GRID, seed=0):
    if scores is None:
        scores = np.random.default_rng(seed).normal(0, 2, (grid.rows, grid.cols, bins))
    return LikelihoodVolume.from_scores(scores, grid)


# --- update --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid", [GRID, MapGrid(30, 50, 0.7, -11.3, -14.0), MapGrid(80, 90, 0.21, -9.0, -8.0)])
@pytest.mark.parametrize("probability", [0.0, 0.05])
def test_the_compiled_lookup_is_the_likelihood_s_own(grid, probability):
    measurement = volume(bins=24).with_outliers(probability)
    lattice = PoseLattice(grid, np.random.default_rng(3).uniform(-0.5, 0.5, (10, 2)), turned=0.4)
    found = look_up(measurement, lattice, np.empty(lattice.shape, dtype=np.float32), Scratch())
    expected = measurement.log_density(poses_of(lattice))
    np.testing.assert_allclose(np.log(found.weights.ravel()) + found.log_scale, expected, atol=1e-5)
    far = measurement.log_density([[1e6, 0.0, 0.0]])[0]
    assert found.outside == pytest.approx(np.exp(far - found.log_scale), rel=1e-5)


def test_an_update_is_bayes_rule_cell_by_cell():
    settings_ = GridFilterSettings(outlier_probability=0.1, kidnap_probability=0.02)
    rng = np.random.default_rng(4)
    prior = rng.random((12, GRID.rows, GRID.cols))
    started = GridFilter(prior, GRID, settings_, outside=0.1 * prior.sum())
    measurement = volume(bins=12)
    report = started.update(measurement, temperature=2.0)
    prior = prior / prior.sum()
    used = measurement.tempered(2.0).with_outliers(0.1)
    likelihood = np.exp(used.log_density(poses_of(started.lattice))).reshape(prior.shape)
    joint = (0.98 * prior / 1.1 + 0.02 / prior.size) * likelihood
    outside = 0.98 * 0.1 / 1.1 * np.exp(used.log_density([[1e6, 0.0, 0.0]])[0])
    assert report.log_evidence == pytest.approx(np.log(joint.sum() + outside), abs=1e-5)
    posterior = joint / (joint.sum() + outside)
    assert 0.5 * np.abs(started.probabilities - posterior).sum() < 1e-6
    assert report.lost_score == pytest.approx(outside / (joint.sum() + outside), rel=1e-4)
    share = posterior / posterior.sum()
    assert report.effective_sample_size == pytest.approx(1.0 / (share**2).sum(), rel=1e-4)


class Kalman:
    """Linear Gaussian filter of (x, y, yaw) along +x: exact as long as headings stay near zero."""

    def __init__(self, mean, covariance):
        self.mean, self.covariance = np.array(mean, dtype=float), covariance

    def predict(self, delta, noise):
        jacobian = np.eye(3)
        jacobian[1, 2] = delta[0]
        self.mean = jacobian @ self.mean + delta
        self.covariance = jacobian @ self.covariance @ jacobian.T + noise

    def update(self, measured, noise):
        spread = self.covariance + noise
        innovation = measured - self.mean
        gain = self.covariance @ np.linalg.inv(spread)
        self.mean = self.mean + gain @ innovation
        self.covariance = self.covariance - gain @ self.covariance
        return -0.5 * (innovation @ np.linalg.solve(spread, innovation) + np.linalg.slogdet(2 * np.pi * spread)[1])


def test_the_filter_is_the_kalman_filter_where_that_is_exact():
    """6 steps, coupled noise: means to 0.5 % of a deviation, covariances to 0.3 %, evidence to 0.005 nats in all."""
    grid, bins = MapGrid(32, 40, 0.25, -4.0, -3.5), 144  # bins of 2.5 degrees
    start, spread = np.zeros(3), np.diag([0.6, 0.5, 0.05]) ** 2
    measured_noise = np.array([[0.3, 0.05, 0.0], [0.05, 0.25, 0.004], [0.0, 0.004, 0.0025]])
    delta, noise = np.array([0.43, 0.0, 0.0]), np.diag([0.3, 0.25, 0.045]) ** 2
    noise[1, 2] = noise[2, 1] = 0.5 * delta[0] * noise[2, 2]
    rng = np.random.default_rng(0)
    first = GaussianLikelihood(start, spread, grid)
    started = GridFilter.from_density(first, grid, bins, PLAIN)
    kalman, expected, evidence = Kalman(start, spread), 0.0, 0.0
    for step in range(6):
        kalman.predict(delta, noise)
        started.predict(increment(delta, noise, step))
        measured = np.array([0.43 * (step + 1), 0.1, 0.0]) + rng.multivariate_normal(np.zeros(3), measured_noise)
        expected += kalman.update(measured, measured_noise)
        evidence += started.update(GaussianLikelihood(measured, measured_noise, grid)).log_evidence
    estimate = started.estimate(0, max_modes=3)
    sigma = np.sqrt(np.diag(kalman.covariance))
    assert (np.abs(estimate.pose - kalman.mean) < 0.005 * sigma).all()
    np.testing.assert_allclose(
        estimate.covariance / np.outer(sigma, sigma), kalman.covariance / np.outer(sigma, sigma), atol=0.003
    )
    assert evidence == pytest.approx(expected, abs=0.005)
    assert len(estimate.modes) == 1
    assert (np.abs(estimate.modes.means[0] - kalman.mean) < 0.01 * sigma).all()


# --- beside the particle filter ------------------------------------------------------------------------------------

_COARSE = [np.linspace(-12, 12, 9), np.linspace(-8, 8, 7), np.linspace(-np.pi, np.pi, 13)]


def two_streets():
    """A likelihood with two peaks of unlike size over clutter."""
    x, y = GRID.centres()
    yaw = 2 * np.pi * np.arange(36) / 36
    scores = np.full((GRID.rows, GRID.cols, 36), -9.0)
    for x0, y0, yaw0, height in ((4.0, 2.0, 0.4, 0.0), (-5.0, -3.0, 0.9, -0.5)):
        squared = (x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2
        scores = np.logaddexp(scores, height - squared / 4.0 + (np.cos(yaw - yaw0) - 1.0) / 0.3**2)
    return volume(scores)


def multimodal_drive(one):
    """Two measurements that cannot tell two places apart; histogram over coarse cells and ln evidence."""
    evidence = 0.0
    for step in range(2):
        one.predict(increment([0.8, 0.1, 0.05], np.diag([0.4, 0.3, 0.12]) ** 2, step))
        evidence += one.update(two_streets()).log_evidence
    return evidence


def test_particles_converge_to_the_grid_on_a_multimodal_posterior():
    """Total variation over coarse cells falls as N^-1/2 over two decades; the evidence is the same within its noise.

    That is of particles that are never drawn from a measurement; where they are, 300 are nearer.
    """
    fine = MapGrid(2 * GRID.rows, 2 * GRID.cols, 0.25, GRID.x0, GRID.y0)
    prior = UniformPrior(np.array([0.0, 0.0, 0.5]), 7.0, 1.0)
    started = GridFilter.from_prior(prior, fine, 72, GridFilterSettings(kidnap_probability=0.0))
    exact = multimodal_drive(started)
    poses, weights = poses_of(started.lattice), started.probabilities.ravel().astype(float)
    # a cell is a small box: spread its mass over it, so that the coarse cells' borders do not matter
    offsets = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * 0.5 * started.lattice.cell
    spread = (poses[:, None] + offsets).reshape(-1, 3)
    spread[:, 2] = se2.wrap(spread[:, 2])
    reference, _ = np.histogramdd(spread, _COARSE, weights=np.repeat(weights, len(offsets)) / len(offsets))
    counts, seeds, variation, found = np.array([300, 3_000, 30_000]), 6, [], []
    plain = ParticleFilterSettings(injection_share=0.0, regularisation=0.0, guided_below=0.0)

    def compared(count, seed, settings_=plain):
        particles = ParticleFilter.from_prior(prior, count, seed, settings_)
        evidence = multimodal_drive(particles)
        cloud, _ = np.histogramdd(particles.particles, _COARSE, weights=np.exp(particles.log_weights))
        return 0.5 * np.abs(cloud - reference).sum(), evidence - exact

    for count in counts:
        rows = np.array([compared(count, seed) for seed in range(seeds)])
        variation.append(rows[:, 0].mean())
        found.append(rows[:, 1])
    guided = np.array([compared(300, seed, replace(plain, guided_below=50.0)) for seed in range(seeds)])
    assert guided[:, 0].mean() < 0.75 * variation[0]
    assert abs(guided[:, 1].mean()) < abs(found[0].mean()) + 4 * guided[:, 1].std(ddof=1) / np.sqrt(seeds)
    exponent = np.polyfit(np.log(counts), np.log(variation), 1)[0]
    assert abs(exponent + 0.5) < 0.1
    assert variation[-1] < 0.04
    assert abs(found[-1].mean()) < 4 * found[-1].std(ddof=1) / np.sqrt(seeds) + 2e-3
    assert found[-1].std() < 0.06
    modes = started.estimate(0, max_modes=2).modes
    assert modes.weights[0] > modes.weights[1] > 0.1


def test_a_wrong_start_is_left_after_a_few_measurements():
    """No pose is ruled out: without any kidnapping, consistent measurements elsewhere win."""
    started = GridFilter.from_prior(UniformPrior(np.array([-8.0, -5.0, 0.0]), 1.0, 0.2), GRID, 24, PLAIN)
    there = GaussianLikelihood(np.array([8.0, 5.0, 1.0]), np.diag([0.7, 0.7, 0.2]) ** 2, GRID)
    settled = [started.update(there).log_evidence for _ in range(12)][-1]
    estimate = started.estimate(0)
    np.testing.assert_allclose(estimate.pose, [8.0, 5.0, 1.0], atol=0.05)
    assert settled > -2.0


# --- edges ---------------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 5), st.integers(1, 4), st.integers(1, 4), st.floats(3.0, 50.0), st.integers(0, 2**31))
def test_tiny_grids_stay_finite(headings, rows, cols, metres, seed):
    rng = np.random.default_rng(seed)
    grid = MapGrid(rows, cols, metres, -3.0, 5.0)
    started = GridFilter(rng.random((headings, rows, cols)) + 1e-3, grid)
    measurement = LikelihoodVolume.from_scores(rng.normal(0, 5, (rows, cols, 4)), grid)
    for step in range(4):
        started.predict(odometry(rng.normal(0, [1.0, 0.3, 0.4])))
        report = started.update(measurement, temperature=float(rng.uniform(0.5, 4.0)))
        estimate = started.estimate(step, max_modes=2)
        assert np.isfinite([report.log_evidence, report.effective_sample_size]).all()
        assert np.isfinite(estimate.pose).all()
        assert np.linalg.eigvalsh(estimate.covariance).min() > 0.0
        total = started.probabilities.sum(dtype=float) + started.outside_probability
        assert total == pytest.approx(1.0, abs=1e-5)


def test_mean_and_covariance_are_those_of_the_weighted_cells():
    started = GridFilter(np.random.default_rng(6).random((8, GRID.rows, GRID.cols)) ** 40, GRID)
    started.predict(increment([0.3, 0.2, 0.4], np.zeros((3, 3))))
    mean, covariance = se2.weighted_mean_and_covariance(poses_of(started.lattice), started.probabilities.ravel())
    estimate = started.estimate(3)
    np.testing.assert_allclose(estimate.pose, mean, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance, covariance, atol=1e-5)
    assert estimate.stamp_ns == 3
    assert estimate.modes is None


def test_a_single_cell_is_as_uncertain_as_its_inside():
    mass = np.zeros((24, GRID.rows, GRID.cols))
    mass[5, 10, 20] = 1.0
    covariance = GridFilter(mass, GRID).estimate(0).covariance
    np.testing.assert_allclose(covariance, np.diag([0.5, 0.5, np.pi / 12]) ** 2 / 12, rtol=1e-6, atol=1e-12)


def test_a_prior_s_box_is_shared_exactly_among_cells():
    prior = UniformPrior(np.array([-15.0, 3.1, 3.0]), 2.3, 0.4)
    started = GridFilter.from_prior(prior, GRID, 18)
    assert started.outside_probability == pytest.approx(0.5)  # half of it lies west of the map
    pose = started.estimate(0).pose
    np.testing.assert_allclose(pose, [-15.0 + 1.15, 3.1, 3.0], atol=2e-2)
    full = GridFilter.from_prior(UniformPrior(np.zeros(3), 3.0, np.pi), GRID, 18)
    by_heading = full.probabilities.sum(axis=(1, 2))
    np.testing.assert_allclose(by_heading, 1 / 18, rtol=1e-5)


def test_same_run_twice_is_the_same_bit_for_bit():
    def run():
        started = GridFilter.from_prior(UniformPrior(np.zeros(3), 5.0, 1.0), GRID, 24)
        for step in range(3):
            started.predict(odometry([0.5, 0.0, 0.1]))
            started.update(volume(seed=step, bins=24))
        return started.probabilities

    np.testing.assert_array_equal(run(), run())


class Broken(GaussianLikelihood):
    """Gives what a diverged network gives."""

    __slots__ = ()
    value = np.nan

    def tempered(self, temperature):
        return self

    def with_outliers(self, probability):
        return self

    def log_density(self, poses):
        return np.full(len(poses), self.value)


class Impossible(Broken):
    """Rules every pose out."""

    __slots__ = ()
    value = -np.inf


class Elsewhere(Broken):
    """Finite, but rules out all that was believed: e^-1000 but for poses far north."""

    __slots__ = ()

    def log_density(self, poses):
        return np.where(np.asarray(poses)[:, 1] > 8.0, 0.0, -1000.0)


@pytest.mark.parametrize("kind", [Broken, Impossible, Elsewhere])
def test_a_bad_likelihood_leaves_the_filter_as_it_was(kind):
    started = GridFilter.from_prior(UniformPrior(np.zeros(3), 2.0, 1.0), GRID, 12, PLAIN)
    started.update(volume(bins=12))
    before, estimate = started.probabilities, started.estimate(0)
    with pytest.raises(SkyfixError, match="likelihood: expected") as caught:
        started.update(kind(np.zeros(3), np.eye(3), GRID))
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(started.probabilities, before)
    assert started.estimate(0).log_evidence == estimate.log_evidence


def test_bad_input_is_one_line():
    started = GridFilter.from_prior(UniformPrior(np.zeros(3), 2.0, 1.0), GRID, 12)
    before = started.probabilities
    for word, call in {
        "outlier_probability: expected in": lambda: GridFilterSettings(outlier_probability=0.0),
        "kidnap_probability: expected in": lambda: GridFilterSettings(kidnap_probability=1.0),
        "mass: expected .K, 41, 61.": lambda: GridFilter(np.ones((3, 4, 5)), GRID),
        "mass: expected finite": lambda: GridFilter(np.full((3, 41, 61), np.nan), GRID),
        "mass: expected non-negative": lambda: GridFilter(np.zeros((3, 41, 61)), GRID),
        "mass: expected non-negative with": lambda: GridFilter(np.zeros((0, 41, 61)), GRID),
        "outside: expected": lambda: GridFilter(np.ones((3, 41, 61)), GRID, outside=-1.0),
        "headings: expected at least 1": lambda: PoseLattice.of(GRID, 0),
        "lattice: expected headings": lambda: PoseLattice(GRID, np.zeros((3, 2)), np.nan),
        "prior: expected a box that touches": lambda: GridFilter.from_prior(
            UniformPrior(np.array([99.0, 0.0, 0.0]), 1.0, 1.0), GRID, 12
        ),
        "temperature: expected > 0": lambda: started.update(volume(), temperature=-1.0),
        "increment: expected deviations within": lambda: started.predict(increment(np.zeros(3), np.eye(3) * 1e6)),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(started.probabilities, before)


def test_evidence_of_a_uniform_measurement_is_that_of_the_crop():
    started = GridFilter.from_prior(UniformPrior(np.zeros(3), 2.0, 1.0), GRID, 12)
    before = started.probabilities
    report = started.update(volume(np.zeros((GRID.rows, GRID.cols, 12)), bins=12))
    assert report.log_evidence == pytest.approx(-np.log(GRID.area_m2 * 2 * np.pi), abs=1e-5)
    kept = (1 - started.settings.kidnap_probability) * before + started.settings.kidnap_probability / before.size
    np.testing.assert_allclose(started.probabilities, kept, rtol=1e-5)
    assert logsumexp(np.log(kept)) == pytest.approx(0.0, abs=1e-5)
