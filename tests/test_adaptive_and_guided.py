"""Adaptive sample size, guided proposals, the start all over a map, standing still, and what counts as being lost."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from fusion import (
    GaussianLikelihood,
    KldSampling,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    SkyfixError,
    se2,
)
from fusion.particles.guided_proposal import guided
from fusion.particles.lattice_density import LatticeDensity
from fusion.particles.lost import LostModel, log_uniform_evidence, probability
from fusion.particles.map_start import stratified_poses

GRID = MapGrid(40, 60, 0.5, -15.0, -10.0)
MEASURED = np.diag([0.6, 0.4, 0.03]) ** 2


def at(pose, covariance=MEASURED):
    return GaussianLikelihood(np.asarray(pose, dtype=float), covariance, GRID)


def centres(bins):
    x, y = GRID.centres()
    yaw = se2.wrap(np.arange(bins) * se2.TWO_PI / bins)
    return np.stack(np.broadcast_arrays(x[None, :, None], y[:, None, None], yaw), axis=-1).reshape(-1, 3)


def two_peaks(bins=72):
    def peak(pose):
        residual = centres(bins) - pose
        residual[:, 2] = se2.wrap(residual[:, 2])
        return -0.5 * (residual**2 / [0.4, 0.4, 0.02]).sum(axis=1)

    scores = np.logaddexp(peak([3.0, 2.0, 0.3]), peak([-6.0, -3.0, 2.0]) - 0.7)
    return LikelihoodVolume.from_scores(np.logaddexp(scores, -9.0).reshape(GRID.rows, GRID.cols, bins), GRID)


@pytest.mark.parametrize("cells", [2, 10, 100, 5000])
def test_sample_size_is_the_chi_squared_quantile(cells):
    sampling = KldSampling(error=0.05, confidence=0.95)
    assert sampling.sample_size(cells) == pytest.approx(chi2.ppf(0.95, cells - 1) / (2 * 0.05), rel=0.03)
    assert sampling.sample_size(1) == 1.0


def test_the_number_of_particles_follows_the_spread_of_the_cloud():
    settings = ParticleFilterSettings(adaptive=KldSampling(least=300, most=20_000))
    particles = ParticleFilter.from_map(GRID, 20_000, 0, settings)
    numbers = []
    for step in range(6):
        particles.predict(OdometryIncrement(step, np.zeros(3), np.diag([0.1, 0.1, 0.01]) ** 2))
        particles.update(at([3.0, 2.0, 0.3]))
        numbers.append(len(particles.particles))
        assert np.exp(particles.log_weights).sum() == pytest.approx(1.0)
    assert numbers[-1] < 0.2 * 20_000
    assert 300 <= min(numbers) <= max(numbers) <= 20_000
    estimate = particles.estimate(0)
    assert np.hypot(*(estimate.pose - [3.0, 2.0, 0.3])[:2]) < 0.3
    widened = OdometryIncrement(9, np.zeros(3), np.diag([5.0, 5.0, 1.0]) ** 2)
    particles.predict(widened)
    particles.update(LikelihoodVolume.from_scores(np.zeros((GRID.rows, GRID.cols, 12)), GRID))
    assert len(particles.particles) > 3 * numbers[-1]


def test_a_start_all_over_a_map_is_stratified():
    poses = stratified_poses(GRID, 9600, np.random.default_rng(0))
    row, col = np.floor(GRID.pixel_from_xy(poses[:, :2])).astype(int).T
    counts = np.bincount(row * GRID.cols + col, minlength=2400)
    assert counts.min() == counts.max() == 4  # a random start would leave 44 pixels bare
    quarter = np.bincount(((poses[:, 2] + np.pi) / (np.pi / 2)).astype(int), minlength=4)
    assert (np.abs(quarter - 2400) < 5).all()
    allowed = np.zeros((GRID.rows, GRID.cols), bool)
    allowed[5, 7:9] = True
    particles = ParticleFilter.from_map(GRID, 50, 1, allowed=allowed).particles
    row, col = np.floor(GRID.pixel_from_xy(particles[:, :2] + [1e-6, 0.0])).astype(int).T
    assert set(zip(row, col, strict=True)) == {(5, 7), (5, 8)}
    each = np.array([stratified_poses(GRID, 3, np.random.default_rng(seed))[0] for seed in range(3000)])
    assert abs(each[:, 2].mean()) < 4.5 * np.pi / np.sqrt(3 * 3000)  # the first one by itself is uniform in heading


def test_lattice_density_integrates_to_one_and_is_drawn_from_exactly():
    rng = np.random.default_rng(2)
    cloud = rng.normal([1.0, 1.0, 3.1], [0.8, 0.4, 0.2], (400, 3))
    cloud[:, 2] = se2.wrap(cloud[:, 2])
    log_weights = rng.normal(size=400)
    log_weights -= np.log(np.exp(log_weights).sum())
    density = LatticeDensity.of(cloud, log_weights)
    low, high = cloud.min(axis=0) - 2.0, cloud.max(axis=0) + 2.0
    low[2], high[2] = -np.pi, np.pi
    uniform = rng.uniform(low, high, (100_000, 3))
    values = np.exp(density.log_density(uniform)) * (high - low).prod()
    assert values.mean() == pytest.approx(1.0, abs=4.5 * values.std() / np.sqrt(len(values)))
    drawn = density.sample(200_000, rng)  # E_p[f] both ways, f of first and second order
    for f in (lambda p: p[:, 0], lambda p: (p[:, 1] - 1.0) ** 2, lambda p: np.cos(2.0 * p[:, 2]) * p[:, 0]):
        both = f(drawn).mean(), (values * f(uniform)).mean()
        error = np.hypot(f(drawn).std() / np.sqrt(len(drawn)), (values * f(uniform)).std() / np.sqrt(len(uniform)))
        assert abs(both[0] - both[1]) < 4.5 * error


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_guided_weights_are_unbiased_against_the_exact_integral(share):
    """Evidence and mean of p L by stratified integration, for a sharp L with two peaks in a wide prediction."""
    rng = np.random.default_rng(3)
    cloud = rng.normal([0.0, 0.0, 0.5], [5.0, 4.0, 0.8], (2000, 3))
    cloud[:, 2] = se2.wrap(cloud[:, 2])
    predicted = LatticeDensity.of(cloud, np.full(2000, -np.log(2000.0)))
    volume = two_peaks()
    measurement = volume.with_outliers(0.05)
    fine = rng.random((4, len(centres(72)), 3)) - 0.5
    cell = np.array([0.5, 0.5, se2.TWO_PI / 72])
    integrals = []
    for jitter in fine:  # stratified integration: one point a cell, four times
        poses = centres(72) + jitter * cell
        poses[:, 2] = se2.wrap(poses[:, 2])
        joint = np.exp(predicted.log_density(poses) + measurement.log_density(poses))
        integrals.append([joint.sum(), (joint * poses[:, 0]).sum(), (joint * poses[:, 1]).sum()])
    integrals = np.array(integrals) * cell.prod()
    exact, exact_error = integrals.mean(axis=0), integrals.std(axis=0) / 2.0
    estimates = []
    for _ in range(120):
        poses, log_weights = guided(predicted, measurement, 1000, share, rng)
        inside = GRID.contains(poses[:, :2])
        weights = np.where(inside, np.exp(log_weights), 0.0)
        estimates.append([weights.mean(), (weights * poses[:, 0]).mean(), (weights * poses[:, 1]).mean()])
    estimates = np.array(estimates)
    error = np.hypot(estimates.std(axis=0) / np.sqrt(len(estimates)), exact_error)
    assert (np.abs(estimates.mean(axis=0) - exact) < 4.5 * error).all()
    assert (error[0] / exact[0]) < 0.05  # the test can tell a bias of a quarter


def test_guided_filters_find_a_sharp_measurement_that_plain_ones_miss():
    cloud = np.random.default_rng(4).normal([0.0, 0.0, 0.0], [5.0, 5.0, 1.0], (300, 3))
    sharp, motion = np.diag([0.03, 0.03, 0.005]) ** 2, OdometryIncrement(1, np.zeros(3), np.diag([0.1, 0.1, 0.01]) ** 2)
    errors = {}
    for share in (0.0, 0.3):
        settings = ParticleFilterSettings(guided_share=share, injection_share=0.0)  # whose particles have missed
        particles = ParticleFilter(cloud, 5, settings)
        particles.predict(motion)
        report = particles.update(at([2.0, -1.0, 0.2], sharp))
        errors[share] = np.hypot(*(particles.estimate(0).pose - [2.0, -1.0, 0.2])[:2])
    assert report.effective_sample_size > 30.0
    assert errors[0.3] < 0.05
    assert errors[0.0] > 1.0


def test_a_cloud_is_drawn_anew_only_where_it_is_too_thin():
    """The predicted particles stay in place unless a measurement leaves few of them, or fits none."""
    cloud = np.random.default_rng(5).normal([0.0, 0.0, 0.0], [2.0, 2.0, 0.2], (1000, 3))
    cases = {"broad": (np.eye(3), 0.0), "sharp": (np.diag([0.05, 0.05, 0.01]) ** 2, 0.0), "away": (MEASURED, 9.0)}
    moved = {}
    for name, (covariance, x) in cases.items():
        for below in (0.0, 50.0, np.inf):
            settings = ParticleFilterSettings(ess_fraction=0.0, injection_share=0.0, guided_below=below)
            particles = ParticleFilter(cloud, 5, settings)
            particles.update(at([x, 0.0, 0.0], covariance))
            moved[name, below] = np.abs(particles.particles - cloud).max() > 1e-4
    assert {key for key, value in moved.items() if value} == {
        ("sharp", 50.0), ("away", 50.0), ("broad", np.inf), ("sharp", np.inf), ("away", np.inf),
    }  # fmt: skip


@pytest.mark.parametrize("below", [50.0, np.inf])
def test_evidence_of_a_cloud_drawn_anew_is_that_of_the_prediction(below):
    """Against many particles: the density of a sharp measurement under a wide prediction, in closed form."""
    sharp, spread = np.diag([0.05, 0.05, 0.01]) ** 2, np.diag([2.0, 2.0, 0.2]) ** 2
    expected = np.log(0.95) - 0.5 * np.log(np.linalg.det(2 * np.pi * (sharp + spread)))
    evidences = []
    for seed in range(30):
        cloud = np.random.default_rng(seed).multivariate_normal(np.zeros(3), spread, 1000)
        settings = ParticleFilterSettings(guided_below=below)
        evidences.append(ParticleFilter(cloud, seed, settings).update(at(np.zeros(3), sharp)).log_evidence)
    assert np.std(evidences) < 0.3
    assert np.mean(evidences) == pytest.approx(expected, abs=0.2)  # the kernel's width widens the prediction


def test_a_likelihood_of_nonsense_leaves_the_cloud_as_it_was():
    class Sharp(GaussianLikelihood):
        def with_outliers(self, probability):
            return self

        def tempered(self, temperature):
            return self

        def draw_log_density(self, poses):
            return np.full(len(poses), np.nan)

    cloud = np.random.default_rng(6).normal([0.0, 0.0, 0.0], [2.0, 2.0, 0.2], (500, 3))
    particles = ParticleFilter(cloud, 5)
    before = particles.estimate(0)
    with pytest.raises(SkyfixError, match="expected 500 finite log densities"):
        particles.update(Sharp(np.zeros(3), np.diag([0.05, 0.05, 0.01]) ** 2, GRID))
    np.testing.assert_allclose(particles.particles, cloud, atol=1e-5)
    np.testing.assert_allclose(particles.log_weights, -np.log(500), atol=1e-3)
    np.testing.assert_allclose(particles.estimate(0).covariance, before.covariance, rtol=1e-2)


def test_measurements_while_standing_still_are_left_out():
    settings = ParticleFilterSettings(standstill_m=0.5, standstill_rad=0.1)
    particles = ParticleFilter(np.random.default_rng(6).normal(0, [3, 3, 0.2], (500, 3)), 0, settings)
    assert particles.update(at([0.5, 0.0, 0.0])).used  # the first one counts
    before = particles.particles, particles.log_weights
    creeping = OdometryIncrement(1, np.array([0.1, 0.0, 0.0]), np.zeros((3, 3)))
    report = particles.update(at([0.5, 0.0, 0.0]))
    assert (report.used, report.resampled) == (False, False)
    np.testing.assert_array_equal(particles.particles, before[0])
    for used in (False, False, False, False, True, False):
        particles.predict(replace(creeping, stamp_ns=1))
        assert particles.update(at([0.5, 0.0, 0.0])).used is used
    particles.predict(OdometryIncrement(2, np.array([0.0, 0.0, -0.2]), np.zeros((3, 3))))
    assert particles.update(at([0.5, 0.0, 0.0])).used  # turned on the spot


def test_the_most_likely_pose_lies_in_a_mode_and_not_between():
    rng = np.random.default_rng(7)
    cloud = np.concatenate([rng.normal([-8, 0, 0], [0.3, 0.3, 0.05], (700, 3)), rng.normal([8, 0, 0], 0.3, (300, 3))])
    particles = ParticleFilter(cloud, 0)
    assert abs(particles.estimate(0).pose[0] + 3.2) < 0.1
    assert np.hypot(*(particles.most_likely_pose()[:2] - [-8.0, 0.0])) < 0.3


def test_lost_is_measured_against_what_was_searched():
    """A narrow search is not evidence of anything by itself: a flat likelihood leaves the odds to the prior."""
    bins = 72
    narrow = np.isin(np.arange(bins), [70, 71, 0, 1, 2])
    flat = LikelihoodVolume.from_scores(np.zeros((GRID.rows, GRID.cols, bins)), GRID, valid=narrow)
    assert flat.searched_volume == pytest.approx(GRID.area_m2 * se2.TWO_PI * 5 / 72)
    expected = np.log(0.95 / flat.searched_volume + 0.05 / (GRID.area_m2 * se2.TWO_PI))
    assert log_uniform_evidence(flat, 0.05) == pytest.approx(expected)
    model = LostModel(0.01, 0.2)
    assert probability(model.log_odds(0.01, expected, expected)) == pytest.approx(0.01 * 0.8 + 0.99 * 0.01)
    particles = ParticleFilter(np.random.default_rng(8).normal([0, 0, 0], [2, 2, 0.02], (500, 3)), 0)
    assert particles.update(flat).lost_score == pytest.approx(0.001 * 0.9 + 0.999 * 0.001, rel=0.01)
    assert probability(-800.0) < 1e-300
    assert probability(800.0) == 1.0


def test_unbiased_covariance_of_a_weighted_cloud():
    """Ten weighted particles: the mean of the estimates over many clouds is the covariance they were drawn from."""
    rng, truth = np.random.default_rng(9), np.diag([1.0, 0.5, 0.05]) ** 2
    log_weights = np.log(np.arange(1.0, 11.0))
    total = np.zeros((3, 3))
    for _ in range(3000):
        cloud = rng.multivariate_normal(np.zeros(3), truth, 10)
        total += ParticleFilter(cloud, 0, log_weights=log_weights).estimate(0).covariance
    np.testing.assert_allclose(np.diag(total / 3000) / np.diag(truth), 1.0, atol=4.5 * np.sqrt(2 / 8 / 3000))


@pytest.mark.parametrize(
    ("word", "call"),
    [
        ("least", lambda: KldSampling(least=5, most=4)),
        ("error", lambda: KldSampling(error=0.0)),
        ("confidence", lambda: KldSampling(confidence=0.5)),
        ("cell_m", lambda: KldSampling(cell_m=np.nan)),
        ("guided_share", lambda: ParticleFilterSettings(guided_share=1.0)),
        ("guided_below", lambda: ParticleFilterSettings(guided_below=float("nan"))),
        ("standstill_m", lambda: ParticleFilterSettings(standstill_m=-1.0)),
        ("threads", lambda: ParticleFilterSettings(threads=0)),
        ("at least one", lambda: ParticleFilter.from_map(GRID, 0, 0)),
        ("allowed: expected \\(40, 60\\)", lambda: ParticleFilter.from_map(GRID, 5, 0, allowed=np.ones((3, 3)))),
        ("one pixel", lambda: ParticleFilter.from_map(GRID, 5, 0, allowed=np.zeros((40, 60)))),
    ],
)
def test_bad_requests_are_one_line(word, call):
    with pytest.raises(SkyfixError, match=word) as caught:
        call()
    assert "\n" not in str(caught.value)
