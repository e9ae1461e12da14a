"""The graph as a tracker's estimator: as the smoother, late as in time, saved and resumed, with a filter beside it."""

from dataclasses import dataclass

import numpy as np
import pytest
from made_streams import (
    GRID,
    SECOND,
    SIGMA,
    START,
    answers,
    feed,
    measurement,
    odometry_at,
    shuffled,
    streams,
    truth_at,
)

from fusion import (
    FilterAndGraph,
    FixedLagSettings,
    FixedLagSmoother,
    GaussianLikelihood,
    GaussianMixture,
    GraphFilter,
    LikelihoodVolume,
    MapGrid,
    OdometryIncrement,
    ParticleFilter,
    ParticleFilterSettings,
    SkyfixError,
    Tracker,
    TrackerSettings,
    UniformPrior,
    se2,
)
from fusion.tracking.archive import read_archive, write_archive
from fusion.tracking.state_tree import state_tree, state_values

PRIOR = UniformPrior(np.zeros(3), 5.0, 0.3)
SETTINGS = TrackerSettings(history_s=1.0, correlation_length_m=7.0)
ASKED = [START + round(t * SECOND) for t in (3.1, 3.3, 3.5)]
STEP = OdometryIncrement(0, np.array([2.0, 0.0, 0.05]), np.diag([0.2, 0.15, 0.02]) ** 2)


def tracker(name) -> Tracker:
    inner = ParticleFilterSettings(outlier_probability=0.05)
    return Tracker.from_prior(PRIOR, 300, SETTINGS, inner, 3, name, FixedLagSettings(lag=8))


def test_it_is_the_fixed_lag_smoother_with_a_pose_a_measurement():
    rng, grid_filter = np.random.default_rng(0), GraphFilter.from_prior(PRIOR, FixedLagSettings(lag=5))
    smoother = FixedLagSmoother.from_prior(0, PRIOR, FixedLagSettings(lag=5))
    truth = np.zeros(3)
    for k in range(1, 12):
        truth = se2.compose(se2.compose(truth, STEP.delta), STEP.delta)
        likelihood = GaussianLikelihood(truth + rng.normal(0.0, SIGMA), np.diag(SIGMA**2), GRID)
        for _ in range(2):
            grid_filter.predict(STEP)
        state = grid_filter.state()
        smoother.add_odometry(OdometryIncrement(k, state.delta, state.covariance))
        np.testing.assert_allclose(grid_filter.estimate(0).pose, smoother.estimate().pose, atol=1e-12)
        report = grid_filter.update(likelihood, temperature=2.0)
        expected = smoother.add_likelihood(k, likelihood.tempered(2.0))
        np.testing.assert_allclose(report.log_evidence, expected.log_evidence, atol=1e-9)
    found = grid_filter.estimate(7, max_modes=3)
    assert found.stamp_ns == 7
    assert len(found.modes) == 1
    np.testing.assert_allclose(found.pose, smoother.estimate().pose, atol=1e-9)
    np.testing.assert_allclose(found.covariance, smoother.estimate().covariance, atol=1e-9)


@pytest.mark.parametrize("name", ["graph", "both"])
def test_late_counts_as_in_time_bit_for_bit(name):
    """The tracker's replay: the order of arrival within the history does not matter."""
    messages = streams(4.0)
    in_time, late = tracker(name), tracker(name)
    feed(in_time, messages)
    feed(late, shuffled(messages, np.random.default_rng(1).integers(0, 800, len(messages))))
    assert late.statistics.late_likelihoods + late.statistics.late_odometry > 5
    np.testing.assert_array_equal(answers(late, ASKED), answers(in_time, ASKED))
    error = late.estimate(ASKED[-1]).pose - truth_at(ASKED[-1])
    assert np.abs(error[:2]).max() < 1.0


@pytest.mark.parametrize("name", ["graph", "both"])
@pytest.mark.parametrize("cut", [0, 30, 70])
def test_a_saved_tracker_goes_on_bit_for_bit(tmp_path, name, cut):
    messages = streams(4.0)
    whole = tracker(name)
    feed(whole, messages[:cut])
    whole.save(tmp_path / "one.npz")
    resumed = Tracker.load(tmp_path / "one.npz")
    assert feed(resumed, messages[cut:]) == feed(whole, messages[cut:])
    np.testing.assert_array_equal(answers(resumed, ASKED), answers(whole, ASKED))
    whole.save(tmp_path / "one.npz")
    resumed.save(tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def test_whole_likelihoods_survive_the_file(tmp_path):
    """A window holds parts of volumes: written once, however many states share them."""
    grid = MapGrid(20, 20, 1.0, -6.0, -10.0)
    scores = np.random.default_rng(2).normal(size=(20, 20, 12))
    one = tracker("graph")
    for k in range(5):
        stamp = START + k * SECOND // 5
        one.add_odometry(stamp, odometry_at(stamp))
        one.add_likelihood(stamp, LikelihoodVolume.from_scores(np.roll(scores, k, axis=0), grid))
    one.save(tmp_path / "one.npz")
    other = Tracker.load(tmp_path / "one.npz")
    stamp = START + SECOND
    for which in (one, other):
        which.add_odometry(stamp, odometry_at(stamp))
        which.add_likelihood(stamp, LikelihoodVolume.from_scores(scores, grid))
    np.testing.assert_array_equal(answers(other, [stamp]), answers(one, [stamp]))
    assert (tmp_path / "one.npz").stat().st_size < 2 * 4 * 5 * scores.size


def test_an_array_that_occurs_twice_is_written_once(tmp_path):
    array = np.arange(10_000.0)
    write_archive(tmp_path / "tree.npz", {"a": array, "b": [array, array[::2]]})
    assert (tmp_path / "tree.npz").stat().st_size < 1.6 * array.nbytes
    tree = read_archive(tmp_path / "tree.npz")
    assert tree["a"] is tree["b"][0]
    np.testing.assert_array_equal(tree["b"][1], array[::2])


def both(start, spread=0.5) -> FilterAndGraph:
    cloud = start + np.random.default_rng(4).normal(0.0, [spread, spread, 0.03], (500, 3))
    return FilterAndGraph(ParticleFilter(cloud, 5), FixedLagSettings(lag=20))


def test_the_graph_answers_once_the_filter_is_compact_and_agrees():
    pair, rng = both(truth_at(START), spread=12.0), np.random.default_rng(6)
    assert not pair.graph_answers
    for k in range(1, 25):
        stamp = START + k * SECOND // 5
        pair.predict(OdometryIncrement(k, se2.between(truth_at(stamp - SECOND // 5), truth_at(stamp)), STEP.covariance))
        pair.update(measurement(stamp, rng))
    assert pair.graph_answers
    found, particles = pair.estimate(stamp, 2), pair.filter.estimate(stamp)
    assert np.abs(found.pose - particles.pose).max() > 0.0
    assert np.abs(found.pose - truth_at(stamp))[:2].max() < 1.0
    assert found.effective_sample_size == particles.effective_sample_size


def test_a_graph_that_the_filter_leaves_begins_anew():
    """Carried elsewhere: the filter recovers, the graph cannot, and soon it answers again from the new place."""
    pair, rng, away = both(truth_at(START)), np.random.default_rng(7), np.array([60.0, -70.0, 0.0])
    answered = []
    for k in range(1, 60):
        stamp = START + k * SECOND // 5
        pair.predict(OdometryIncrement(k, se2.between(truth_at(stamp - SECOND // 5), truth_at(stamp)), STEP.covariance))
        place = truth_at(stamp) + (away if k > 15 else 0.0)
        pair.update(measurement(stamp, rng, place))
        answered.append(pair.graph_answers)
    assert answered[10]
    assert not all(answered[15:])
    assert pair.graph_answers
    assert np.abs(pair.estimate(stamp).pose - place)[:2].max() < 1.5


def test_bad_input_is_refused_and_changes_nothing():
    class Broken:
        grid, searched_volume = GRID, GRID.area_m2

        def log_density(self, poses):
            return np.full(len(poses), np.inf)

        def tempered(self, temperature):
            return self

        def with_outliers(self, probability):
            return self

    for pair in (both(np.zeros(3)), GraphFilter.from_prior(PRIOR)):
        pair.predict(STEP)
        pair.update(GaussianLikelihood(STEP.delta, np.diag(SIGMA**2), GRID))
        pair.predict(STEP)
        before = pair.estimate(0)
        with pytest.raises(SkyfixError, match="likelihood") as caught:
            pair.update(Broken())
        assert "\n" not in str(caught.value)
        np.testing.assert_array_equal(pair.estimate(0).pose, before.pose)
    with pytest.raises(SkyfixError, match="estimator"):
        Tracker.from_prior(PRIOR, estimator="graphs")


def test_several_starts_are_several_hypotheses():
    means = np.array([[0.0, 0.0, 0.0], [0.0, 30.0, 0.0]])
    graph = GraphFilter(GaussianMixture(np.array([0.5, 0.5]), means, np.array([np.diag(SIGMA**2)] * 2)))
    assert len(graph.estimate(0, max_modes=4).modes) == 2
    graph.update(GaussianLikelihood(means[1], np.diag(SIGMA**2), GRID))
    assert graph.estimate(0, max_modes=4).modes.weights[0] > 0.9


def test_states_of_unknown_types_are_not_written():
    @dataclass(frozen=True)
    class Inner:
        number: int

    @dataclass(frozen=True)
    class State:
        inner: Inner

    with pytest.raises(SkyfixError, match="Inner"):
        state_tree(State(Inner(1)))
    assert state_values(state_tree(State((1, "two", None)))) == {"inner": (1, "two", None)}
