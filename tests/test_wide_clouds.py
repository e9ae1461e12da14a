"""Clouds whose headings span the circle or that fall into clusters: moments and kernel noise of the compiled step."""

import numpy as np
import pytest

from fusion import OdometryIncrement, ParticleFilter, ParticleFilterSettings, se2
from fusion.particles.cloud import Cloud
from fusion.particles.clusters import cloud_labels, find_clusters
from fusion.particles.regularisation import cluster_kernels

KEY = np.arange(4, dtype=np.uint32)
STILL = OdometryIncrement(1, np.zeros(3), np.zeros((3, 3)))


def direct(poses, weights):
    """Mean (3,) and second moments about it (3, 3), in float64 and by definition."""
    mean = weights @ poses
    mean[2] = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    off = poses - mean
    off[:, 2] = se2.wrap(off[:, 2])
    centred = off - [0.0, 0.0, weights @ off[:, 2]]
    second = (weights[:, None] * centred).T @ off
    second[2, 2] = weights @ off[:, 2] ** 2
    return mean, second


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("weighted", [False, True])
def test_moments_of_headings_all_around_the_circle(seed, weighted):
    """The reference heading is that of the first particle, anywhere; the mean may be on its other side."""
    rng = np.random.default_rng(seed)
    n = 3000
    yaw = se2.wrap(rng.uniform(-np.pi, np.pi) + rng.vonmises(0.0, 0.7, n))
    poses = np.column_stack([rng.normal(0.0, 9.0, n) + 4.0 * np.sin(yaw), rng.normal(0.0, 6.0, n) + yaw, yaw])
    poses = np.float32(poses).astype(np.float64)
    weights = rng.dirichlet(np.full(n, 0.5)) if weighted else np.full(n, 1.0 / n)
    cloud = Cloud(poses, np.log(weights) if weighted else None, KEY)
    mean, covariance = direct(poses, weights)
    found = cloud.moments()
    x, y = found.mean[0] + cloud.anchor[0], found.mean[1] + cloud.anchor[1]
    np.testing.assert_allclose([x, y], mean[:2], atol=2e-4)
    assert abs(se2.wrap(np.array(found.mean[2] - mean[2]))) < 1e-5
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(np.array(found.covariance) / scale, covariance / scale, atol=2e-5)
    assert found.effective_sample_size == pytest.approx(1.0 / (weights @ weights), rel=1e-4)


def test_wide_clouds_do_not_depend_on_the_threads():
    """Same moments and the same noise in clusters, bit for bit, on one thread and on three."""
    rng = np.random.default_rng(1)
    poses = np.concatenate([rng.uniform([-30, -30, -np.pi], [30, 30, np.pi], (9000, 3)), np.full((5000, 3), 200.0)])
    poses[9000:] += rng.normal(0.0, 0.3, (5000, 3))
    poses[:, 2] = se2.wrap(poses[:, 2])
    log_weights = rng.normal(0.0, 1.0, len(poses))
    clouds = [Cloud(poses, log_weights, KEY, threads) for threads in (1, 3)]
    seen = []
    for cloud in clouds:
        first = cloud.moments()
        cloud.resample(len(poses), 0.4)
        cloud.regularise_in_clusters(0.5)
        seen.append((first, cloud.poses()))
    assert seen[0][0] == seen[1][0]
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


def test_the_partition_is_that_of_the_poses():
    rng = np.random.default_rng(2)
    poses = np.float32(rng.uniform([-25, -25, -np.pi], [25, 25, np.pi], (500, 3))).astype(np.float64)
    labels, count = cloud_labels(np.ascontiguousarray(poses.T.astype(np.float32)).reshape(-1))
    expected = find_clusters(poses, np.full(500, 1 / 500))
    assert count == len(expected)
    assert count > 5
    np.testing.assert_array_equal(labels[:, None] == labels, expected.labels[:, None] == expected.labels)


def test_noise_in_clusters_keeps_the_moments_of_every_cluster():
    """Two places, one of them across the seam and correlated: the noise has their shapes, and the two do not mix."""
    rng = np.random.default_rng(3)
    covariance = np.array([[1.0, 0.5, 0.05], [0.5, 0.6, 0.01], [0.05, 0.01, 0.02]])
    one = rng.multivariate_normal([0.0, 0.0, 3.1], covariance, 9000)
    other = rng.multivariate_normal([70.0, 20.0, 0.5], np.diag([0.2, 2.0, 0.001]), 3000)
    poses = np.concatenate([one, other])
    poses[:, 2] = se2.wrap(poses[:, 2])
    cloud = Cloud(poses, None, KEY)
    cloud.keep(np.arange(len(poses), dtype=np.int32)[::-1].copy())
    cloud.regularise_in_clusters(1.0)
    moved = cloud.poses()[::-1]
    assert (moved != poses).any(axis=1).all()
    for part in (slice(0, 9000), slice(9000, None)):
        count = len(poses[part])
        before, after = (direct(each[part], np.full(count, 1.0 / count)) for each in (poses, moved))
        sigma = np.sqrt(np.diag(before[1]))
        assert (np.abs(se2.wrap(after[0] - before[0])) < 0.05 * sigma).all()
        np.testing.assert_allclose(after[1] / np.outer(sigma, sigma), before[1] / np.outer(sigma, sigma), atol=0.07)
        shared = np.corrcoef(np.array([poses[part, 1], moved[part, 1]]))[0, 1]
        assert 0.3 < shared < 0.999  # drawn towards the mean and moved by noise, not drawn anew


def test_one_cluster_gets_the_kernel_of_the_whole_cloud():
    rng = np.random.default_rng(4)
    blob = np.float32(rng.normal(0.0, 0.5, (3, 2000))).reshape(-1)
    assert cluster_kernels(blob, 0.5) is None


def test_a_filter_all_over_a_map_keeps_its_places_through_resampling():
    """Two places 60 m apart stay two after ten resamplings with noise, at half the weight each."""
    rng = np.random.default_rng(5)
    poses = rng.normal(0.0, 0.4, (8000, 3)) * [1.0, 1.0, 0.1]
    poses[4000:, 0] += 60.0
    settings = ParticleFilterSettings(ess_fraction=1.0, regularisation=0.5)
    particles = ParticleFilter(poses, 6, settings)
    for _ in range(10):
        particles.predict(STILL)
        particles._cloud.resample(8000, 0.5)
        particles._cloud.regularise_in_clusters(0.5)
    clusters = find_clusters(particles.particles, np.exp(particles.log_weights))
    heavy = clusters.weights > 0.05
    assert clusters.weights[heavy] == pytest.approx([0.5, 0.5], abs=0.02)
    spread = np.sqrt(clusters.covariances[heavy][:, [0, 1], [0, 1]])
    np.testing.assert_allclose(spread, 0.4, rtol=0.08)
