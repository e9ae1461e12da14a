"""Particles in the order of their places: a permutation, only where it pays, that nothing else depends on."""

import numpy as np
import pytest

from fusion import LikelihoodVolume, MapGrid, OdometryIncrement, ParticleFilter, ParticleFilterSettings
from fusion.particles import arrangement
from fusion.particles.arrangement import arrange, is_spread_out
from fusion.particles.cloud import Cloud

KEY = np.arange(4, dtype=np.uint32)
GRID = MapGrid(40, 50, 1.0, -25.0, -20.0)
STEP = OdometryIncrement(1, np.array([0.6, 0.0, 0.05]), np.diag([0.1, 0.1, 0.02]) ** 2)
EVERY_TIME = ParticleFilterSettings(ess_fraction=1.0)
COUNT = 12_000


def all_over(count, seed=0):
    return np.random.default_rng(seed).uniform([-25, -20, -np.pi], [25, 20, np.pi], (count, 3))


def vague(seed=1):
    scores = np.random.default_rng(seed).normal(0.0, 0.3, (GRID.rows, GRID.cols, 24))
    return LikelihoodVolume.from_scores(scores, GRID)


@pytest.mark.parametrize("count", [1, 3, 4, 511, 513, 20_001])
def test_copies_are_lined_up_and_none_is_lost(count):
    cloud = Cloud(all_over(3000), None, KEY)
    xyt, moments = np.ascontiguousarray(cloud.poses().T.astype(np.float32)).reshape(-1), cloud.moments()
    ancestors = np.sort(np.random.default_rng(2).integers(0, 3000, count)).astype(np.int32)
    results = []
    for threads in (1, 3):
        tiles, ordered = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
        arrange(threads, xyt, ancestors, moments, tiles, ordered)
        results.append(ordered)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(np.sort(ordered), ancestors)
    row, place = np.divmod(tiles, 64)
    x, y = xyt.reshape(3, -1)[:2, ancestors]
    (mx, my, _), sigma = moments.mean, np.sqrt(np.diag(moments.covariance))
    expected = ((np.stack([x - mx, y - my]).T / sigma[:2] + 2.0) * 16.0).clip(0, 63)
    assert (np.abs(expected - 0.5 - np.column_stack([place, row])) < 0.51).all()
    tile_of = dict(zip(ancestors.tolist(), tiles.tolist(), strict=True))
    assert (np.diff([tile_of[one] for one in ordered.tolist()]) >= 0).all()


def roughness(particles):
    """Mean distance in y from a particle to the next, over that in a random order."""
    y = particles[:, 1]
    return np.abs(np.diff(y)).mean() / (2.0 / np.sqrt(np.pi) * y.std())


def test_a_filter_lines_up_a_cloud_all_over_the_map_and_no_other():
    near = np.random.default_rng(3).normal(0.0, [1.0, 1.0, 0.1], (COUNT, 3))
    for poses, is_ordered in ((all_over(COUNT), True), (near, False), (all_over(1000), False)):
        particles = ParticleFilter(poses, 4, EVERY_TIME)
        assert is_spread_out(len(poses), particles._cloud.moments()) == is_ordered
        particles.predict(STEP)
        particles.update(vague())
        assert (roughness(particles.particles) < 0.2) == is_ordered


def drive(threads=1, looking=False, resumed=False, seed=5):
    particles = ParticleFilter(all_over(COUNT), seed, ParticleFilterSettings(ess_fraction=1.0, threads=threads))
    for step in range(5):
        particles.predict(STEP)
        if looking:
            particles.particles, particles.estimate(step)
        report = particles.update(vague(step))
        if looking:
            particles.log_weights, particles.estimate(step, max_modes=2)
        state = particles.state()
        if resumed:
            particles = ParticleFilter.from_state(state, particles.settings)
    return particles.particles, particles.estimate(0).pose, np.array(report.log_evidence)


@pytest.mark.parametrize("otherwise", [{"threads": 3}, {"looking": True}, {"resumed": True}], ids=str)
def test_threads_looking_and_resuming_change_nothing(otherwise):
    for one, other in zip(drive(), drive(**otherwise), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_order_changes_no_statistics(monkeypatch):
    """Evidence and mean of 8 runs in order and 8 without, within 4.5 standard errors of each other."""
    found = []
    for least in (arrangement.LEAST_PARTICLES, 10 * COUNT):
        monkeypatch.setattr(arrangement, "LEAST_PARTICLES", least)
        runs = [drive(seed=seed) for seed in range(8)]
        found.append(np.array([[evidence, *pose[:2]] for _, pose, evidence in runs]))
        assert (roughness(runs[0][0]) < 0.3) == (least < COUNT)
    ordered, plain = found
    error = np.sqrt((ordered.var(axis=0, ddof=1) + plain.var(axis=0, ddof=1)) / 8)
    assert (np.abs(ordered.mean(axis=0) - plain.mean(axis=0)) < 4.5 * error).all()


def test_a_wide_cloud_that_is_cut_to_a_place_is_not_lined_up_again():
    """What counts is where the copies are, not where the particles were."""
    poses = all_over(COUNT)
    cloud = Cloud(poses, -0.5 * (((poses - [3.0, 4.0, 1.0]) / [2.0, 2.0, 0.3]) ** 2).sum(axis=1), KEY)
    assert not is_spread_out(COUNT, cloud.moments())
