"""The online tracker: it follows a drive, says when it is lost, stays small, and is not harmed by nonsense."""

from __future__ import annotations

import gc
import re

import numpy as np
import pytest
from made_streams import GRID, SECOND, START, answers, feed, measurement, odometry_at, streams, truth_at

from fusion import (
    GaussianLikelihood,
    LikelihoodVolume,
    OdometryIncrement,
    Outcome,
    SkyfixError,
    Tracker,
    TrackerSettings,
    UniformPrior,
    se2,
)
from fusion.consistency import nees

PRIOR = UniformPrior(np.zeros(3), 5.0, 0.3)


def at(seconds: float) -> int:
    return START + round(seconds * SECOND)


def tracker(particles: int = 300, seed: int = 0, **changed: float) -> Tracker:
    return Tracker.from_prior(PRIOR, particles, TrackerSettings(**changed), seed=seed)


def test_it_follows_a_drive_whose_odometry_drifts():
    """Mean NEES over 5 drives at 4 times each: the likelihoods' errors are independent, the tracker takes them for
    correlated over 6 m and claims about twice the variance, 1.5 instead of 3; few and correlated, so the band is wide.
    """
    errors, covariances = [], []
    for seed in range(5):
        one = tracker(seed=seed)
        for message in streams(12.0, hertz=10.0, seed=seed):
            feed(one, [message])
            if message.is_odometry and message.stamp_ns >= at(5.0) and (message.stamp_ns - START) % (2 * SECOND) == 0:
                estimate, truth = one.estimate(), truth_at(message.stamp_ns)
                residual = estimate.pose - truth
                errors.append(np.append(residual[:2], se2.wrap(residual[2])))
                covariances.append(estimate.covariance)
    errors = np.array(errors)
    assert np.linalg.norm(errors[:, :2], axis=1).mean() < 0.5
    assert 0.9 < nees(errors, np.array(covariances)).mean() < 5.0
    assert one.estimate().lost_score < 0.05


def test_a_likelihood_volume_does_as_well_and_modes_are_told_when_asked_for():
    x, y = GRID.centres()
    yaw = 2.0 * np.pi * np.arange(36) / 36
    one = tracker()
    feed(one, [m for m in streams(1.0) if m.is_odometry])
    pose = truth_at(at(0.5))
    squared = (x[None, :, None] - pose[0]) ** 2 + (y[:, None, None] - pose[1]) ** 2
    scores = -0.5 * squared + (np.cos(yaw - pose[2]) - 1.0) / 0.1**2
    arrival = one.add_likelihood(at(0.5), LikelihoodVolume.from_scores(scores, GRID))
    assert arrival.outcome is Outcome.USED
    estimate = one.estimate(max_modes=2)
    assert np.linalg.norm(estimate.pose[:2] - truth_at(at(1.0))[:2]) < 1.0
    assert estimate.modes is not None
    assert one.estimate().modes is None
    assert estimate.stamp_ns == one.newest_ns == at(1.0)


def test_temperature_comes_from_the_distance_since_the_last_measurement_also_after_a_late_one():
    one = tracker(correlation_length_m=6.0)
    messages = streams(4.0)
    odometry, measured = ([m for m in messages if m.is_odometry is kind] for kind in (True, False))
    feed(one, odometry)
    (first,) = feed(one, [measured[4]])
    assert [m.temperature for m in first.measured] == [1.0]
    (later,) = feed(one, [measured[6]])
    (alone,) = [m.temperature for m in later.measured]
    (between,) = feed(one, [measured[5]])
    assert [m.stamp_ns for m in between.measured] == [measured[5].stamp_ns, measured[6].stamp_ns]
    nearer = [m.temperature for m in between.measured]
    assert 1.0 < alone < 1.0 / (1.0 - 2.0 * np.exp(-10.1 / 6.0))  # a prediction is no surer than the first measurement
    assert nearer[0] > 1.3 * alone
    assert nearer[1] != alone
    in_order = tracker(correlation_length_m=6.0)
    feed(in_order, odometry)
    arrivals = feed(in_order, measured[4:7])
    assert [m.temperature for arrival in arrivals[1:] for m in arrival.measured] == nearer


@pytest.mark.parametrize("estimator", ["filter", "graph", "both"])
def test_measurements_say_by_how_much_they_agree_with_the_track(estimator):
    """Against a pose anywhere in what was searched; one that belongs elsewhere says little or less than nothing."""
    one, gains = Tracker.from_prior(PRIOR, 300, estimator=estimator), []
    for message in streams(6.0):
        for arrival in feed(one, [message]):
            gains += [(m.evidence_gain_nats, m.update.log_evidence) for m in arrival.measured]
    volume = GRID.area_m2 * 2.0 * np.pi  # of a Gaussian, everything
    assert [gain for gain, _ in gains] == pytest.approx([evidence + np.log(volume) for _, evidence in gains])
    assert np.median([gain for gain, _ in gains]) > 3.0
    elsewhere = measurement(one.newest_ns, np.random.default_rng(0), np.array([-100.0, -100.0, 0.0]))
    (wrong,) = one.add_likelihood(one.newest_ns, elsewhere).measured
    assert wrong.evidence_gain_nats < 2.0  # a graph takes clutter to be denser


def test_a_kidnapped_vehicle_is_lost_says_so_and_is_found():
    one = tracker(1000)
    feed(one, streams(4.0))
    assert one.estimate().lost_score < 0.01
    rng, taken = np.random.default_rng(0), np.array([60.0, -80.0, 2.0])
    scores = []
    for i in range(1, 161):
        stamp = at(4.0 + 0.05 * i)
        feed_pose = se2.compose(taken, se2.between(truth_at(at(4.0)), truth_at(stamp)))
        one.add_odometry(stamp, odometry_at(stamp))
        if i % 20 == 0:
            arrival = one.add_likelihood(stamp, measurement(stamp, rng, feed_pose))
            scores.append((one.estimate().lost_score, arrival.measured[0].update.injected))
    assert max(score for score, _ in scores) > 0.5
    assert sum(injected for _, injected in scores) > 0
    estimate = one.estimate()
    assert estimate.lost_score < 0.05
    assert np.linalg.norm(estimate.pose[:2] - feed_pose[:2]) < 1.0


def test_memory_stays_bounded_and_no_number_goes_bad_over_twenty_thousand_steps(tmp_path):
    """Counted in objects of the interpreter, in messages held, and in bytes of the file that holds everything."""
    settings = TrackerSettings(history_s=0.5, step_s=0.25, correlation_length_m=10.0)
    one = Tracker.from_prior(PRIOR, 20, settings, seed=1)
    rng, objects, sizes, held = np.random.default_rng(0), [], [], []
    stamps = START + np.arange(20_001) * (SECOND // 100)
    poses = se2.exp(np.array([10.1, 0.0, 0.102]) * np.arange(20_001)[:, None] / 100.0)
    delays = np.where(np.arange(20_001) % 20 == 0, rng.integers(1, 20, 20_001), 0)
    for i, sent in enumerate(np.argsort(np.arange(20_001) + delays, kind="stable")):
        one.add_odometry(stamps[sent], poses[sent])
        if i % 100 == 50:
            measured = int(stamps[i]) - SECOND // 10
            one.add_likelihood(measured, measurement(measured, rng))
        if i % 500 == 0:
            assert np.isfinite(answers(one, [one.newest_ns])).all()
            now = one.statistics
            held.append(now.held_odometry + now.held_likelihoods + now.held_states)
        if i in (1_000, 20_000):
            one.save(tmp_path / "tracker.npz")
            sizes.append((tmp_path / "tracker.npz").stat().st_size)
            gc.collect()
            objects.append(len(gc.get_objects()))
    assert max(held) < 110
    assert objects[1] - objects[0] < 400
    assert sizes[1] < 1.2 * sizes[0]
    assert one.statistics.likelihoods == 200
    assert one.statistics.late_odometry > 900


class Strange:
    """A likelihood that gives what it is told to give away from the middle of its crop."""

    grid = GRID
    searched_volume = GRID.area_m2 * 2.0 * np.pi

    def __init__(self, away):
        self.away = away

    def log_density(self, poses):
        if len(poses) == 1:
            return np.zeros(1)
        if isinstance(self.away, Exception):
            raise self.away
        return np.full(len(poses), self.away)

    def tempered(self, temperature):
        return self

    def with_outliers(self, probability):
        return self


class AlwaysNan(Strange):
    def log_density(self, poses):
        return np.full(len(poses), np.nan)


COVARIANCE = 0.01 * np.eye(3)
NONSENSE = [
    (lambda t: t.add_odometry(1.5, [0, 0, 0]), "stamp: expected int64 nanoseconds, got float 1.5"),
    (lambda t: t.add_odometry("now", [0, 0, 0]), "stamp: expected int64 nanoseconds, got str 'now'"),
    (lambda t: t.add_odometry(True, [0, 0, 0]), "stamp: expected int64 nanoseconds, got bool True"),
    (lambda t: t.add_odometry(np.float64(3.0), [0, 0, 0]), "stamp: expected int64 nanoseconds, got float64"),
    (lambda t: t.add_odometry(2**63, [0, 0, 0]), "stamp: expected int64 nanoseconds, got 9223372036854775808"),
    (lambda t: t.add_odometry(at(2.0), [0, np.nan, 0]), "odometry pose: expected finite values, got 1 of 3 not finite"),
    (lambda t: t.add_odometry(at(2.0), [np.inf, 0, 0]), "odometry pose: expected finite values"),
    (lambda t: t.add_odometry(at(2.0), [0, 0]), "odometry pose: expected (3,), got (2,)"),
    (lambda t: t.add_odometry(at(2.0), [[0, 0, 0]]), "odometry pose: expected (3,), got (1, 3)"),
    (lambda t: t.add_odometry(at(2.0), "pose"), "odometry pose: expected (3,) numbers, got str"),
    (lambda t: t.add_odometry(at(2.0), [1e300, 0, 0]), "odometry pose: expected at most 1e+08, got 1e+300"),
    (lambda t: t.add_increment([1, 0, 0]), "increment: expected an OdometryIncrement, got list"),
    (lambda t: t.add_increment(OdometryIncrement(at(2.0), np.zeros(3), COVARIANCE)), "odometry: expected poses as"),
    (lambda t: t.add_increment(OdometryIncrement(0.5, np.zeros(3), COVARIANCE)), "stamp: expected int64 nanoseconds"),
    (lambda t: t.add_increment(OdometryIncrement(1, np.ones(3), 1e9 * COVARIANCE * 100)), "increment covariance: exp"),
    (lambda t: t.add_likelihood(None, t), "stamp: expected int64 nanoseconds, got NoneType"),
    (lambda t: t.add_likelihood(at(1.5), np.zeros((3, 3))), "likelihood: expected a PoseLikelihood, got ndarray"),
    (lambda t: t.add_likelihood(at(1.5), AlwaysNan(0)), "likelihood: expected one finite log density at one pose"),
    (lambda t: t.add_likelihood(at(1.5), Strange(np.nan)), "likelihood: expected 100 finite log densities"),
    (lambda t: t.add_likelihood(at(1.5), Strange(-np.inf)), "likelihood: expected 100 finite log densities"),
    (lambda t: t.add_likelihood(at(1.5), Strange(ValueError("two\nlines"))), "expected log densities, got ValueError"),
    (lambda t: t.estimate(at(-10.0)), "estimate: expected a stamp from"),
    (lambda t: t.estimate(1.0), "stamp: expected int64 nanoseconds, got float 1.0"),
    (lambda t: t.estimate(max_modes=1.5), "max_modes: expected a whole number >= 0, got 1.5"),
    (lambda t: t.estimate(max_modes=-1), "max_modes: expected a whole number >= 0, got -1"),
]


@pytest.mark.parametrize(("nonsense", "message"), NONSENSE)
def test_nonsense_is_one_line_and_leaves_everything_as_it_was(tmp_path, nonsense, message):
    one = tracker(100)
    feed(one, [m for m in streams(2.5) if m.stamp_ns not in (at(1.5), at(2.0))])
    one.save(tmp_path / "before.npz")
    with pytest.raises(SkyfixError, match=re.escape(message)) as caught:
        nonsense(one)
    assert "\n" not in str(caught.value)
    one.save(tmp_path / "after.npz")
    assert (tmp_path / "after.npz").read_bytes() == (tmp_path / "before.npz").read_bytes()


@pytest.mark.parametrize("bad", [Strange(np.nan), Strange(RuntimeError("no"))])
def test_a_waiting_likelihood_that_the_filter_refuses_is_given_up_and_counted(bad):
    clean, given = tracker(100), tracker(100)
    messages = streams(2.0)
    feed(clean, messages)
    feed(given, [m for m in messages if m.stamp_ns < at(1.5)])
    assert given.add_likelihood(at(1.51), bad).outcome is Outcome.WAITING
    arrivals = feed(given, [m for m in messages if m.stamp_ns >= at(1.5)])
    assert [a.lost_ns for a in arrivals if a.lost_ns] == [(at(1.51),)]
    assert given.statistics.rejected_likelihoods == 1
    np.testing.assert_array_equal(answers(given, [at(2.0)]), answers(clean, [at(2.0)]))


def test_there_is_no_estimate_before_odometry():
    one = tracker()
    one.add_likelihood(START, measurement(START, np.random.default_rng(0)))
    for asked in (None, START):
        with pytest.raises(SkyfixError, match="estimate: expected odometry before it, got none"):
            one.estimate(asked)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: tracker(seed=-1), "seed: expected a whole number >= 0, got -1"),
        (lambda: tracker(seed=0.5), "seed: expected a whole number >= 0, got 0.5"),
        (lambda: tracker(0), "particles: expected a whole number >= 1, got 0"),
        (lambda: TrackerSettings(history_s=0.0), "history_s: expected at least 1e-6, got 0.0"),
        (lambda: TrackerSettings(step_s=np.nan), "step_s: expected at least 1e-6, got nan"),
        (lambda: TrackerSettings(correlation_length_m=-1.0), "correlation_length_m: expected >= 0, got -1.0"),
        (lambda: TrackerSettings(max_waiting=0), "max_waiting: expected a whole number >= 1, got 0"),
        (lambda: TrackerSettings(clock_samples=2.5), "clock_samples: expected a whole number >= 1, got 2.5"),
    ],
)
def test_bad_settings_are_one_line(make, message):
    with pytest.raises(SkyfixError, match=re.escape(message)):
        make()


def test_extreme_but_legal_stamps_and_poses_do_no_harm():
    one = tracker(50)
    for stamp in (-(2**62), 0, 2**62, 2**63 - 1):
        for i in range(6):
            one.add_odometry(max(stamp - 5 + i, -(2**62)), [1e8 * (-1) ** i, -1e8, 1e8])
    assert np.isfinite(answers(one, [one.newest_ns])).all()
    far = GaussianLikelihood(np.array([1e6, 0.0, 0.0]), np.eye(3), GRID)
    one.add_likelihood(one.newest_ns, far)
    assert np.isfinite(answers(one, [one.newest_ns])).all()
