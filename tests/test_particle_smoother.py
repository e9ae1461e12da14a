"""The particle smoother: Rauch-Tung-Striebel where that is exact, brute force where it is not, both samplers alike."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from scipy.stats import chi2, chisquare, ks_2samp

from fusion import (
    CloudHistory,
    GaussianLikelihood,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    ParticleSmootherSettings,
    sample_paths,
    se2,
)
from fusion.kernels.backward import step_back

GRID = MapGrid(400, 400, 0.5, -100.0, -100.0)
MEASURED = np.diag([0.6, 0.4, 0.03]) ** 2
MOTION = np.diag([0.3, 0.2, 0.01]) ** 2
DELTA = np.array([0.4, 0.0, 0.0])
START, SPREAD = np.array([0.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.02]) ** 2
PLAIN = ParticleFilterSettings(outlier_probability=1e-9, regularisation=0.0, kidnap_probability=1e-9)


@dataclass
class Cloud:
    particles: np.ndarray
    log_weights: np.ndarray


def increment(stamp, delta=DELTA, covariance=MOTION):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), covariance)


def measurements(steps):
    rng = np.random.default_rng(0)
    return [DELTA * (i + 1) + rng.normal(0, [0.6, 0.4, 0.02]) for i in range(steps)]


def rauch_tung_striebel(measured):
    """Means (T, 3) and covariances (T, 3, 3), headings near zero, linearised there."""
    jacobian = np.eye(3)
    jacobian[1, 2] = DELTA[0]
    mean, covariance, filtered, predicted = START, SPREAD, [], []
    for one in measured:
        mean, covariance = jacobian @ mean + DELTA, jacobian @ covariance @ jacobian.T + MOTION
        predicted.append((mean, covariance))
        gain = covariance @ np.linalg.inv(covariance + MEASURED)
        mean, covariance = mean + gain @ (one - mean), covariance - gain @ covariance
        filtered.append((mean, covariance))
    smoothed = [filtered[-1]]
    for (m, P), (m_next, P_next) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = P @ jacobian.T @ np.linalg.inv(P_next)
        ahead_m, ahead_P = smoothed[-1]
        smoothed.append((m + gain @ (ahead_m - m_next), P + gain @ (ahead_P - P_next) @ gain.T))
    means, covariances = zip(*smoothed[::-1], strict=True)
    return np.array(means), np.array(covariances)


def recorded(measured, count, seed, settings=PLAIN, max_particles=None):
    cloud = np.random.default_rng(seed).multivariate_normal(START, SPREAD, count)
    particles, history = ParticleFilter(cloud, seed, settings), CloudHistory(max_particles, seed)
    for i, one in enumerate(measured):
        particles.predict(increment(i))
        if i:
            history.move(increment(i))
        particles.update(GaussianLikelihood(one, MEASURED, GRID))
        history.record(particles, i)
    return history


def test_means_and_covariances_are_those_of_rauch_tung_striebel():
    """Eight runs of 2000 particles and 800 paths: means within 0.1 standard deviations, variances within 12 %."""
    measured = measurements(12)
    means, covariances = rauch_tung_striebel(measured)
    settings = ParticleSmootherSettings(paths=800, floor_m=1e-3, floor_rad=1e-5)
    runs = [sample_paths(recorded(measured, 2000, seed), seed, settings).trajectory() for seed in range(8)]
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    off = (np.mean([run.poses for run in runs], axis=0) - means) / sigma
    assert np.abs(off).max() < 0.1
    found = np.mean([run.covariances for run in runs], axis=0)
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(found / scale, covariances / scale, atol=0.12)
    last = np.mean([np.sqrt(np.diagonal(run.covariances[5])) for run in runs], axis=0)
    particles = ParticleFilter(np.random.default_rng(0).multivariate_normal(START, SPREAD, 2000), 0, PLAIN)
    for i, one in enumerate(measured[:6]):
        particles.predict(increment(i))
        particles.update(GaussianLikelihood(one, MEASURED, GRID))
    assert (last < 0.9 * np.sqrt(np.diag(particles.estimate(5).covariance))).all()  # the future does tell


def two_hypotheses():
    """Three clouds of four particles in two corridors 6 m apart, and the exact probability of each of the 64 paths."""
    rng = np.random.default_rng(5)
    history, clouds = CloudHistory(), []
    for t in range(3):
        lanes = np.array([0.0, 0.0, 6.0, 6.0])
        particles = np.column_stack(
            [t + 0.5 * rng.normal(size=4), lanes + 0.8 * rng.normal(size=4), [0.1, -0.2, 0.1, 0.0]]
        )
        clouds.append(Cloud(particles, np.log(rng.dirichlet(np.ones(4)))))
        if t:
            history.move(increment(t, [1.0, 0.0, 0.0], np.diag([0.6, 1.6, 0.2]) ** 2))
        history.record(clouds[-1], t)
    covariance = np.diag([0.6, 1.6, 0.2]) ** 2 + np.diag([0.01, 0.01, 0.0005]) ** 2

    def log_transition(a, b):
        off = se2.between(a, b) - np.array([1.0, 0.0, 0.0])
        return -0.5 * off @ np.linalg.solve(covariance, off)

    backward = np.zeros((4, 4, 4))
    for i, j, k in product(range(4), repeat=3):
        log_p = clouds[2].log_weights[k]
        for earlier, later, (a, b) in ((clouds[1], clouds[2], (j, k)), (clouds[0], clouds[1], (i, j))):
            all_of = [
                earlier.log_weights[n] + log_transition(earlier.particles[n], later.particles[b]) for n in range(4)
            ]
            log_p += all_of[a] - np.logaddexp.reduce(all_of)
        backward[i, j, k] = np.exp(log_p)
    return history, clouds, backward


def path_numbers(history, clouds, settings, seed):
    paths = sample_paths(history, seed, settings, all_stamps=False).paths
    found = [np.abs(paths[:, t, None] - clouds[t].particles).sum(axis=2).argmin(axis=1) for t in range(3)]
    return np.ravel_multi_index(found, (4, 4, 4))


@pytest.mark.parametrize("rejections", [0, 2, 1000], ids=["exact", "both", "rejection"])
def test_joint_probabilities_of_paths_match_enumeration(rejections):
    """40,000 paths over 64 outcomes; a total variation of 2 % would fail with near certainty."""
    history, clouds, probability = two_hypotheses()
    assert probability.sum() == pytest.approx(1.0)
    numbers = path_numbers(history, clouds, ParticleSmootherSettings(40_000, rejections), 1)
    expected = 40_000 * probability.ravel()
    often = expected > 8
    counts = np.bincount(numbers, minlength=64)
    observed = np.append(counts[often], counts[~often].sum())
    assert chisquare(observed, np.append(expected[often], expected[~often].sum())).pvalue > 1e-3
    moved = np.append(expected[often], expected[~often].sum()) * np.tile([0.96, 1.04], 40)[: often.sum() + 1]
    assert chi2.sf(((observed - moved * 40_000 / moved.sum()) ** 2 / moved).sum(), often.sum()) < 1e-3


def test_rejection_and_exact_sampling_agree_on_a_real_cloud():
    """Kolmogorov-Smirnov on 4000 paths each: a shift of 0.05 standard deviations of the middle pose is found."""
    history = recorded(measurements(8), 300, 3)
    exact = sample_paths(history, 1, ParticleSmootherSettings(4000, max_rejections=0))
    rejection = sample_paths(history, 2, ParticleSmootherSettings(4000, max_rejections=10_000))
    assert exact.accepted_share == 0.0
    assert rejection.accepted_share > 0.99
    for t, axis in product((0, 3, 6), range(3)):
        assert ks_2samp(exact.paths[:, t, axis], rejection.paths[:, t, axis]).pvalue > 1e-3
    a, b = exact.paths[:, 3, 0], rejection.paths[:, 3, 0]
    assert ks_2samp(a, b + 0.15 * b.std()).pvalue < 1e-3


def test_one_step_marginals_are_the_smoothed_weights():
    """Shares of the particles chosen against forward-backward smoothing of the weights."""
    history = recorded(measurements(5), 200, 4)
    clouds, floor = history.clouds, np.diag([0.01, 0.01, 0.0005]) ** 2
    smoothed = clouds[-1].weights
    expected = [smoothed]
    for t in range(3, -1, -1):
        off = se2.between(clouds[t].particles[:, None], clouds[t + 1].particles[None]) - DELTA
        off[..., 2] = se2.wrap(off[..., 2])
        transition = np.exp(-0.5 * np.einsum("ijk,kl,ijl->ij", off, np.linalg.inv(MOTION + floor), off))
        joint = clouds[t].weights[:, None] * transition
        smoothed = (joint / joint.sum(axis=0)) @ smoothed
        expected.append(smoothed)
    paths = sample_paths(history, 6, ParticleSmootherSettings(20_000), all_stamps=False).paths
    for t, weights in enumerate(expected[::-1]):
        mean, covariance = se2.weighted_mean_and_covariance(clouds[t].particles, weights)
        error = np.sqrt(np.diag(covariance) / 20_000)
        assert (np.abs(paths[:, t].mean(axis=0) - mean) < 4.5 * error).all()
        np.testing.assert_allclose(paths[:, t].std(axis=0), np.sqrt(np.diag(covariance)), rtol=0.04)


def test_steps_of_paths_have_the_odometry_s_moments():
    """Without measurements in the last three steps a path's steps there are draws of the odometry's noise."""
    rng = np.random.default_rng(7)
    history, poses = CloudHistory(), rng.normal(0, [0.5, 0.5, 0.05], (3000, 3))
    history.record(Cloud(poses, np.zeros(3000)), 0)
    for t in range(1, 4):
        history.move(increment(t))
        poses = se2.compose(poses, DELTA + rng.multivariate_normal(np.zeros(3), MOTION, 3000))
        history.record(Cloud(poses, np.zeros(3000)), t)
    paths = sample_paths(history, 8, ParticleSmootherSettings(2000)).paths
    steps = se2.between(paths[:, :-1], paths[:, 1:]).reshape(-1, 3)
    sigma = np.sqrt(np.diag(MOTION))
    np.testing.assert_allclose(steps.mean(axis=0), DELTA, atol=0.08 * sigma.max())
    np.testing.assert_allclose(steps.std(axis=0), sigma, rtol=0.08)


def test_multimodal_pasts_are_kept_and_resolved_by_the_future():
    """Two lanes at first, a measurement at the end that tells them apart: the path is in the right lane throughout."""
    rng = np.random.default_rng(9)
    lane = np.repeat([0.0, 8.0], 500)
    cloud = np.column_stack([rng.normal(0, 0.5, 1000), lane + rng.normal(0, 0.3, 1000), rng.normal(0, 0.01, 1000)])
    particles, history = ParticleFilter(cloud, 0), CloudHistory()
    history.record(particles, 0)
    for t in range(1, 6):
        particles.predict(increment(t))
        history.move(increment(t))
        if t == 5:
            particles.update(GaussianLikelihood(np.array([2.0, 8.0, 0.0]), MEASURED, GRID))
        history.record(particles, t)
    both = sample_paths(history, 1).paths
    assert (np.abs(both[:, :, 1] - 8.0) < 2.5).mean() > 0.98
    assert 0.3 < (history.clouds[0].particles[:, 1] < 4.0).mean() < 0.7


def test_headings_at_the_seam():
    history = CloudHistory()
    rng = np.random.default_rng(10)
    for t in range(4):
        if t:
            history.move(increment(t, [0.5, 0.0, 0.0]))
        yaw = se2.wrap(np.pi + rng.normal(0, 0.05, 500))
        history.record(
            Cloud(
                np.column_stack([-0.5 * t + rng.normal(0, 0.2, (500,)), rng.normal(0, 0.2, 500), yaw]), np.zeros(500)
            ),
            t,
        )
    trajectory = sample_paths(history, 0).trajectory()
    assert (np.abs(np.abs(trajectory.poses[:, 2]) - np.pi) < 0.05).all()
    assert (np.sqrt(trajectory.covariances[:, 2, 2]) < 0.06).all()
    assert np.linalg.eigvalsh(trajectory.covariances).min() > 0.0


def test_perfect_odometry_is_followed_down_to_the_floor():
    """Zero process noise: paths are the particle's own history, nothing is NaN and covariances stay definite."""
    history = CloudHistory()
    cloud = np.random.default_rng(11).normal(0, [2.0, 2.0, 0.2], (300, 3))
    history.record(Cloud(cloud, np.zeros(300)), 0)
    for t in range(1, 4):
        history.move(increment(t, DELTA, np.zeros((3, 3))))
        cloud = se2.compose(cloud, DELTA[None])
        history.record(Cloud(cloud, np.zeros(300)), t)
    samples = sample_paths(history, 0, ParticleSmootherSettings(200, floor_m=1e-3, floor_rad=1e-4))
    np.testing.assert_allclose(
        se2.between(samples.paths[:, :-1], samples.paths[:, 1:]), np.broadcast_to(DELTA, (200, 3, 3)), atol=1e-9
    )
    far = Cloud(cloud + 50.0, np.zeros(300))  # nothing could have led there: the nearest is taken
    history.move(increment(4, DELTA, np.zeros((3, 3))))
    history.record(far, 4)
    assert np.isfinite(sample_paths(history, 0).paths).all()
    assert np.linalg.eigvalsh(sample_paths(history, 0).trajectory().covariances).min() > 0.0


def test_records_at_some_stamps_give_paths_at_all_of_them():
    """Updates at every third increment; with no measurement between, that is the same smoothing problem."""
    particles, every_third = (
        ParticleFilter(np.random.default_rng(14).multivariate_normal(START, SPREAD, 3000), 0, PLAIN),
        CloudHistory(),
    )
    dense, rng = CloudHistory(), np.random.default_rng(15)
    every_third.record(particles, 0)
    dense.record(particles, 0)
    for t in range(1, 10):
        particles.predict(increment(t))
        every_third.move(increment(t))
        dense.move(increment(t))
        if t % 3 == 0:
            particles.update(GaussianLikelihood(DELTA * t + rng.normal(0, [0.6, 0.4, 0.02]), MEASURED, GRID))
            every_third.record(particles, t)
        dense.record(particles, t)
    assert (len(every_third), len(dense)) == (4, 10)
    settings = ParticleSmootherSettings(3000)
    a, b = (sample_paths(each, 1, settings).trajectory() for each in (every_third, dense))
    np.testing.assert_array_equal(a.stamp_ns, b.stamp_ns)
    sigma = np.sqrt(np.diagonal(b.covariances, axis1=1, axis2=2))
    np.testing.assert_allclose((a.poses - b.poses) / sigma, 0.0, atol=0.2)
    np.testing.assert_allclose(np.sqrt(np.diagonal(a.covariances, axis1=1, axis2=2)) / sigma, 1.0, atol=0.12)
    only = sample_paths(every_third, 1, settings, all_stamps=False)
    assert only.stamp_ns.tolist() == [0, 3, 6, 9]


def test_same_seed_same_paths():
    history = recorded(measurements(5), 300, 17, max_particles=200)
    settings = ParticleSmootherSettings(50)
    a, b, c = (sample_paths(history, seed, settings).paths for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    again = recorded(measurements(5), 300, 17, max_particles=200)
    np.testing.assert_array_equal(sample_paths(again, 1, settings).paths, a)


def test_weightless_particles_are_never_chosen():
    weights = np.array([0.0, 0.5, 0.0, 0.5, 0.0])
    later = np.zeros((200, 3))
    for rejections in (0, 30):
        chosen, _ = step_back(
            np.zeros((5, 3)), weights, later, np.zeros(3), np.eye(3), rejections, np.random.default_rng(0)
        )
        assert set(chosen.tolist()) == {1, 3}


def test_one_record_is_its_own_smoothing():
    history = CloudHistory()
    history.record(Cloud(np.random.default_rng(18).normal(size=(100, 3)), np.zeros(100)), 5)
    samples = sample_paths(history, 0)
    assert samples.paths.shape == (500, 1, 3)
    assert samples.stamp_ns.tolist() == [5]
