"""Smoothing over a recovery: paths jump where the filter drew particles anew, exactly as often as its mixture says."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chisquare, multivariate_normal

from fusion import (
    CloudHistory,
    GaussianLikelihood,
    GridFilter,
    GridFilterSettings,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    ParticleSmootherSettings,
    UniformPrior,
    UpdateReport,
    sample_paths,
    se2,
    smooth_on_grid,
)

FLOOR = np.diag([0.01, 0.01, 0.0005]) ** 2
GRID = MapGrid(48, 96, 0.25, -12.0, -6.0)
NOISE = np.diag([0.3, 0.2, 0.08]) ** 2
MEASURED = np.diag([0.6, 0.5, 0.2]) ** 2
HALF = np.array([0.5, 0.0, 0.0])


@dataclass
class Cloud:
    particles: np.ndarray
    log_weights: np.ndarray


@pytest.mark.parametrize("rejections", [0, 50], ids=["exact", "rejection"])
def test_a_step_back_is_the_mixture_of_odometry_and_jump(rejections):
    """40,000 paths over five particles: chances in proportion to w (p(y | x) + j); at half or twice j it would fail."""
    rng = np.random.default_rng(3)
    before = np.column_stack([rng.normal(0.0, 1.0, (5, 2)), rng.normal(0.0, 0.2, 5)])
    weights, y, delta = rng.dirichlet(np.full(5, 3.0)), np.array([[1.0, 0.4, 0.1]]), np.array([1.0, 0.0, 0.0])
    covariance = np.diag([0.7, 0.8, 0.3]) ** 2
    off = se2.between(before, np.repeat(y, 5, axis=0)) - delta
    by_odometry = multivariate_normal(np.zeros(3), covariance + FLOOR).pdf(off)
    jump = float(weights @ by_odometry)  # every second path jumps
    history = CloudHistory()
    history.record(Cloud(before, np.log(weights)), 0)
    history.move(OdometryIncrement(1, delta, covariance))
    report = UpdateReport(0.0, 1.0, injected=1, log_jump_density=float(np.log(jump)))
    history.record(Cloud(y, np.zeros(1)), 1, report)
    count = 40_000
    drawn = sample_paths(history, 1, ParticleSmootherSettings(count, rejections), all_stamps=False)
    found = np.abs(drawn.paths[:, 0, None] - before).sum(axis=2).argmin(axis=1)
    observed = np.bincount(found, minlength=5)

    def expected(density):
        chances = weights * (by_odometry + density)
        return count * chances / chances.sum()

    assert chisquare(observed, expected(jump)).pvalue > 1e-3
    assert chisquare(observed, expected(0.5 * jump)).pvalue < 1e-6
    assert chisquare(observed, expected(2.0 * jump)).pvalue < 1e-6
    assert abs(drawn.jumped.mean() - 0.5) < 5 * 0.5 / np.sqrt(count)


def test_a_kidnapping_is_smoothed_as_the_exact_grid_smoother_does_each_part():
    """A drive that is carried 12 m away: before and after it, means within 0.2 standard deviations, variances 25 %.

    The exact posterior falls in two when the jump is certain: the drive before it, and the drive after it from a pose
    anywhere. Without jumps the paths would end before the kidnapping at whichever particle was nearest to the place
    after it.
    """
    measured = np.array([[-8.0, 0.0, 0.0], [-7.5, 0.4, 0.2], [5.5, -0.3, 0.1], [7.0, 0.2, -0.1]])
    likelihoods = [GaussianLikelihood(one, MEASURED, GRID) for one in measured]
    prior = UniformPrior(np.array([-8.0, 0.0, 0.0]), 2.0, 0.6)
    settings = ParticleFilterSettings(outlier_probability=1e-4, kidnap_probability=0.05, injection_share=0.5)
    history, reports = CloudHistory(), []
    particles = ParticleFilter.from_prior(prior, 6000, 2, replace(settings, regularisation=0.0))
    for node, likelihood in enumerate(likelihoods):
        for half in range(2) if node else ():
            step = OdometryIncrement(2 * node - 1 + half, HALF, 0.5 * NOISE)
            particles.predict(step)
            history.move(step)
        reports.append(particles.update(likelihood))
        history.record(particles, 2 * node, reports[-1])
    assert [report.injected > 0 for report in reports] == [False, False, True, False]
    assert [np.isfinite(report.log_jump_density) for report in reports] == [False, False, True, False]
    drawn = sample_paths(history, 5, ParticleSmootherSettings(1500))
    assert drawn.jumped.mean(axis=0).tolist() == [0.0, 1.0, 0.0]
    trajectory = drawn.trajectory()

    exact = GridFilterSettings(outlier_probability=1e-4, kidnap_probability=0.0)
    everywhere = UniformPrior(np.array([0.0, 0.0, 0.0]), 12.0, np.pi)
    step = [OdometryIncrement(1, 2.0 * HALF, NOISE)]
    for first, start in ((0, prior), (2, everywhere)):
        grid_filter = GridFilter.from_prior(start, GRID, 72, exact)
        expected = smooth_on_grid(grid_filter, 0, step, likelihoods[first : first + 2]).trajectory
        for node in range(2):
            covariance = expected.covariances[node]
            sigma = np.sqrt(np.diag(covariance))
            at = 2 * (first + node)
            off = (trajectory.poses[at] - expected.poses[node]) / sigma
            assert (np.abs(off) < 0.2).all(), (at, off)
            ratio = np.diag(trajectory.covariances[at]) / sigma**2
            assert (np.abs(ratio - 1.0) < 0.25).all(), (at, ratio)
    # between the records a path drives on, and jumps at the measurement
    driven = drawn.paths[:, 3] - drawn.paths[:, 2]
    assert abs(driven[:, 0].mean() - 0.5) < 0.05
    assert np.abs(driven[:, 0] - 0.5).max() < 6 * np.sqrt(0.5 * NOISE[0, 0])


def test_a_history_without_reports_never_jumps():
    history = CloudHistory()
    history.record(Cloud(np.zeros((3, 3)), np.zeros(3)), 0)
    history.move(OdometryIncrement(1, HALF, NOISE))
    history.record(Cloud(np.full((3, 3), 5.0), np.zeros(3)), 1)
    assert not sample_paths(history, 0, ParticleSmootherSettings(20)).jumped.any()


def test_records_at_one_stamp_add_their_chances_to_jump():
    history = CloudHistory()
    history.record(Cloud(np.zeros((3, 3)), np.zeros(3)), 0)
    history.move(OdometryIncrement(1, HALF, NOISE))
    for density in (0.25, 0.5):
        report = UpdateReport(0.0, 1.0, injected=1, log_jump_density=float(np.log(density)))
        history.record(Cloud(np.zeros((3, 3)), np.zeros(3)), 1, report)
    history.record(Cloud(np.zeros((3, 3)), np.zeros(3)), 1)
    assert history.clouds[1].jump_density == pytest.approx(0.75)
