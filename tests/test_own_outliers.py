"""A measurement that doubts itself: its own chance of an outlier counts in the graph beside that of the settings."""

from dataclasses import replace

import numpy as np
import pytest
from made_streams import SECOND, START, answers, odometry_at

from fusion import (
    FixedLagSettings,
    FixedLagSmoother,
    GaussianLikelihood,
    GaussianMixture,
    GraphFilter,
    HypothesisSmoother,
    LikelihoodVolume,
    LocationOrientationMaps,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    SkyfixError,
    SmootherSettings,
    Tracker,
    Trajectory,
    UniformPrior,
    se2,
    smooth,
)
from fusion.graph.measurements import Measurements
from fusion.graph.patch import patch_of
from fusion.likelihood import OutlierMixture

P, Q = 0.4, 0.07
TOGETHER = 1.0 - (1.0 - P) * (1.0 - Q)
SPREAD = np.diag([0.5, 0.4, 0.06]) ** 2
STEP = np.diag([0.2, 0.15, 0.02]) ** 2
KINDS = ["gaussian", "volume", "maps"]


def likelihood(kind, at, grid=None):
    """One around a pose (3,)."""
    metres = 1.0 if kind == "maps" else 0.5
    side = round(16.0 / metres)
    grid = grid or MapGrid(side, side, metres, float(at[0]) - 8.0, float(at[1]) - 8.0)
    gaussian = GaussianLikelihood(at, SPREAD, grid)
    if kind == "gaussian":
        return gaussian
    x, y = grid.centres()
    poses = np.stack(np.meshgrid(y, x, np.arange(90) * 2.0 * np.pi / 90, indexing="ij"), axis=-1)[..., [1, 0, 2]]
    scores = gaussian.log_density(poses.reshape(-1, 3)).reshape(poses.shape[:3])
    whole = LikelihoodVolume.from_scores(scores, grid)
    if kind == "volume":
        return whole
    location = np.log(np.exp(whole.log_prob.astype(np.float64)).sum(axis=2) * 2.0 * np.pi / 90)
    return LocationOrientationMaps(location, np.moveaxis(whole.log_prob - location[:, :, None], 2, 0), grid)


def drive(kind, count=12):
    """Increments and likelihoods; every fourth is some metres off."""
    rng, truth, increments, seen = np.random.default_rng(0), np.zeros(3), [], []
    for node in range(count):
        if node:
            delta = np.array([2.0, 0.0, 0.05])
            truth = se2.compose(truth, delta)
            increments.append(OdometryIncrement(node, delta + rng.multivariate_normal(np.zeros(3), STEP), STEP))
        wrong = np.array([1.5, -2.0, 0.1]) if node % 4 == 3 else np.zeros(3)
        seen.append(likelihood(kind, truth + wrong + rng.multivariate_normal(np.zeros(3), SPREAD)))
    return increments, seen


@pytest.mark.parametrize("kind", KINDS)
def test_the_smoother_takes_both_chances_together(kind):
    increments, seen = drive(kind)
    start = Trajectory(np.arange(12), np.cumsum(np.vstack([np.zeros(3), [one.delta for one in increments]]), axis=0))
    prior = UniformPrior(np.zeros(3), 3.0, 0.2)

    def run(measurements, outlier):
        settings = SmootherSettings(outlier_probability=outlier)
        return smooth(np.arange(12), increments, measurements, prior, start, settings)

    doubted, expected = run([one.with_outliers(P) for one in seen], Q), run(seen, TOGETHER)
    np.testing.assert_allclose(doubted.trajectory.poses, expected.trajectory.poses, atol=1e-12)
    np.testing.assert_allclose(doubted.trajectory.covariances, expected.trajectory.covariances, atol=1e-12)
    np.testing.assert_array_equal(doubted.chosen, expected.chosen)
    assert doubted.log_evidence == pytest.approx(expected.log_evidence, abs=1e-10)
    assert np.abs(doubted.trajectory.poses - run(seen, Q).trajectory.poses).max() > 1e-3  # it matters here


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("starts", [1, 2])
def test_so_do_the_smoothers_online(kind, starts):
    increments, seen = drive(kind)
    means = np.array([[0.0, 0.0, 0.0], [0.0, 9.0, 0.0]])[:starts]
    begin = GaussianMixture(np.full(starts, 1.0 / starts), means, np.array([np.diag([1.0, 1.0, 0.01])] * starts))

    def run(measurements, outlier):
        settings = FixedLagSettings(lag=6, outlier_probability=outlier)
        one = FixedLagSmoother(0, begin.means[0], begin.covariances[0], settings)
        if starts > 1:
            one = HypothesisSmoother(0, begin, None, settings)
        for increment, measurement in zip(increments, measurements[1:], strict=True):
            one.add_odometry(increment)
            one.add_likelihood(increment.stamp_ns, measurement)
        return one

    doubted, expected = run([one.with_outliers(P) for one in seen], Q), run(seen, TOGETHER)
    np.testing.assert_allclose(doubted.estimate().pose, expected.estimate().pose, atol=1e-12)
    np.testing.assert_allclose(doubted.estimate().covariance, expected.estimate().covariance, atol=1e-12)
    assert doubted.log_evidence == pytest.approx(expected.log_evidence, abs=1e-10)


def test_every_measurement_has_its_own():
    """Side by side as alone, in any selection; a mixture within a mixture doubts twice."""
    volume, gaussian = likelihood("volume", np.zeros(3)), likelihood("gaussian", np.zeros(3))
    seen = [volume, OutlierMixture(volume.with_outliers(0.3), 0.2), gaussian.with_outliers(0.6), gaussian]
    seen += [gaussian.modes(1), patch_of(volume.with_outliers(0.9)), volume.with_outliers(0.44)]
    own = np.array([0.0, 0.44, 0.6, 0.0, 0.0, 0.9, 0.44])
    all_ = Measurements(seen, Q, -9.2)
    centres = np.tile([1.5, -1.0, 0.1], (7, 1))
    windows = np.tile(np.diag([0.6, 0.6, 0.05]) ** 2, (7, 1, 1))
    bare = [gaussian if node in (2, 3, 4) else volume for node in range(7)]
    found, told = all_.windowed(centres, windows)
    for place, node in enumerate(all_.nodes):
        together = 1.0 - (1.0 - own[node]) * (1.0 - Q)
        alone, one = Measurements([bare[node]], together, -9.2).windowed(centres[:1], windows[:1])
        assert found.log_mass[place] == pytest.approx(alone.log_mass[0], abs=1e-12)
        np.testing.assert_allclose(found.means[place], alone.means[0], atol=1e-12)
        np.testing.assert_allclose(found.spreads[place], alone.spreads[0], atol=1e-12)
        assert told[place] == one[0]
    for places in ([1, 4], [0, 2, 5, 6]):
        part, chosen = all_.some(np.array(places)).windowed(centres[: len(places)], windows[: len(places)])
        np.testing.assert_array_equal(part.log_mass, found.log_mass[places])
        np.testing.assert_array_equal(chosen, told[places])


@pytest.mark.parametrize("own", [0.0, 0.5, 0.999])
def test_the_graph_and_the_filter_agree_on_a_doubtful_measurement(own):
    """One measurement four metres ahead of a Gaussian prediction: the means of the same posterior."""
    prior = np.diag([1.5, 1.5, 0.05]) ** 2
    measurement = likelihood("volume", np.array([4.0, 0.0, 0.0]), MapGrid(80, 80, 0.5, -20.0, -20.0))
    measurement = measurement.with_outliers(own) if own else measurement
    cloud = np.random.default_rng(1).multivariate_normal(np.zeros(3), prior, 60_000)
    particles = ParticleFilter(cloud, 2, ParticleFilterSettings(ess_fraction=0.0, outlier_probability=0.05))
    graph = GraphFilter(GaussianMixture(np.ones(1), np.zeros((1, 3)), prior[None]))
    still = OdometryIncrement(1, np.zeros(3), np.diag([1e-3, 1e-3, 1e-4]) ** 2)
    reports = []
    for one in (particles, graph):
        one.predict(still)
        reports.append(one.update(measurement))
    mine, theirs = graph.estimate(0), particles.estimate(0)
    assert (np.abs(mine.pose - theirs.pose) < [0.06, 0.06, 0.004]).all()
    assert reports[1].log_evidence == pytest.approx(reports[0].log_evidence, abs=0.25)  # each reads between cells
    assert (mine.pose[0] > 3.0) == (own < 0.9)


@pytest.mark.parametrize("kind", ["gaussian", "volume"])
@pytest.mark.parametrize("name", ["graph", "both"])
def test_it_survives_the_file(tmp_path, name, kind):
    graph = FixedLagSettings(lag=4)
    one = Tracker.from_prior(UniformPrior(np.zeros(3), 2.0, 0.2), 200, seed=3, estimator=name, graph_settings=graph)

    def step(which, k):
        stamp = START + k * SECOND // 5
        which.add_odometry(stamp, odometry_at(stamp))
        at = se2.exp(np.array([10.0, 0.0, 0.1]) * k / 5.0)
        which.add_likelihood(stamp, likelihood(kind, at).with_outliers(0.2))

    for k in range(6):
        step(one, k)
    one.save(tmp_path / "one.npz")
    other = Tracker.load(tmp_path / "one.npz")
    for k in range(6, 10):
        step(one, k)
        step(other, k)
    stamp = START + 9 * SECOND // 5
    np.testing.assert_array_equal(answers(other, [stamp]), answers(one, [stamp]))
    assert one.statistics.likelihoods == 10


def test_a_chance_out_of_range_is_one_line():
    with pytest.raises(SkyfixError, match=r"patch outlier probability: expected in \[0, 1\), got 1\.0"):
        replace(patch_of(likelihood("volume", np.zeros(3))), outlier_probability=1.0)
