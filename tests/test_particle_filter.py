"""The particle filter: a Kalman filter where that is exact, honest where it is lost, unharmed by bad input."""

import numpy as np
import pytest

from fusion import (
    GaussianLikelihood,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    SkyfixError,
    UniformPrior,
    se2,
)
from fusion.consistency import nees
from fusion.particles.clusters import find_clusters
from fusion.particles.regularisation import matrix_root, regularised

GRID = MapGrid(81, 81, 0.5, -20.25, -20.25)
MEASURED = np.diag([0.6, 0.4, 0.03]) ** 2


def increment(stamp, delta, covariance):
    return OdometryIncrement(stamp, np.asarray(delta, dtype=float), covariance)


def at(pose, covariance=MEASURED):
    return GaussianLikelihood(np.asarray(pose, dtype=float), covariance, GRID)


class Kalman:
    """Linear Gaussian filter of (x, y, yaw) along +x: exact as long as headings stay near zero."""

    def __init__(self, mean, covariance):
        self.mean, self.covariance = mean, covariance

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


@pytest.mark.parametrize("regularisation", [0.0, 0.5, 1.0])
def test_the_filter_is_the_kalman_filter_where_that_is_exact(regularisation):
    """Mean, covariance and evidence over 12 filters with 3,000 particles, at small headings."""
    start, spread = np.zeros(3), np.diag([0.5, 0.5, 0.002]) ** 2
    motion, delta, steps = np.diag([0.1, 0.1, 0.0005]) ** 2, np.array([0.4, 0.0, 0.0]), 25
    measured_noise = np.diag([0.6, 0.4, 0.02]) ** 2
    settings = ParticleFilterSettings(outlier_probability=1e-9, regularisation=regularisation)
    rng = np.random.default_rng(0)
    measured = [np.array([0.4 * (i + 1), 0.1, 0.0]) + rng.normal(0, [0.6, 0.4, 0.02]) for i in range(steps)]

    kalman, evidence = Kalman(start, spread), 0.0
    for one in measured:
        kalman.predict(delta, motion)
        evidence += kalman.update(one, measured_noise)

    means, covariances, evidences = [], [], []
    for seed in range(12):
        cloud = np.random.default_rng(100 + seed).multivariate_normal(start, spread, 3000)
        particles, total = ParticleFilter(cloud, seed, settings), 0.0
        for i, one in enumerate(measured):
            particles.predict(increment(i, delta, motion))
            total += particles.update(at(one, measured_noise)).log_evidence
        estimate = particles.estimate(0)
        means.append(estimate.pose)
        covariances.append(estimate.covariance)
        evidences.append(total)
    sigma = np.sqrt(np.diag(kalman.covariance))
    assert (np.abs(np.mean(means, axis=0) - kalman.mean) < 0.08 * sigma).all()
    ratio = np.mean(covariances, axis=0)[range(3), range(3)] / sigma**2
    np.testing.assert_allclose(ratio, 1.0, atol=0.06)  # neither depleted nor inflated
    assert np.mean(evidences) == pytest.approx(evidence, abs=0.35)


def test_prediction_moves_the_cloud_by_the_increment_and_its_covariance():
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.001], [0.0, 0.001, 0.0004]])
    particles = ParticleFilter(np.tile([3.0, 4.0, np.pi / 2], (20_000, 1)), 0)
    particles.predict(increment(0, [2.0, 1.0, 0.1], covariance))
    estimate = particles.estimate(0)
    np.testing.assert_allclose(estimate.pose, [2.0, 6.0, np.pi / 2 + 0.1], atol=0.01)
    turn = se2.rotation(np.pi / 2)  # body axes onto the map's
    np.testing.assert_allclose(estimate.covariance, turn @ covariance @ turn.T, atol=1.5e-3)


def test_a_singular_increment_is_welcome():
    particles = ParticleFilter(np.zeros((100, 3)), 0)
    particles.predict(increment(0, [1.0, 0.0, 0.0], np.zeros((3, 3))))
    np.testing.assert_array_equal(particles.particles, np.tile([1.0, 0.0, 0.0], (100, 1)))
    along_only = np.diag([0.01, 0.0, 0.0])
    particles.predict(increment(1, [1.0, 0.0, 0.0], along_only))
    assert particles.particles[:, 0].std() == pytest.approx(0.1, rel=0.3)
    assert (particles.particles[:, 1:] == 0.0).all()
    assert np.linalg.eigvalsh(particles.estimate(1).covariance).min() > 0.0


def test_a_drive_from_a_box_is_tracked_honestly():
    rng = np.random.default_rng(1)
    truth = np.array([3.0, -4.0, np.pi - 0.05])  # the heading crosses the seam on the way
    prior = UniformPrior(truth + np.array([6.0, -5.0, 0.1]), 10.0, 0.3)
    particles = ParticleFilter.from_prior(prior, 4000, 2)
    motion = np.diag([0.05, 0.05, 0.005]) ** 2
    errors, covariances = [], []
    for step in range(60):
        delta = np.array([0.3, 0.0, 0.06])
        truth = se2.compose(truth, delta + rng.multivariate_normal(np.zeros(3), motion))
        particles.predict(increment(step, delta, motion))
        seen = (
            se2.wrap(rng.uniform(-9, 9, 3))
            if step % 10 == 7
            else truth + rng.multivariate_normal(np.zeros(3), MEASURED)
        )
        report = particles.update(at(seen))
        estimate = particles.estimate(step)
        error = estimate.pose - truth
        error[2] = se2.wrap(error[2])
        errors.append(error)
        covariances.append(estimate.covariance)
        assert 1.0 <= report.effective_sample_size <= 4000.0 + 1e-6
        assert report.injected == 0
    errors = np.array(errors[10:])
    assert np.hypot(errors[:, 0], errors[:, 1]).mean() < 0.35
    assert 0.4 < nees(errors, np.array(covariances[10:])).mean() / 3 < 1.8
    assert particles.lost_score < 0.01


def mapped(pose, sigma=(0.8, 0.8, 0.05), bins=90):
    """A volume with one Gaussian peak on a little noise."""
    x, y = GRID.centres()
    yaw = np.arange(bins) * 2 * np.pi / bins
    squares = ((x[None, :, None] - pose[0]) / sigma[0]) ** 2 + ((y[:, None, None] - pose[1]) / sigma[1]) ** 2
    squares = squares + (se2.wrap(yaw - pose[2]) / sigma[2]) ** 2
    return LikelihoodVolume.from_scores(np.log(np.exp(-0.5 * squares) + 1e-6), GRID)


def test_a_kidnapped_filter_says_so_and_finds_back():
    cloud = np.random.default_rng(3).normal([-12.0, -12.0, 0.1], [0.2, 0.2, 0.01], (3000, 3))
    particles = ParticleFilter(cloud, 4)
    likelihood, truth = mapped([9.0, 8.0, -2.0]), np.array([9.0, 8.0, -2.0])
    scores, injected = [], []
    for _ in range(8):
        report = particles.update(likelihood)
        scores.append(report.lost_score)
        injected.append(report.injected)
        if not sum(injected):  # the covariance alone would never tell
            assert np.sqrt(np.diag(particles.estimate(0).covariance)).max() < 0.25
    assert scores[0] < 0.1  # one bad measurement is an outlier
    assert max(scores) > 0.7
    assert sum(injected) > 0
    assert scores[-1] < 0.01
    estimate = particles.estimate(0)
    assert np.hypot(*(estimate.pose - truth)[:2]) < 0.5
    assert abs(se2.wrap(estimate.pose[2] - truth[2])) < 0.05


def test_without_injection_the_filter_still_says_that_it_is_lost():
    particles = ParticleFilter(np.tile([-12.0, -12.0, 0.1], (500, 1)), 5, ParticleFilterSettings(injection_share=0.0))
    for _ in range(6):
        report = particles.update(mapped([9.0, 8.0, -2.0]))
        assert report.injected == 0
    assert report.lost_score > 0.9


def test_injected_particles_carry_the_weight_of_being_lost():
    settings = ParticleFilterSettings(regularisation=0.0, guided_below=0.0)
    particles = ParticleFilter(np.tile([-12.0, -12.0, 0.1], (2000, 1)), 6, settings)
    likelihood = mapped([9.0, 8.0, -2.0])
    report = particles.update(likelihood)
    while not report.injected:
        report = particles.update(likelihood)
    weights = np.exp(particles.log_weights)
    is_fresh = np.hypot(particles.particles[:, 0] + 12.0, particles.particles[:, 1] + 12.0) > 1e-9
    assert len(weights) == 2000
    assert is_fresh.sum() == report.injected == 500
    assert weights.sum() == pytest.approx(1.0)
    assert weights[is_fresh].sum() == pytest.approx(report.lost_score)
    fresh = particles.particles[is_fresh]
    assert (np.hypot(fresh[:, 0] - 9.0, fresh[:, 1] - 8.0) < 3.0).mean() > 0.8  # 5 % outliers, 1e-6 background


def test_lost_score_is_the_recursion_of_the_docstring():
    settings = ParticleFilterSettings(kidnap_probability=0.01, recovery_probability=0.2, injection_share=0.0)
    particles = ParticleFilter(np.tile([0.5, 0.5, 0.0], (50, 1)), 0, settings)
    lost, density_lost = 0.01, 1.0 / (GRID.area_m2 * 2 * np.pi)
    for pose in ([0.4, 0.6, 0.0], [9.0, 9.0, 1.0], [9.0, 9.0, 1.0]):
        evidence = np.exp(particles.update(at(pose)).log_evidence)
        predicted = lost * (1 - 0.2) + (1 - lost) * 0.01
        lost = predicted * density_lost / (predicted * density_lost + (1 - predicted) * evidence)
        assert particles.lost_score == pytest.approx(lost)


def test_a_uniform_measurement_changes_nothing():
    particles = ParticleFilter(np.random.default_rng(7).normal(0, [3, 3, 0.2], (800, 3)), 8)
    before = particles.particles.copy()
    report = particles.update(LikelihoodVolume.from_scores(np.zeros((81, 81, 12)), GRID))
    np.testing.assert_array_equal(particles.particles, before)
    np.testing.assert_allclose(particles.log_weights, -np.log(800), atol=1e-4)
    assert report.log_evidence == pytest.approx(-np.log(GRID.area_m2 * 2 * np.pi), abs=1e-3)
    assert not report.resampled


def test_temperature_weighs_measurements_down():
    """Two measurements at T = 2 say what one says at T = 1."""
    cloud = np.random.default_rng(9).normal(0, [1, 1, 0.05], (500, 3))
    settings = ParticleFilterSettings(ess_fraction=0.0, outlier_probability=1e-12)
    once, twice = ParticleFilter(cloud, 0, settings), ParticleFilter(cloud, 0, settings)
    once.update(at([0.3, 0.2, 0.01]))
    twice.update(at([0.3, 0.2, 0.01]), temperature=2.0)
    twice.update(at([0.3, 0.2, 0.01]), temperature=2.0)
    np.testing.assert_allclose(np.exp(once.log_weights), np.exp(twice.log_weights), rtol=1e-6, atol=1e-12)


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
    """Rules every pose out: all-zero weights."""

    __slots__ = ()
    value = -np.inf


@pytest.mark.parametrize("kind", [Broken, Impossible])
def test_a_bad_likelihood_leaves_the_filter_as_it_was(kind):
    particles = ParticleFilter(np.random.default_rng(10).normal(size=(100, 3)), 11)
    particles.update(at([0.0, 0.0, 0.0]))
    before = particles.particles.copy(), particles.log_weights.copy(), particles.lost_score
    with pytest.raises(SkyfixError, match="likelihood"):
        particles.update(kind(np.zeros(3), MEASURED, GRID))
    np.testing.assert_array_equal(particles.particles, before[0])
    np.testing.assert_array_equal(particles.log_weights, before[1])
    assert particles.lost_score == before[2]


def test_weights_stay_normalised_far_outside_of_the_crop():
    particles = ParticleFilter(np.tile([1e5, 1e5, 0.0], (100, 1)), 12)
    for _ in range(50):
        particles.update(mapped([0.0, 0.0, 0.0]), temperature=3.0)
        assert np.isfinite(particles.log_weights).all()
        assert np.exp(particles.log_weights).sum() == pytest.approx(1.0)
        assert np.isfinite(particles.estimate(0).pose).all()


def run(seed):
    particles = ParticleFilter.from_prior(UniformPrior(np.zeros(3), 10.0, 0.3), 300, seed)
    for step in range(10):
        particles.predict(increment(step, [0.1, 0.0, 0.0], np.diag([0.01, 0.01, 0.001])))
        particles.update(mapped([2.0, 1.0, 0.1]))
    return particles.particles


def test_same_seed_same_run():
    np.testing.assert_array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_headings_at_the_seam_are_averaged_on_the_circle():
    rng = np.random.default_rng(13)
    cloud = np.column_stack([rng.normal(0, 0.1, (1000, 2)), rng.normal(np.pi, 0.1, 1000)])
    estimate = ParticleFilter(cloud, 0).estimate(0, max_modes=3)
    assert abs(abs(estimate.pose[2]) - np.pi) < 0.02
    assert np.sqrt(estimate.covariance[2, 2]) == pytest.approx(0.1, rel=0.1)
    assert len(estimate.modes) == 1  # one cluster, not one on either side


def test_clusters_are_reported_apart():
    rng = np.random.default_rng(14)
    cloud = np.concatenate(
        [rng.normal([0, 0, 0], [0.4, 0.4, 0.03], (750, 3)), rng.normal([15, 3, 0], [0.4, 0.4, 0.03], (250, 3))]
    )
    estimate = ParticleFilter(cloud, 0).estimate(5, max_modes=2)
    assert estimate.stamp_ns == 5
    np.testing.assert_allclose(estimate.modes.weights, [0.75, 0.25], atol=0.01)
    np.testing.assert_allclose(estimate.modes.means, [[0, 0, 0], [15, 3, 0]], atol=0.1)
    np.testing.assert_allclose(np.sqrt(estimate.modes.covariances[0, 0, 0]), 0.4, rtol=0.1)
    assert ParticleFilter(cloud, 0).estimate(5).modes is None


def test_clusters_match_a_brute_force_partition():
    """Labels are those of linking every pair of occupied cells that touch."""
    rng = np.random.default_rng(15)
    poses = rng.uniform([-30, -30, -np.pi], [30, 30, np.pi], (400, 3))
    cells = np.column_stack(
        [
            np.floor((poses[:, :2] - poses[:, :2].min(axis=0)) / 2.0),
            np.floor(poses[:, 2] % (2 * np.pi) / np.deg2rad(15)),
        ]
    )
    gap = np.abs(cells[:, None] - cells[None])
    gap[..., 2] = np.minimum(gap[..., 2], 24 - gap[..., 2])
    reach = gap.max(axis=2) <= 1
    for _ in range(9):
        reach = reach @ reach
    clusters = find_clusters(poses, np.full(400, 1 / 400))
    np.testing.assert_array_equal(clusters.labels[:, None] == clusters.labels[None], reach)
    assert clusters.weights.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("far", [0.0, 5e-324, 1e-309, 1e-301, 1e-200])
def test_a_cluster_of_next_to_no_weight_has_moments(far: float) -> None:
    """Away from all measurements weights fall below what has a finite inverse."""
    near, away = np.random.default_rng(1).normal(size=(2, 50, 3)) * 0.1
    poses = np.concatenate([near, away + [60.0, 0.0, 1.0]])
    clusters = find_clusters(poses, np.concatenate([np.full(50, 1 / 50), np.full(50, far)]))
    assert len(clusters) == 2
    np.testing.assert_allclose(clusters.means[1], away.mean(0) + [60.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(clusters.covariances[1], np.cov(away.T, bias=True), atol=1e-3)


def test_regularisation_keeps_the_moments_of_every_cluster():
    rng = np.random.default_rng(16)
    one = rng.multivariate_normal([0, 0, 3.1], [[1.0, 0.5, 0.0], [0.5, 0.6, 0.01], [0.0, 0.01, 0.01]], 6000)
    cloud = np.concatenate([one, one[:2000] + np.array([40.0, 0.0, 0.0])])
    moved = regularised(cloud, 1.0, rng)
    assert (moved != cloud).all()
    before, after = (find_clusters(each, np.full(8000, 1 / 8000)) for each in (cloud, moved))
    big = np.flatnonzero(before.weights > 0.2)
    assert len(big) == 2
    for index in big:
        twin = np.argmin(np.linalg.norm(after.means - before.means[index], axis=1))
        sigma = np.sqrt(np.diag(before.covariances[index]))
        assert (np.abs(after.means[twin] - before.means[index])[:2] < 0.05 * sigma[:2]).all()
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(after.covariances[twin] / scale, before.covariances[index] / scale, atol=0.07)
    assert regularised(cloud, 0.0, rng) is cloud


def test_matrix_root_of_semidefinite_matrices():
    for covariance in (np.diag([4.0, 0.0, 0.0]), np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])):
        root = matrix_root(covariance)
        np.testing.assert_allclose(root @ root.T, covariance, atol=1e-12)


def test_bad_settings_and_clouds_are_refused():
    for word, call in {
        "resampler": lambda: ParticleFilterSettings(resampler="roulette"),
        "ess_fraction": lambda: ParticleFilterSettings(ess_fraction=1.5),
        "outlier_probability": lambda: ParticleFilterSettings(outlier_probability=0.0),
        "injection_share": lambda: ParticleFilterSettings(injection_share=1.0),
        "collapse": lambda: ParticleFilterSettings(collapse_log_evidence_margin=np.nan),
        "particles: expected": lambda: ParticleFilter(np.zeros((5, 2)), 0),
        "at least one": lambda: ParticleFilter(np.zeros((0, 3)), 0),
        "finite": lambda: ParticleFilter(np.full((5, 3), np.nan), 0),
        "temperature": lambda: ParticleFilter(np.zeros((5, 3)), 0).update(at(np.zeros(3)), temperature=0.0),
    }.items():
        with pytest.raises(SkyfixError, match=word) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_particles_cannot_be_changed_from_outside():
    particles = ParticleFilter(np.zeros((5, 3)), 0)
    with pytest.raises(ValueError, match="read-only"):
        particles.particles[0, 0] = 1.0


def test_a_weighted_cloud_is_the_same_as_one_with_repeats():
    """Weights given at the start count like particles: 1:3 is one particle and three of the other."""
    poses = np.array([[0.0, 0.0, 0.1], [4.0, 2.0, -0.3]])
    weighted = ParticleFilter(poses, 0, log_weights=np.log([1.0, 3.0]) + 7.0).estimate(0)
    repeated = ParticleFilter(poses[[0, 1, 1, 1]], 0).estimate(0)
    np.testing.assert_allclose(weighted.pose, repeated.pose, atol=1e-12)
    with pytest.raises(SkyfixError, match="log weights"):
        ParticleFilter(poses, 0, log_weights=[0.0, np.nan])
