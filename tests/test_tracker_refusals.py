"""Odometry that the filter cannot take raises and leaves the tracker as it was, so that what follows is not harmed."""

from __future__ import annotations

import numpy as np
import pytest
from made_streams import SECOND, START, KalmanFilter, answers, measurement

from fusion import OdometryIncrement, ParticleFilter, SkyfixError, Tracker, TrackerSettings, UniformPrior

SETTINGS = TrackerSettings(history_s=1.0, step_s=0.1, correlation_length_m=5.0)
REFUSED = 1e6
ASKED = [START + round(t * SECOND) for t in (2.3, 2.7, 3.0, 3.5)]


class TouchyParticles(ParticleFilter):
    """Takes no motion that is as good as unknown, and notices when it is too late."""

    def predict(self, increment):
        super().predict(increment)
        if increment.covariance.max() >= REFUSED:
            raise SkyfixError("covariance: expected finite values, got others")


class TouchyKalman(KalmanFilter):
    """The same, with another library's error."""

    def predict(self, increment):
        super().predict(increment)
        if increment.covariance.max() >= REFUSED:
            raise np.linalg.LinAlgError("did not converge")


class FirstRefused(KalmanFilter):
    """Cannot say its state the second time that it is asked, which is at the first sample."""

    asked = 0

    def state(self):
        self.asked += 1
        if self.asked == 2:
            raise SkyfixError("state: not yet")
        return super().state()


def tracker(kind):
    if issubclass(kind, KalmanFilter):
        return Tracker(kind(np.zeros(3), np.eye(3)), SETTINGS)
    return Tracker(TouchyParticles.from_prior(UniformPrior(np.zeros(3), 5.0, 0.3), 60, 0), SETTINGS)


def increment(stamp_ns, variance=1e-3):
    return OdometryIncrement(stamp_ns, np.array([0.5, 0.0, 0.005]), variance * np.eye(3))


def drive(one, refused_s):
    """Three seconds of odometry, measurements among it, and after each sample those refused that are due then."""
    rng = np.random.default_rng(1)
    for i in range(61):
        stamp = START + i * SECOND // 20
        one.add_increment(increment(stamp))
        if i % 10 == 7:
            one.add_likelihood(stamp - SECOND // 50, measurement(stamp - SECOND // 50, rng))
        for late_s in refused_s.get(i, []):
            before = one.statistics
            with pytest.raises((SkyfixError, np.linalg.LinAlgError)):
                one.add_increment(increment(stamp - round(late_s * SECOND), 2.0 * REFUSED))
            assert one.statistics == before


@pytest.mark.parametrize("kind", [TouchyParticles, TouchyKalman])
def test_refused_increments_leave_no_trace(tmp_path, kind):
    """In time, late, before a measurement that was used, and several in a row."""
    harmed, spared = tracker(kind), tracker(kind)
    drive(harmed, {5: [-0.1], 17: [0.33, -0.1, -0.1], 30: [0.71, 0.021], 60: [0.51, -0.4]})
    drive(spared, {})
    assert harmed.statistics == spared.statistics
    np.testing.assert_array_equal(answers(harmed, ASKED), answers(spared, ASKED))
    harmed.save(tmp_path / "harmed")
    spared.save(tmp_path / "spared")
    assert (tmp_path / "harmed").read_bytes() == (tmp_path / "spared").read_bytes()


@pytest.mark.parametrize("kind", [TouchyParticles, TouchyKalman])
def test_what_only_the_next_step_can_refuse_is_given_up_then(kind):
    """It comes between two steps and is believed at first; the one after it raises, and all that follow are used."""
    harmed, spared = tracker(kind), tracker(kind)
    drive(harmed, {})
    drive(spared, {})
    harmed.add_increment(increment(START + 3 * SECOND + SECOND // 100, 2.0 * REFUSED))
    with pytest.raises((SkyfixError, np.linalg.LinAlgError)):
        harmed.add_increment(increment(START + 3 * SECOND + SECOND // 5))
    assert harmed.statistics.dismissed_odometry == 1
    assert harmed.statistics.held_odometry == spared.statistics.held_odometry
    for i in range(5, 15):
        for one in (harmed, spared):
            one.add_increment(increment(START + 3 * SECOND + i * SECOND // 20))
    np.testing.assert_array_equal(answers(harmed, ASKED[2:]), answers(spared, ASKED[2:]))


def test_a_first_increment_that_is_refused_does_not_decide_what_odometry_is():
    one = tracker(FirstRefused)
    with pytest.raises(SkyfixError, match="not yet"):
        one.add_increment(increment(START))
    assert one.statistics.held_odometry == one.statistics.odometry == 0
    one.add_odometry(START, np.zeros(3))
    assert one.newest_ns == START


@pytest.mark.parametrize("ahead", [True, False])
def test_a_run_on_another_clock_that_is_refused_is_given_up_and_the_next_one_believed(ahead):
    """A refused sample in a run must not hold up every sample after it."""
    one = tracker(TouchyKalman)
    drive(one, {})
    first = START + (60 if ahead else -60) * SECOND
    held, stamps = one.statistics, [first + i * SECOND // 20 for i in range(200)]
    refusals = 0
    for i, stamp in enumerate(stamps):
        try:
            one.add_increment(increment(stamp, 2.0 * REFUSED if i == 2 else 1e-3))
        except np.linalg.LinAlgError:
            refusals += 1
            statistics = one.statistics
            assert statistics.held_odometry == held.held_odometry
            assert statistics.odometry == held.odometry
            assert statistics.withheld == 0
            assert statistics.dismissed_odometry == (SETTINGS.clock_samples - 1 if ahead else 0)
    assert refusals == 1
    assert one.newest_ns == stamps[-1]
    assert np.isfinite(one.estimate().pose).all()
