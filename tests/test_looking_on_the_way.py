"""Whoever looks at a filter on a long drive changes nothing and sees what is there, wherever the drive has got to.

Particles are kept relative to an anchor that follows them: 700 m pass it on ten times.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fusion import (
    CloudHistory,
    GaussianLikelihood,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    OdometryNoise,
    ParticleFilter,
    ParticleFilterSettings,
    PoseLikelihood,
    Tracker,
    UniformPrior,
    se2,
)
from fusion.arrays import FloatArray

STEP_M, STEPS = 7.0, 100
COVARIANCE = np.diag([0.25, 0.25, np.deg2rad(1.0) ** 2])
CITY = MapGrid(rows=1800, cols=1800, metres_per_pixel=0.5, x0=-100.0, y0=-100.0)


def drive() -> tuple[FloatArray, list[OdometryIncrement], list[PoseLikelihood]]:
    """700 m to the north-east in a gentle curve; odometry with noise, and volumes and Gaussians in turn."""
    rng, noise, delta = np.random.default_rng(5), OdometryNoise(), np.array([STEP_M, 0.0, 0.006])
    truth = [np.array([3.0, -2.0, 0.4])]
    increments = []
    for step in range(1, STEPS):
        truth.append(se2.compose(truth[-1], delta))
        covariance = noise.covariance(delta, 1.0)
        moved = delta + rng.multivariate_normal(np.zeros(3), covariance)
        increments.append(OdometryIncrement(step * 10**9, moved, covariance))
    seen = [rng.multivariate_normal(pose, COVARIANCE) for pose in truth]
    return np.array(truth), increments, [volume(s) if k % 2 else gaussian(s) for k, s in enumerate(seen)]


def gaussian(seen: FloatArray) -> PoseLikelihood:
    return GaussianLikelihood(seen, COVARIANCE, CITY)


def volume(seen: FloatArray) -> PoseLikelihood:
    crop = CITY.window(seen[:2], half_extent_m=12.0)
    x, y = crop.centres()
    squared = (x[None, :, None] - seen[0]) ** 2 + (y[:, None, None] - seen[1]) ** 2
    turned = np.cos(2 * np.pi * np.arange(180) / 180 - seen[2]) - 1.0
    return LikelihoodVolume.from_scores(-0.5 * squared / 0.25 + turned / COVARIANCE[2, 2], crop)


TRUTH, INCREMENTS, LIKELIHOODS = drive()
PRIOR = UniformPrior(TRUTH[0], 3.0, np.deg2rad(3.0))
SETTINGS = {
    "as usual": ParticleFilterSettings(),
    "resampled every time": ParticleFilterSettings(ess_fraction=1.0),
    "no kernel noise": ParticleFilterSettings(ess_fraction=1.0, regularisation=0.0),
    "residual": ParticleFilterSettings(ess_fraction=1.0, resampler="residual"),
}


def estimates(settings: ParticleFilterSettings, look: Callable[[ParticleFilter, int], object]) -> FloatArray:
    """Pose and covariance (STEPS, 12) after each measurement, with a look before they are asked for."""
    particles, rows = ParticleFilter.from_prior(PRIOR, 2000, seed=1, settings=settings), []
    for step in range(STEPS):
        if step:
            particles.predict(INCREMENTS[step - 1])
        particles.update(LIKELIHOODS[step])
        look(particles, step)
        estimate = particles.estimate(step)
        rows.append(np.concatenate([estimate.pose, estimate.covariance.ravel()]))
    return np.array(rows)


def with_modes(particles: ParticleFilter, step: int) -> None:
    """Compare the estimate that has clusters with the clusters themselves."""
    estimate = particles.estimate(step, max_modes=3)
    assert estimate.modes is not None
    nearest = np.hypot(*(estimate.modes.means[:, :2] - estimate.pose[:2]).T).min()
    assert nearest < 0.5


LOOKS: dict[str, Callable[[ParticleFilter, int], object]] = {
    "clusters": with_modes,
    "state": lambda particles, step: particles.state(),
    "particles": lambda particles, step: particles.particles,
    "weights": lambda particles, step: particles.log_weights,
    "likeliest": lambda particles, step: particles.most_likely_pose(),
    "history": lambda particles, step: CloudHistory().record(particles, step),
}


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("look", LOOKS)
def test_a_look_after_every_measurement_sees_the_vehicle(settings: str, look: str) -> None:
    error = estimates(SETTINGS[settings], LOOKS[look])[:, :2] - TRUTH[:, :2]
    assert np.hypot(*error.T).max() < 2.0


@pytest.mark.parametrize("settings", SETTINGS)
def test_looks_agree_with_not_looking(settings: str) -> None:
    """To rounding, as orders are carried out in two passes instead of one."""
    unseen = estimates(SETTINGS[settings], lambda particles, step: None)
    for look in ("clusters", "particles", "weights"):
        seen = estimates(SETTINGS[settings], LOOKS[look])
        np.testing.assert_allclose(seen[:, :2], unseen[:, :2], atol=0.05, err_msg=look)


@pytest.mark.parametrize("estimator", ["filter", "graph", "both"])
@pytest.mark.parametrize("max_modes", [0, 3])
def test_a_tracker_follows_the_whole_drive(estimator: str, max_modes: int) -> None:
    tracker = Tracker.from_prior(PRIOR, particles=2000, estimator=estimator, seed=2)
    pose, error = np.zeros(3), []
    for step in range(STEPS):
        pose = pose if step == 0 else se2.compose(pose, INCREMENTS[step - 1].delta)
        tracker.add_odometry(step * 10**9, pose)
        tracker.add_likelihood(step * 10**9, LIKELIHOODS[step])
        error.append(tracker.estimate(max_modes=max_modes).pose[:2] - TRUTH[step, :2])
    assert np.hypot(*np.array(error).T).max() < 2.0
