"""Particles while the start is found: the posterior of all measurements so far, in closed form where there is one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion import se2
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from sequences.start_cloud import StartCloud

GRID = MapGrid(160, 160, 0.5, -40.0, -40.0)
BINS = 72


def gaussian(x: float, y: float, yaw: float, sigma_m: float, sigma_rad: float) -> NDArray[np.float64]:
    """Density (rows, cols, bins) on the grid, not normalised."""
    columns, rows = GRID.centres()
    headings = np.arange(BINS) * 2.0 * np.pi / BINS
    squared = ((columns[None, :, None] - x) ** 2 + (rows[:, None, None] - y) ** 2) / sigma_m**2
    return np.exp(-0.5 * (squared + (se2.wrap(headings - yaw) / sigma_rad) ** 2)) / (sigma_m**2 * sigma_rad)


def volume(density: NDArray[np.float64]) -> LikelihoodVolume:
    return LikelihoodVolume.from_scores(np.log(density + 1e-30), GRID)


def mean_and_covariance(cloud: NDArray[np.float64], log_weights: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    return se2.weighted_mean_and_covariance(cloud, np.exp(log_weights - log_weights.max()))


def test_after_one_measurement_it_is_the_likelihood_cut_to_the_box() -> None:
    prior = UniformPrior(np.zeros(3), 4.0, 0.5)
    start = StartCloud(prior, 20_000, 0.1, np.random.default_rng(0))
    cloud, log_weights = start.add(volume(gaussian(4.0, -1.0, 0.0, 2.0, 0.2)), None)
    weights = np.exp(log_weights) / np.exp(log_weights).sum()
    assert cloud.shape == (20_000, 3)
    assert weights[~prior.contains(cloud)].sum() < 1e-100
    # Cut at its mean, 4, the likelihood's x is half a normal; an outlier is thousands of times less likely here.
    assert weights @ cloud[:, 0] == pytest.approx(4.0 - 2.0 * np.sqrt(2.0 / np.pi), abs=0.06)


def test_a_likelihood_that_lies_elsewhere_leaves_the_box() -> None:
    prior = UniformPrior(np.zeros(3), 5.0, 0.5)
    start = StartCloud(prior, 2000, 0.05, np.random.default_rng(0))
    cloud, log_weights = start.add(volume(gaussian(38.0, 38.0, 2.0, 0.3, 0.1)), None)
    weights = np.exp(log_weights - log_weights.max())
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert effective > 350  # the box's share of 2000
    assert prior.contains(cloud[weights > 1e-9]).all()


def test_several_measurements_combine_as_gaussians_do() -> None:
    sigmas, odometry_sigma = np.array([2.0, 1.5, 2.5]), 0.8
    centres = np.array([0.0, 11.0, 19.0])  # of x; the odometry says 10 m each
    prior = UniformPrior(np.zeros(3), 18.0, 0.6)
    start = StartCloud(prior, 60_000, 0.001, np.random.default_rng(1))
    motion = OdometryIncrement(1, np.array([10.0, 0.0, 0.0]), np.diag([odometry_sigma**2, 1e-4, 1e-6]))
    for number, (centre, sigma) in enumerate(zip(centres, sigmas, strict=True)):
        cloud, log_weights = start.add(volume(gaussian(centre, 0.0, 0.0, sigma, 0.15)), motion if number else None)
    mean, covariance = mean_and_covariance(cloud, log_weights)
    expected, variance = centres[0], sigmas[0] ** 2  # a Kalman filter along x
    for centre, sigma in zip(centres[1:], sigmas[1:], strict=True):
        expected, variance = expected + 10.0, variance + odometry_sigma**2
        gain = variance / (variance + sigma**2)
        expected, variance = expected + gain * (centre - expected), (1.0 - gain) * variance
    assert mean[0] == pytest.approx(expected, abs=0.12)
    assert covariance[0, 0] == pytest.approx(variance, rel=0.12)
    assert abs(mean[1]) < 0.15
    assert abs(mean[2]) < 0.03


def test_two_measurements_outvote_a_first_one_that_was_wrong() -> None:
    prior = UniformPrior(np.zeros(3), 20.0, np.pi)
    start = StartCloud(prior, 5000, 0.05, np.random.default_rng(2))
    motion = OdometryIncrement(1, np.array([12.0, 0.0, 0.0]), np.diag([0.04, 0.04, 1e-4]))
    start.add(volume(gaussian(-9.0, 6.0, np.pi, 0.7, 0.05) + 1e-4 * gaussian(3.0, -4.0, 0.2, 0.7, 0.05)), None)
    truth = np.array([3.0, -4.0, 0.2])
    for _ in range(2):
        truth = se2.compose(truth, motion.delta)
        cloud, log_weights = start.add(
            volume(gaussian(*truth, 0.7, 0.05) + gaussian(-9.0, -9.0, 1.0, 0.7, 0.05)), motion
        )
    mean, covariance = mean_and_covariance(cloud, log_weights)
    assert len(start) == 3
    assert np.hypot(*(mean - truth)[:2]) < 0.5
    assert abs(se2.wrap(mean[2] - truth[2])) < 0.05
    assert np.sqrt(np.diag(covariance)).max() < 1.0


def test_a_sharp_place_gets_the_share_of_what_the_likelihood_integrates_to() -> None:
    """Poses are drawn from whole cells, and the density between them is interpolated: a sharp peak tells them apart."""
    grid, bins = MapGrid(60, 60, 1.0, -30.0, -30.0), 72
    x, y = grid.centres()
    headings = np.arange(bins) * 2.0 * np.pi / bins

    def place(east: float, sigma_m: float, sigma_rad: float) -> NDArray[np.float64]:
        squared = ((x[None, :, None] - east) ** 2 + (y[:, None, None] - 0.5) ** 2) / sigma_m**2
        density = np.exp(-0.5 * (squared + (se2.wrap(headings) / sigma_rad) ** 2))
        return density / density.sum()

    both = place(-15.5, 0.5, 0.052) + place(15.5, 3.0, 0.26)
    likelihood = LikelihoodVolume.from_scores(np.log(both + 1e-13), grid)
    prior = UniformPrior(np.zeros(3), 30.0, np.pi)
    mixture, rng = likelihood.with_outliers(0.05), np.random.default_rng(1)

    def mass(east: float, half_m: float, half_rad: float) -> float:
        box = UniformPrior(np.array([east, 0.5, 0.0]), half_m, half_rad)
        poses = box.sample(1_000_000, rng)
        return float(np.exp(mixture.log_density(poses) - box.log_density(poses)).mean())

    sharp, broad = mass(-15.5, 4.0, 0.5), mass(15.5, 14.0, 3.1)
    cloud, log_weights = StartCloud(prior, 40_000, 0.05, np.random.default_rng(0)).add(likelihood, None)
    weights = np.exp(log_weights - log_weights.max())
    is_sharp = UniformPrior(np.array([-15.5, 0.5, 0.0]), 4.0, 0.5).contains(cloud)
    is_broad = UniformPrior(np.array([15.5, 0.5, 0.0]), 14.0, 3.1).contains(cloud)
    share = weights[is_sharp].sum() / weights[is_sharp | is_broad].sum()
    assert share == pytest.approx(sharp / (sharp + broad), abs=0.01)  # by the interpolated density: 0.2 more
