"""Recorded clouds: thinned without a bias, in order, and bad use of history and smoother in one line."""

from dataclasses import dataclass

import numpy as np
import pytest

from fusion import CloudHistory, OdometryIncrement, ParticleSmootherSettings, SkyfixError, sample_paths, se2


@dataclass
class Cloud:
    particles: np.ndarray
    log_weights: np.ndarray


def increment(stamp):
    return OdometryIncrement(stamp, np.array([0.4, 0.0, 0.0]), np.eye(3))


def test_thinning_keeps_the_cloud_s_moments_and_its_bound():
    history = CloudHistory(max_particles=400, seed=1)
    rng = np.random.default_rng(16)
    poses, log_weights = rng.normal(0, [2, 1, 0.1], (5000, 3)), rng.normal(0, 1, 5000)
    history.record(Cloud(poses, log_weights), 0)
    kept = history.clouds[0]
    assert kept.particles.shape == (400, 3)
    mean, covariance = se2.weighted_mean_and_covariance(poses, np.exp(log_weights))
    found, spread = se2.weighted_mean_and_covariance(kept.particles, kept.weights)
    sigma = np.sqrt(np.diag(covariance))
    assert (np.abs(found - mean) < 4 * sigma / np.sqrt(400)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(spread)) / sigma, 1.0, atol=4 / np.sqrt(800))


def test_bad_use_is_refused_in_one_line():
    cloud = Cloud(np.zeros((5, 3)), np.zeros(5))

    def after_one(call):
        history = CloudHistory()
        history.record(cloud, 10)
        return call(history)

    def moved_twice(history):
        history.move(increment(12))
        history.move(increment(12))

    def recorded_late(history):
        history.move(increment(12))
        history.record(cloud, 13)

    for word, call in {
        "paths": lambda: ParticleSmootherSettings(paths=1),
        "max_rejections": lambda: ParticleSmootherSettings(max_rejections=-1),
        "floor_m": lambda: ParticleSmootherSettings(floor_m=0.0),
        "floor_rad": lambda: ParticleSmootherSettings(floor_rad=np.nan),
        "max_particles": lambda: CloudHistory(max_particles=0),
        "recorded cloud": lambda: sample_paths(CloudHistory(), 0),
        "before the first increment": lambda: CloudHistory().move(increment(1)),
        "after 10 ns": lambda: after_one(lambda history: history.move(increment(10))),
        "after 12 ns": lambda: after_one(moved_twice),
        "last increment, 12 ns": lambda: after_one(recorded_late),
        "last increment, 10 ns": lambda: after_one(lambda history: history.record(cloud, 11)),
        "finite": lambda: CloudHistory().record(Cloud(np.full((5, 3), np.nan), np.zeros(5)), 0),
        "at least one": lambda: CloudHistory().record(Cloud(np.zeros((0, 3)), np.zeros(0)), 0),
        "log weights": lambda: CloudHistory().record(Cloud(np.zeros((5, 3)), np.zeros(4)), 0),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_second_update_at_a_stamp_replaces_the_record():
    history = CloudHistory()
    history.record(Cloud(np.zeros((5, 3)), np.zeros(5)), 0)
    history.record(Cloud(np.ones((7, 3)), np.zeros(7)), 0)
    assert len(history) == 1
    assert history.clouds[0].particles.shape == (7, 3)
