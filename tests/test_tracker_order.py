"""The order in which messages arrive does not matter: late, shuffled and doubled they give the same estimates."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_streams import (
    SECOND,
    SIGMA,
    START,
    KalmanFilter,
    Message,
    answers,
    feed,
    measurement,
    odometry_at,
    shuffled,
    streams,
)

from fusion import (
    OdometryIncrement,
    OdometryNoise,
    Outcome,
    Tracker,
    TrackerSettings,
    Trajectory,
    UniformPrior,
    increments_at,
    se2,
)
from fusion.consistency import error_correlation
from fusion.error_memory import ErrorMemory

PRIOR = UniformPrior(np.zeros(3), 5.0, 0.3)
SETTINGS = TrackerSettings(correlation_length_m=4.0)
SECONDS = 3.0
ASKED = [START + round(t * SECOND) for t in (1.21, 1.5, 2.0, 2.155, 2.777, 3.0, 3.2)]


def tracker(particles: int = 60, seed: int = 0, **changed: float) -> Tracker:
    return Tracker.from_prior(PRIOR, particles, TrackerSettings(correlation_length_m=4.0, **changed), seed=seed)


@cache
def drive(is_faulty: bool = False) -> list[Message]:
    """A short drive; a faulty one has a gap, and an odometry that starts anew."""
    messages = streams(SECONDS)
    if not is_faulty:
        return messages
    restarted = START + round(2.3 * SECOND)
    kept = [m for m in messages if not m.is_odometry or not 1.2 < (m.stamp_ns - START) / SECOND < 1.9]
    back = se2.inverse(odometry_at(restarted))
    return [
        Message(m.stamp_ns, se2.compose(back, m.content)) if m.is_odometry and m.stamp_ns >= restarted else m
        for m in kept
    ]


@cache
def in_order(is_faulty: bool) -> np.ndarray:
    whole = tracker()
    feed(whole, drive(is_faulty))
    assert whole.statistics.late_odometry == 0
    assert (whole.statistics.gaps, whole.statistics.resets) == ((1, 1) if is_faulty else (0, 0))
    return answers(whole, ASKED)


@pytest.mark.parametrize("is_faulty", [False, True])
@settings(max_examples=8)
@given(data=st.data())
def test_messages_late_by_up_to_half_a_second_count_as_in_order(is_faulty: bool, data: st.DataObject) -> None:
    messages = drive(is_faulty)
    count = len(messages)
    delays = data.draw(st.lists(st.integers(0, 500), min_size=count, max_size=count))
    late = tracker()
    feed(late, shuffled(messages, delays))
    assert late.statistics.odometry + late.statistics.likelihoods == count
    np.testing.assert_allclose(answers(late, ASKED), in_order(is_faulty), rtol=0.0, atol=1e-9)


@settings(max_examples=8)
@given(st.randoms(use_true_random=False))
def test_any_order_at_all_does_when_the_history_covers_it(random) -> None:
    messages = drive()[:24]
    order = list(messages) * 2  # every message comes twice
    random.shuffle(order)
    whole, mixed = tracker(history_s=10.0), tracker(history_s=10.0)
    feed(whole, messages)
    feed(mixed, order)
    at = [m.stamp_ns for m in messages if m.is_odometry]
    np.testing.assert_allclose(answers(mixed, at), answers(whole, at), rtol=0.0, atol=1e-9)
    assert mixed.statistics.duplicates == len(messages)
    assert mixed.statistics.conflicts == 0


def test_asking_changes_nothing() -> None:
    quiet, asked = tracker(), tracker()
    feed(quiet, drive())
    for message in drive():
        feed(asked, [message])
        for stamp in (asked.newest_ns, asked.newest_ns + SECOND // 3, max(START, asked.newest_ns - SECOND // 2)):
            asked.estimate(stamp, max_modes=2)
    np.testing.assert_array_equal(answers(asked, ASKED), answers(quiet, ASKED))


def test_the_seed_decides() -> None:
    results = []
    for seed in (1, 1, 2):
        one = tracker(seed=seed)
        feed(one, drive())
        results.append(answers(one, ASKED))
    np.testing.assert_array_equal(results[0], results[1])
    assert not np.allclose(results[1], results[2])


def by_hand(messages: list[Message], step_ns: int) -> KalmanFilter:
    """The same drive without a tracker: everything sorted, odometry interpolated with `increments_at`."""
    odometry = [m for m in messages if m.is_odometry]
    path = Trajectory(
        np.array([m.stamp_ns for m in odometry]), np.array([m.content for m in odometry]), None, "odometry"
    )
    measured = {m.stamp_ns: m.content for m in messages if not m.is_odometry}
    steps = [
        s for before, s in zip(path.stamp_ns, path.stamp_ns[1:], strict=False) if s // step_ns != before // step_ns
    ]
    nodes = np.unique([path.stamp_ns[0], *steps, *measured, path.stamp_ns[-1]])
    kalman, distance, memory = KalmanFilter(np.zeros(3), np.diag([5.0, 5.0, 0.1])), None, ErrorMemory()
    for increment in increments_at(nodes, path, OdometryNoise()):
        kalman.predict(increment)
        distance = None if distance is None else distance + np.hypot(*increment.delta[:2])
        if increment.stamp_ns in measured:
            correlation = 0.0 if distance is None else error_correlation(distance, 4.0)
            before = kalman.estimate(0).covariance
            temperature = memory.temperature(correlation, before)
            kalman.update(measured[increment.stamp_ns], temperature)
            memory = memory.after(correlation, temperature, before, kalman.estimate(0).covariance)
            distance = 0.0
    return kalman


@settings(max_examples=15)
@given(st.lists(st.integers(0, 500), min_size=len(drive()), max_size=len(drive())))
def test_a_shuffled_stream_gives_what_a_sorted_loop_gives(delays: list[int]) -> None:
    """Against a loop with no tracker in it, and a filter that is not the particle filter."""
    late = Tracker(KalmanFilter(np.zeros(3), np.diag([5.0, 5.0, 0.1])), SETTINGS)
    feed(late, shuffled(drive(), delays))
    expected = by_hand(drive(), SETTINGS.step_ns).estimate(0)
    found = late.estimate()
    np.testing.assert_allclose(found.pose, expected.pose, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("late_by", [0.5, 1.5])
def test_a_late_measurement_counts_in_full_and_says_what_was_done_again(late_by: float) -> None:
    messages = streams(4.0)
    held_back = next(m for m in messages if not m.is_odometry and m.stamp_ns > START + round((4.0 - late_by) * SECOND))
    whole, late = tracker(), tracker()
    feed(whole, messages)
    feed(late, [m for m in messages if m is not held_back])
    assert not np.array_equal(late.estimate().pose, whole.estimate().pose)
    (arrival,) = feed(late, [held_back])
    assert arrival.outcome is Outcome.USED
    assert arrival.replayed > 0
    assert arrival.measured[0].stamp_ns == held_back.stamp_ns
    assert late.statistics.late_likelihoods == 1
    np.testing.assert_array_equal(answers(late, ASKED[4:]), answers(whole, ASKED[4:]))


@settings(max_examples=10)
@given(st.sets(st.integers(0, 60), min_size=1, max_size=25))
def test_what_is_too_late_is_counted_and_harms_nothing(indices: set[int]) -> None:
    messages = streams(4.0, hertz=10.0)
    held_back = [messages[i] for i in sorted(indices) if i < len(messages)]
    odometry = [m for m in held_back if m.is_odometry]
    held_back = [m for m in held_back if m not in odometry[4:]]  # five in a row would be a clock that was set back
    others = [m for m in messages if m not in held_back]
    newest = max(m.stamp_ns for m in others if m.is_odometry)
    late = [m for m in held_back if m.stamp_ns <= newest - SECOND]
    without, given_late = tracker(30, history_s=1.0), tracker(30, history_s=1.0)
    feed(without, [*others, *(m for m in held_back if m not in late)])
    feed(given_late, others)
    arrivals = feed(given_late, [m for m in held_back if m in late])
    feed(given_late, [m for m in held_back if m not in late])
    assert {a.outcome for a in arrivals} <= {Outcome.TOO_LATE}
    assert given_late.statistics.too_late_odometry == sum(m.is_odometry for m in late)
    assert given_late.statistics.too_late_likelihoods == sum(not m.is_odometry for m in late)
    at = [newest - SECOND // 2, newest]
    np.testing.assert_array_equal(answers(given_late, at), answers(without, at))


def test_duplicates_are_ignored_and_of_conflicts_the_first_is_kept() -> None:
    messages = drive()
    once, twice = tracker(), tracker()
    feed(once, messages)
    rng = np.random.default_rng(9)
    for message in messages:
        feed(twice, [message])
        same = feed(twice, [Message(message.stamp_ns, message.content)])
        assert same[0].outcome is Outcome.DUPLICATE
        other = message.content + 1.0 if message.is_odometry else measurement(message.stamp_ns, rng)
        assert feed(twice, [Message(message.stamp_ns, other)])[0].outcome is Outcome.CONFLICT
    assert (twice.statistics.duplicates, twice.statistics.conflicts) == (len(messages), len(messages))
    np.testing.assert_array_equal(answers(twice, ASKED), answers(once, ASKED))


def test_increments_instead_of_poses_may_be_shuffled_too() -> None:
    messages, noise = drive(), OdometryNoise()
    odometry = [m for m in messages if m.is_odometry]
    increments = {odometry[0].stamp_ns: OdometryIncrement(odometry[0].stamp_ns, np.zeros(3), np.zeros((3, 3)))}
    for before, after in pairwise(odometry):
        delta = se2.between(before.content, after.content)
        covariance = noise.covariance(delta, (after.stamp_ns - before.stamp_ns) / SECOND)
        increments[after.stamp_ns] = OdometryIncrement(after.stamp_ns, delta, covariance)

    def given(order: list[Message]) -> Tracker:
        one = Tracker(KalmanFilter(np.zeros(3), np.diag([5.0, 5.0, 0.1])), SETTINGS)
        for message in order:
            if message.is_odometry:
                one.add_increment(increments[message.stamp_ns])
            else:
                one.add_likelihood(message.stamp_ns, message.content)
        return one

    rng = np.random.default_rng(1)
    whole = given(messages)
    late = given(shuffled(messages, rng.integers(0, 500, len(messages))))
    np.testing.assert_array_equal(answers(late, ASKED), answers(whole, ASKED))
    poses = by_hand(messages, SETTINGS.step_ns).estimate(0)
    found = whole.estimate()
    sigma = np.sqrt(np.diag(poses.covariance))
    assert (np.abs(found.pose - poses.pose) < 0.05 * sigma).all()  # chords of the curve against many short motions
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(poses.covariance), rtol=0.05)
    assert (0.5 * sigma < SIGMA).all()
