"""Odometry as it comes: gaps, resets, clocks that jump, and motions between any two times."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_streams import (
    SECOND,
    START,
    KalmanFilter,
    Message,
    answers,
    feed,
    measurement,
    odometry_at,
    shuffled,
    streams,
    truth_at,
)

from fusion import (
    MotionKind,
    OdometryIncrement,
    OdometryLimits,
    OdometryNoise,
    Outcome,
    SkyfixError,
    Tracker,
    TrackerSettings,
    Trajectory,
    UniformPrior,
    accumulate,
    increments_at,
    se2,
)
from fusion.tracking.odometry_buffer import BEGINNING, OdometryBuffer, OdometrySample

PRIOR = UniformPrior(np.zeros(3), 3.0, 0.2)
NOISE, LIMITS = OdometryNoise(), OdometryLimits()
HOUR = 3600 * SECOND


def tracker(**changed) -> Tracker:
    return Tracker.from_prior(PRIOR, 300, TrackerSettings(**changed), seed=1)


def kalman(**changed) -> Tracker:
    return Tracker(KalmanFilter(np.zeros(3), np.diag([1.0, 1.0, 0.01])), TrackerSettings(**changed))


def at(seconds: float) -> int:
    return START + round(seconds * SECOND)


def error_m(one: Tracker, stamp_ns: int | None = None, truth_ns: int | None = None) -> float:
    estimate = one.estimate(stamp_ns)
    truth = truth_at(estimate.stamp_ns if truth_ns is None else truth_ns)
    return float(np.linalg.norm(estimate.pose[:2] - truth[:2]))


def buffer(stamps, poses, limits=LIMITS) -> OdometryBuffer:
    made = OdometryBuffer(NOISE, limits)
    for stamp, pose in zip(stamps, poses, strict=True):
        made.insert(OdometrySample(int(stamp), np.asarray(pose, dtype=float)))
    return made


@settings(max_examples=30)
@given(st.permutations(range(12)), st.lists(st.integers(0, 1_099), min_size=2, max_size=5, unique=True))
def test_motions_are_those_of_the_whole_trajectory_however_it_arrived(order, asked_ms):
    stamps = np.array([START + i * SECOND // 10 for i in range(12)])
    poses = np.array([odometry_at(stamp) for stamp in stamps])
    held = buffer(stamps[order], poses[order])
    assert held.kind_counts[MotionKind.DRIVEN] == 11
    asked = np.array([START + ms * 1_000_000 for ms in sorted(asked_ms)])
    for start, expected in zip(
        asked, increments_at(asked, Trajectory(stamps, poses, None, "odometry"), NOISE), strict=False
    ):
        found = held.motion(int(start), expected.stamp_ns)
        assert found.stamp_ns == expected.stamp_ns
        np.testing.assert_allclose(found.delta, expected.delta, atol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-12)


@pytest.mark.parametrize(
    ("seconds", "delta", "kind"),
    [
        (0.1, [1.0, 0.0, 0.0], MotionKind.DRIVEN),
        (0.5, [30.0, 0.0, 1.0], MotionKind.DRIVEN),
        (0.6, [30.0, 0.0, 1.0], MotionKind.GAP),
        (10.0, [300.0, 0.0, 0.0], MotionKind.GAP),
        (11.0, [300.0, 0.0, 0.0], MotionKind.CLOCK_JUMP),
        (1e6, [601.0, 0.0, 0.0], MotionKind.RESET),
        (0.01, [1.2, 0.0, 0.0], MotionKind.RESET),
        (0.01, [0.0, 0.0, -0.2], MotionKind.RESET),
        (1e-9, [0.3, 0.3, 0.05], MotionKind.DRIVEN),
    ],
)
def test_kinds_of_motion(seconds, delta, kind):
    assert LIMITS.kind(np.array(delta), seconds) is kind


@pytest.mark.parametrize("gap_s", [3.0, 40.0])
@pytest.mark.parametrize("own_covariance", [None, np.diag([0.4, 0.2, 0.01])])
@pytest.mark.parametrize("end", [[20.0, 0.0, 0.0], [2000.0, 0.0, 0.0]])
def test_it_does_not_matter_into_how_many_pieces_a_motion_is_cut(gap_s, own_covariance, end):
    held = OdometryBuffer(NOISE, LIMITS)
    held.insert(OdometrySample(START, np.zeros(3), None if own_covariance is None else np.zeros((3, 3))))
    held.insert(OdometrySample(at(gap_s), np.array(end), own_covariance))
    cuts = [START, *(at(gap_s * share) for share in (0.1, 0.5, 0.7)), at(gap_s)]
    pieces = [held.motion(a, b) for a, b in pairwise(cuts)]
    whole = held.motion(START, at(gap_s))
    np.testing.assert_allclose(accumulate(pieces).delta, whole.delta, atol=1e-9)
    own = [sum(piece.covariance[i, i] for piece in pieces) for i in range(3)]
    # the heading of a gap also turns what comes after it: that is in `accumulate`, not in the motion itself
    np.testing.assert_allclose([own[0], own[2]], [whole.covariance[0, 0], whole.covariance[2, 2]], rtol=1e-6)


def test_a_motion_of_which_nothing_is_known_covers_all_that_the_vehicle_can_do():
    rng = np.random.default_rng(0)
    radius, way, turn = 30.5 * np.sqrt(rng.random(200_000)), rng.uniform(-np.pi, np.pi, 200_000), 0.1 + 3.0 * 0.5
    disc = np.column_stack([radius * np.cos(way), radius * np.sin(way), rng.uniform(-turn, turn, 200_000)])
    np.testing.assert_allclose(np.diag(LIMITS.reset_covariance(0.5)), np.var(disc, axis=0), rtol=0.02)


def test_late_odometry_between_two_samples_makes_a_gap_whole():
    stamps = [at(t) for t in (0.0, 0.1, 1.1, 1.2)]
    held = buffer(stamps, [odometry_at(stamp) for stamp in stamps])
    assert held.kind_counts[MotionKind.GAP] == 1
    assert held.insert(OdometrySample(at(0.6), odometry_at(at(0.6)))) == at(0.1)
    assert held.kind_counts[MotionKind.GAP] == 0
    assert held.insert(OdometrySample(at(-1.0), odometry_at(at(-1.0)))) == BEGINNING
    assert (held.kind_counts[MotionKind.GAP], held.kind_counts[MotionKind.START]) == (1, 1)


def test_measurements_in_a_gap_wait_until_odometry_covers_them():
    messages = streams(4.0)
    gap = (at(1.5), at(3.0))
    seen = tracker()
    arrivals = feed(seen, [m for m in messages if not m.is_odometry or not gap[0] < m.stamp_ns < gap[1]])
    waited = [a for a in arrivals if a.outcome is Outcome.WAITING and gap[0] < a.stamp_ns < gap[1]]
    assert [a.stamp_ns for a in waited] == [at(1.655), at(2.155), at(2.655)]
    (covering,) = [a for a in arrivals if a.stamp_ns == gap[1]]
    assert [one.stamp_ns for one in covering.measured] == [a.stamp_ns for a in waited]
    assert seen.statistics.gaps == 1
    assert seen.statistics.waiting == 0
    assert error_m(seen) < 1.0


def test_uncertainty_grows_with_the_time_of_a_gap():
    spreads = []
    for gap_s in (0.0, 1.0, 4.0):
        one = kalman()
        feed(one, [m for m in streams(5.0) if m.is_odometry and not 0.0 < m.stamp_ns - at(0.5) < gap_s * SECOND])
        spreads.append(one.estimate().covariance[0, 0])
        assert one.statistics.gaps == (gap_s > 0.0)
    assert spreads[0] + 0.9 < spreads[1]
    assert spreads[1] + 2.5 < spreads[2]


def test_beyond_odometry_the_velocity_is_held_for_a_while_and_the_covariance_grows():
    one = kalman()
    feed(one, [m for m in streams(4.0) if m.is_odometry])
    here = one.estimate()
    soon, later, last, lost = (one.estimate(here.stamp_ns + round(t * SECOND)) for t in (0.4, 0.8, 10.0, 60.0))
    moved = se2.between(here.pose, soon.pose)
    np.testing.assert_allclose(moved, se2.exp(0.4 * np.array([10.1, 0.0, 0.102])), atol=1e-6)
    np.testing.assert_allclose(se2.between(here.pose, later.pose)[:2], [8.08, 0.28], atol=0.05)
    # half a second of the turn, then straight on
    np.testing.assert_allclose(np.hypot(*(last.pose - later.pose)[:2]), 10.1 * 9.2, rtol=1e-3)
    np.testing.assert_array_equal(lost.pose, last.pose)
    spread = [np.sqrt(np.trace(e.covariance[:2, :2])) for e in (here, soon, later, last, lost)]
    assert (np.diff(spread) > 0.3).all()
    assert spread[3] > 30.0  # where cars in a town are 48 m from it, root mean square
    assert spread[4] > 400.0


def test_an_estimate_of_the_past_knows_nothing_of_what_came_after():
    early, all_of_it = tracker(), tracker()
    messages = streams(4.0)
    feed(early, [m for m in messages if m.stamp_ns <= at(3.1)])
    feed(all_of_it, messages)
    for asked in (at(2.55), at(2.9), at(3.1)):
        np.testing.assert_array_equal(answers(all_of_it, [asked]), answers(early, [asked]))


def restarting(messages: list[Message], when_ns: int) -> list[Message]:
    """The same streams from an odometry that begins anew at its origin."""
    back = se2.inverse(odometry_at(when_ns))
    return [
        Message(m.stamp_ns, se2.compose(back, m.content)) if m.is_odometry and m.stamp_ns >= when_ns else m
        for m in messages
    ]


def test_an_odometry_that_starts_anew_costs_certainty_not_the_position():
    messages = streams(6.0)
    smooth, restarted = tracker(), tracker()
    feed(smooth, messages)
    feed(restarted, restarting(messages, at(3.0)))
    assert restarted.statistics.resets == 1
    assert error_m(restarted, at(4.2)) < 1.5
    assert error_m(restarted) < 1.0

    before, after = tracker(), tracker()
    feed(before, [m for m in messages if m.stamp_ns <= at(3.0)])
    feed(after, [m for m in restarting(messages, at(3.0)) if m.stamp_ns <= at(3.0)])
    assert error_m(after) < 2.0  # not hundreds of metres away
    assert np.trace(after.estimate().covariance[:2, :2]) > np.trace(before.estimate().covariance[:2, :2]) + 1.0


def test_one_wild_pose_is_two_resets_and_the_way_goes_on():
    wild = [Message(m.stamp_ns, m.content + 500.0) if m.stamp_ns == at(3.0) else m for m in streams(6.0)]
    one = tracker()
    feed(one, wild)
    assert one.statistics.resets == 2
    assert error_m(one) < 1.0


def test_a_stray_stamp_far_ahead_is_dismissed():
    messages = streams(4.0)
    clean, strayed = tracker(), tracker()
    feed(clean, messages)
    for message in messages:
        feed(strayed, [message])
        if message.stamp_ns in (at(1.0), at(2.0)):
            (arrival,) = feed(strayed, [Message(message.stamp_ns + HOUR, message.content)])
            assert arrival.outcome is Outcome.WITHHELD
            assert strayed.statistics.withheld == 1
    assert strayed.statistics.dismissed_odometry == 2
    assert strayed.statistics.clock_jumps == 0
    at_ns = [at(3.0), at(4.0)]
    np.testing.assert_array_equal(answers(strayed, at_ns), answers(clean, at_ns))


@pytest.mark.parametrize("is_shuffled", [False, True])
@pytest.mark.parametrize("by_ns", [HOUR, 30 * SECOND, -30 * SECOND, -HOUR])
def test_a_clock_that_jumps_is_followed(by_ns, is_shuffled):
    messages = streams(9.0)
    delays = np.random.default_rng(0).integers(0, 200, len(messages)) * is_shuffled
    first, then = [m for m in messages if m.stamp_ns <= at(3.0)], [m for m in messages if m.stamp_ns > at(3.0)]
    then = shuffled([m.moved(by_ns) for m in then], delays[len(first) :])
    one = tracker()
    arrivals = feed(one, [*shuffled(first, delays[: len(first)]), *then])
    assert one.statistics.clock_jumps == 1
    assert one.newest_ns == max(m.stamp_ns for m in then)
    assert error_m(one, truth_ns=at(9.0)) < 1.2
    assert arrivals[-1].outcome is Outcome.USED
    assert sum(a.outcome is Outcome.WITHHELD for a in arrivals) == (4 if by_ns > 0 else 0)
    statistics = one.statistics
    assert statistics.too_late_odometry == 0  # they were used in the end
    used = statistics.likelihoods + statistics.too_late_likelihoods
    assert used == sum(not m.is_odometry for m in messages)


@pytest.mark.parametrize(
    ("by_s", "fault", "least", "most_m"),
    [(1.5, "gaps", 1, 1.2), (-1.0, "conflicts", 20, 1.5), (-1.013, "resets", 15, 3.0)],
)
def test_a_clock_that_jumps_within_the_history_costs_certainty(by_s, fault, least, most_m):
    """Set back by little, odometry seems to come late and to contradict itself: conflicts, or resets back and forth."""
    messages, by_ns = streams(12.0), round(by_s * SECOND)
    one = tracker()
    feed(one, [m.moved(by_ns) if m.stamp_ns > at(3.0) else m for m in messages])
    assert getattr(one.statistics, fault) >= least
    assert error_m(one, truth_ns=at(12.0)) < most_m


def test_a_clock_set_back_with_an_odometry_that_starts_anew_is_a_reset():
    messages = restarting(streams(9.0), at(3.05))
    one = tracker()
    feed(one, [m.moved(-HOUR) if m.stamp_ns > at(3.0) else m for m in messages])
    assert (one.statistics.resets, one.statistics.clock_jumps) == (1, 0)
    assert error_m(one, truth_ns=at(9.0)) < 1.5


def test_likelihoods_that_wait_are_bounded_and_the_first_to_arrive_goes():
    rng = np.random.default_rng(0)
    one = tracker(max_waiting=3)
    feed(one, [Message(START, odometry_at(START))])
    far = [one.add_likelihood(START + HOUR + i, measurement(START, rng)) for i in range(3)]  # from another clock
    assert {a.outcome for a in far} == {Outcome.WAITING}
    near = [one.add_likelihood(at(0.1 * i), measurement(at(0.1 * i), rng)) for i in (3, 1, 2, 4)]
    assert [a.lost_ns for a in near] == [(START + HOUR,), (START + HOUR + 1,), (START + HOUR + 2,), (at(0.3),)]
    assert one.statistics.overflowed_likelihoods == 4
    (covering,) = feed(one, [Message(at(0.45), odometry_at(at(0.45)))])
    assert [one.stamp_ns for one in covering.measured] == [at(0.1), at(0.2), at(0.4)]


def test_a_measurement_before_all_odometry_is_used_if_odometry_still_comes_and_given_up_if_not():
    rng = np.random.default_rng(0)
    for late in (True, False):
        one = tracker()
        feed(one, [Message(at(0.5), odometry_at(at(0.5)))])
        assert one.add_likelihood(at(0.2), measurement(at(0.2), rng)).outcome is Outcome.WAITING
        if late:
            (arrival,) = feed(one, [Message(START, odometry_at(START))])
            assert [m.stamp_ns for m in arrival.measured] == [at(0.2)]
        arrivals = feed(one, [Message(at(t), odometry_at(at(t))) for t in (1.0, 2.1, 2.3, 2.5)])
        assert [a.lost_ns for a in arrivals if a.lost_ns] == ([] if late else [(at(0.2),)])
        assert one.statistics.uncovered_likelihoods == (not late)


@pytest.mark.parametrize(
    "entry", ["gap_s", "clock_jump_s", "max_speed_m_per_s", "max_turn_rad_per_s", "gap_position_m_per_sqrt_s"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_limits_must_be_positive(entry, value):
    with pytest.raises(SkyfixError, match=f"odometry limits {entry}: expected > 0, got"):
        OdometryLimits(**{entry: value})


def test_a_clock_jump_is_no_shorter_than_a_gap():
    with pytest.raises(SkyfixError, match=r"odometry limits clock_jump_s: expected >= gap_s 2.0, got 1.0"):
        OdometryLimits(gap_s=2.0, clock_jump_s=1.0)


def test_increments_that_cannot_be_are_resets_too():
    one = tracker()
    for i in range(20):
        delta = np.array([900.0 if i == 10 else 0.5, 0.0, 0.0])
        one.add_increment(OdometryIncrement(at(0.05 * i), delta, np.diag([0.01, 0.01, 1e-4])))
    assert one.statistics.resets == 1
    assert abs(one.estimate().pose[0] - 9.0) < 2.5
