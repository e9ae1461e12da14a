"""Gaps and jumps of a recorded odometry: found by its own rate and speeds, and told as one that arrives would be."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_drive import EmulatedMatcher, MadeDrive

from fusion import MotionKind, OdometryLimits, OdometryNoise, SkyfixError, Trajectory, increments_at, se2
from fusion.odometry_doubts import OdometryDoubts, believed_odometry
from fusion.tracking.odometry_buffer import OdometryBuffer, OdometrySample
from sequences.drive import load_drive
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.run_directory import write_run
from sequences.track_settings import TrackSettings
from sequences.trajectory_io import write_tum

SECOND, TENTH = 1_000_000_000, 100_000_000
NOISE, LIMITS = OdometryNoise(), OdometryLimits()


def winding(count: int, step_ns: int = TENTH, speed: float = 8.0) -> Trajectory:
    """An odometry at a constant speed through bends."""
    times = np.arange(count) * step_ns * 1e-9
    yaw = 0.5 * np.sin(0.4 * times)
    steps = speed * step_ns * 1e-9 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return Trajectory(np.arange(count) * step_ns, np.column_stack([np.cumsum(steps, axis=0), yaw]), None, "odometry")


def straight_on(count: int) -> Trajectory:
    """The same without bends."""
    return Trajectory(np.arange(count) * TENTH, np.arange(count)[:, None] * [0.8, 0.0, 0.0], None, "odometry")


def jumping(odometry: Trajectory, at: int, delta: list[float]) -> Trajectory:
    """The same with a motion into one sample that the vehicle never made."""
    poses = odometry.poses.copy()
    there = se2.compose(poses[at - 1], np.array(delta))
    poses[at:] = se2.compose(there, se2.between(poses[at], poses[at:]))
    return Trajectory(odometry.stamp_ns, poses, None, "odometry")


def without(odometry: Trajectory, begin: int, end: int) -> Trajectory:
    """The same without some of its samples."""
    kept = np.r_[0:begin, end : len(odometry)]
    return Trajectory(odometry.stamp_ns[kept], odometry.poses[kept], None, "odometry")


def test_an_odometry_without_faults_is_left_as_it_is():
    odometry = winding(300)
    motion, doubts = believed_odometry(odometry, LIMITS)
    assert motion is odometry
    assert (len(doubts), str(doubts)) == (0, "nothing doubtful")
    np.testing.assert_array_equal(doubts.between(odometry.stamp_ns), np.zeros((299, 3, 3)))


@pytest.mark.parametrize("delta", [[300.0, 0.0, 0.0], [-3.0, 2.0, 0.1], [0.8, 0.0, 1.5]])
def test_a_jump_is_taken_out_and_everything_else_stays(delta):
    odometry = winding(300)
    spoiled = jumping(odometry, 120, delta)
    motion, doubts = believed_odometry(spoiled, LIMITS)
    moved, true = (se2.between(one.poses[:-1], one.poses[1:]) for one in (motion, odometry))
    np.testing.assert_allclose(np.delete(moved, 119, axis=0), np.delete(true, 119, axis=0), atol=1e-9)
    np.testing.assert_allclose(moved[119], 0.0, atol=1e-9)
    assert doubts.kinds == (MotionKind.RESET,)
    np.testing.assert_array_equal(doubts.spans_ns, [[119 * TENTH, 120 * TENTH]])
    # the vehicle went 0.8 m meanwhile, in half a standard deviation's reach
    assert doubts.covariances[0, 0, 0] > 0.8**2
    assert str(doubts) == "jumps 1 x, faster than the vehicle can go (not believed)"


def test_a_gap_keeps_its_motion_and_costs_certainty_where_it_is():
    spoiled = without(straight_on(300), 100, 140)
    motion, doubts = believed_odometry(spoiled, LIMITS)
    assert motion is spoiled
    assert doubts.kinds == (MotionKind.GAP,)
    assert doubts.seconds(MotionKind.GAP) == pytest.approx(4.1)
    assert str(doubts) == "1 x without odometry, 4.1 s in all (bridged, with less certainty)"
    stamps = np.array([0, 50, 99, 110, 130, 140, 200]) * TENTH
    added = doubts.between(stamps)
    np.testing.assert_allclose(added.sum(axis=0), LIMITS.gap_covariance(4.1), rtol=1e-12)
    assert (added[[0, 1, 5]] == 0.0).all()
    np.testing.assert_allclose(added[3], 20 / 41 * LIMITS.gap_covariance(4.1), rtol=1e-12)
    np.testing.assert_array_equal(doubts.later(1.5).between(stamps + 15 * TENTH), added)


def test_a_gap_across_which_a_vehicle_at_speed_has_not_moved_says_that_the_motion_was_missed():
    straight = straight_on(300)
    spoiled = without(jumping(straight, 140, [0.1 - 0.8 * 40, 0.0, 0.0]), 100, 140)  # 0.1 m from the last sample
    _, doubts = believed_odometry(spoiled, LIMITS)
    usual = LIMITS.gap_covariance(4.1)
    half_m = 0.5 * (8.0 * 4.1 - 0.1)
    np.testing.assert_allclose(doubts.covariances[0] - usual, np.diag([half_m**2, half_m**2, 0.0]), atol=1e-9)
    for_real = without(straight, 100, 140)
    _, doubts = believed_odometry(for_real, LIMITS)
    np.testing.assert_allclose(doubts.covariances[0], usual, atol=1e-12)
    braking = np.cumsum(np.repeat([0.8, 0.01], [100, 200]))[:, None] * [1.0, 0.0, 0.0]  # it creeps from the gap on
    _, doubts = believed_odometry(without(Trajectory(straight.stamp_ns, braking), 100, 140), LIMITS)
    half_m = 0.5 * (0.5 * (8.0 + 0.1) * 4.1 - 0.41)
    assert doubts.covariances[0, 0, 0] - usual[0, 0] == pytest.approx(half_m**2)
    stood = np.zeros((300, 3))
    _, doubts = believed_odometry(without(Trajectory(straight.stamp_ns, stood), 100, 140), LIMITS)
    np.testing.assert_allclose(doubts.covariances[0], usual, rtol=1e-12)


def test_a_pose_that_is_repeated_where_a_vehicle_at_speed_cannot_have_stopped_is_a_gap():
    straight = straight_on(300)
    for catches_up in (True, False):
        poses = straight.poses.copy()
        poses[101:141] = poses[100]
        poses[141:] -= 0.0 if catches_up else [0.8 * 40, 0.0, 0.0]
        frozen = Trajectory(straight.stamp_ns, poses, None, "odometry")
        motion, doubts = believed_odometry(frozen, LIMITS)
        np.testing.assert_array_equal(motion.poses, np.delete(poses, range(101, 141), axis=0))
        assert doubts.kinds == (MotionKind.GAP,)
        np.testing.assert_array_equal(doubts.spans_ns, [[100 * TENTH, 141 * TENTH]])
        spread_m = np.sqrt(doubts.covariances[0, 0, 0])
        assert (spread_m < 4.0) if catches_up else (spread_m > 16.0)  # of the 33 m that it drove


def test_a_gap_across_which_it_went_further_than_its_speeds_may_be_a_new_start():
    apart = without(jumping(straight_on(300), 140, [60.0, 0.0, 0.0]), 101, 140)
    _, doubts = believed_odometry(apart, LIMITS)
    assert doubts.kinds == (MotionKind.GAP,)
    half_m = 0.5 * (0.8 * 39 + 60.0 - 8.0 * 4.0)
    assert doubts.covariances[0, 0, 0] - LIMITS.gap_covariance(4.0)[0, 0] == pytest.approx(half_m**2)


def test_a_jump_that_makes_up_for_a_frozen_pose_is_a_gap_even_where_the_vehicle_is_slow():
    slow = along(np.full(600, 1.2), 10.0)
    poses = slow.poses.copy()
    poses[101:241] = poses[100]  # 14 s, then 16.9 m at once
    motion, doubts = believed_odometry(Trajectory(slow.stamp_ns, poses, None, "odometry"), LIMITS)
    assert doubts.kinds == (MotionKind.GAP,)
    np.testing.assert_allclose(motion.interpolate(slow.stamp_ns), slow.poses, atol=1e-9)
    poses[241:] += [30.0, 0.0, 0.0]  # but this is not where it would be
    motion, doubts = believed_odometry(Trajectory(slow.stamp_ns, poses, None, "odometry"), LIMITS)
    assert doubts.kinds == (MotionKind.RESET,)


def along(speeds: np.ndarray, hertz: float, step_m: float = 0.0) -> Trajectory:
    """Straight on at speeds, told in steps of a length."""
    way = np.cumsum(speeds / hertz)
    way = np.floor(way / step_m) * step_m if step_m else way
    stamps = np.round(np.arange(len(speeds)) * SECOND / hertz).astype(np.int64)
    return Trajectory(stamps, way[:, None] * [1.0, 0.0, 0.0], None, "odometry")


ORDINARY = {
    "a robot, in steps of 1 cm": along(np.full(2400, 0.3), 20.0, 0.01),
    "a robot, in steps of 10 cm": along(np.full(2400, 0.3), 20.0, 0.1),
    "stop and go at 50 Hz, in steps of 10 cm": along(
        np.maximum(0.0, 5.0 + 5.0 * np.sin(np.arange(6000) / 400)), 50, 0.1
    ),
    "braked hard, in steps of 1 cm": along(np.clip(10.0 - 0.12 * np.arange(1000), 0.0, 10.0), 50.0, 0.01),
    "a robot that stops dead": along(np.repeat([0.8, 0.0, 0.8], 1000), 50.0),
    "one pose a second": along(np.maximum(0.0, 8.0 + 8.0 * np.sin(np.arange(300) / 15)), 1.0),
    "one pose a second told ten times": along(np.full(600, 10.0), 10.0, 10.0),
    "a robot that stops dead from 3 m/s": along(np.repeat([3.0, 0.0, 3.0], 100), 10.0),
    "reversing": along(2.0 * np.cos(np.arange(600) / 50), 10.0),
    "standing": along(np.zeros(100), 10.0),
}


@pytest.mark.parametrize("name", ORDINARY)
def test_an_odometry_that_is_only_coarse_slow_or_halting_is_believed(name):
    motion, doubts = believed_odometry(ORDINARY[name], LIMITS)
    assert str(doubts) == "nothing doubtful"
    moved = motion.interpolate(ORDINARY[name].stamp_ns)[:, 0] - ORDINARY[name].poses[:, 0]
    assert np.abs(moved).max() <= (10.0 if "ten times" in name else 0.0)  # which is interpolated between its poses


@pytest.mark.parametrize(("published", "computed", "speed"), [(50, 10, 8.0), (50, 10, 15.0), (200, 20, 25.0)])
def test_an_odometry_that_is_published_more_often_than_computed_goes_on_between_its_poses(published, computed, speed):
    smooth = along(np.full(20 * published, speed), published)
    held = Trajectory(smooth.stamp_ns, smooth.poses[np.arange(len(smooth)) // computed * computed], None, "odometry")
    motion, doubts = believed_odometry(held, LIMITS)
    assert str(doubts) == "nothing doubtful"
    off_m = np.abs(motion.interpolate(smooth.stamp_ns)[:, 0] - smooth.poses[:, 0])[: -2 * computed]
    assert off_m.max() <= speed * computed / published


@pytest.mark.parametrize("speed", [2.0, 8.0, 15.0])
def test_a_slow_odometry_that_is_published_often_goes_on_between_its_poses(speed):
    smooth = along(np.full(600, speed), 10.0)
    held = Trajectory(smooth.stamp_ns, smooth.poses[np.arange(600) // 10 * 10], None, "odometry")  # one a second
    motion, doubts = believed_odometry(held, LIMITS)
    assert str(doubts) == "nothing doubtful"
    assert np.abs(motion.interpolate(smooth.stamp_ns)[:, 0] - smooth.poses[:, 0]).max() <= speed


@settings(max_examples=60)
@given(
    st.sampled_from([5.0, 10.0, 20.0, 50.0, 200.0]),
    st.floats(0.0, 1.0),
    st.floats(1.0, 28.0),
    st.sampled_from([0.0, 0.1, 0.3]),
    st.integers(0, 2**32 - 1),
)
def test_whatever_a_car_does_is_believed_however_often_it_is_told(published, ratio, speed, jitter, seed):
    """At most 28 m/s and 6 m/s^2; computed as often as published or down to once a second; stamps jitter."""
    rng = np.random.default_rng(seed)
    computed = 1.0 + ratio * (published - 1.0)
    times = np.arange(round(30 * published)) / published
    fine = np.arange(0.0, 31.0, 0.005)
    pushed = np.interp(fine, np.arange(31), np.clip(rng.normal(0.0, 2.0, 31), -6.0, 6.0))
    way = np.cumsum(0.005 * np.clip(speed + np.cumsum(0.005 * pushed), 0.0, 28.0))
    known = np.floor(times * computed) / computed if ratio < 1.0 else times
    stamps = np.round(1e9 * (times + jitter / published * rng.uniform(-1.0, 1.0, len(times)))).astype(np.int64)
    told = Trajectory(stamps, np.interp(known, fine, way)[:, None] * [1.0, 0.0, 0.0], None, "odometry")
    motion, doubts = believed_odometry(told, LIMITS)
    assert doubts.count(MotionKind.RESET) == 0
    off_m = np.abs(motion.interpolate(stamps)[:, 0] - np.interp(times, fine, way))[times < 30.0 - 2.0 / computed]
    assert off_m.max() <= 28.0 * (1.0 / computed + 1.5 / published)


@given(st.floats(0.0, 0.3), st.integers(0, 2**32 - 1))
def test_noise_at_a_standstill_is_no_jump(sigma_m, seed):
    speeds = np.repeat([0.0, 8.0, 0.0], [800, 100, 100])
    poses = along(speeds, 10.0).poses + np.random.default_rng(seed).normal(0.0, 0.3 * sigma_m, (1000, 3)) * [1, 1, 0]
    _, doubts = believed_odometry(Trajectory(np.arange(1000) * TENTH, poses, None, "odometry"), LIMITS)
    assert doubts.count(MotionKind.RESET) == 0


def test_a_vehicle_that_brakes_and_stands_is_believed():
    speeds = np.concatenate([np.full(80, 8.0), np.linspace(8.0, 0.0, 25), np.zeros(100), np.linspace(0.0, 8.0, 25)])
    stopping = Trajectory(np.arange(230) * TENTH, np.cumsum(0.1 * speeds)[:, None] * [1.0, 0.0, 0.0], None, "odometry")
    motion, doubts = believed_odometry(stopping, LIMITS)
    assert motion is stopping
    assert len(doubts) == 0
    poses = stopping.poses.copy()
    poses[40:44] = poses[40]  # three tenths of a second: it goes on between its poses, which looks like no jump
    motion, doubts = believed_odometry(Trajectory(stopping.stamp_ns, poses, None, "odometry"), LIMITS)
    assert len(doubts) == 0
    np.testing.assert_allclose(motion.interpolate(stopping.stamp_ns), stopping.poses, atol=1e-9)


@pytest.mark.parametrize("inside", [slice(200, 300), slice(0, 100)])
def test_an_odometry_that_ends_or_begins_frozen_still_covers_its_time(inside):
    straight = straight_on(300)
    poses = straight.poses.copy()
    poses[inside] = poses[inside][0]
    motion, doubts = believed_odometry(Trajectory(straight.stamp_ns, poses, None, "odometry"), LIMITS)
    assert motion.span_ns == straight.span_ns
    assert doubts.kinds == (MotionKind.GAP,)
    assert doubts.seconds(MotionKind.GAP) == pytest.approx(10.0, abs=0.2)


@given(
    st.integers(20, 60),
    st.integers(1, 40),
    st.integers(70, 110),
    st.lists(st.integers(0, 119), min_size=2, max_size=9, unique=True),
)
def test_a_recording_says_what_the_same_odometry_says_while_it_arrives(gap_at, gap_length, jump_at, asked):
    spoiled = without(jumping(winding(120), jump_at, [-40.0, 3.0, 1.0]), gap_at, min(gap_at + gap_length, 65))
    held = OdometryBuffer(NOISE, LIMITS.fitted(spoiled))
    for stamp, pose in zip(spoiled.stamp_ns.tolist(), spoiled.poses, strict=True):
        held.insert(OdometrySample(stamp, pose))
    motion, doubts = believed_odometry(spoiled, LIMITS)
    stamps = np.unique([*spoiled.stamp_ns, *(np.array(asked) * TENTH + 17), 119 * TENTH])
    stamps = stamps[stamps <= spoiled.stamp_ns[-1]]
    found = increments_at(stamps, motion, NOISE, doubts=doubts)
    for (start, end), one in zip(pairwise(stamps.tolist()), found, strict=True):
        online = held.motion(start, end)
        np.testing.assert_allclose(one.delta, online.delta, atol=1e-9)
        # a recording knows the speed after a gap, and finds its chord a little short in a bend
        np.testing.assert_allclose(one.covariance, online.covariance, atol=0.05)


def test_limits_are_fitted_to_a_recordings_own_rate_and_speed():
    keyframes = LIMITS.fitted(winding(200, step_ns=SECOND))
    assert (keyframes.gap_s, keyframes.clock_jump_s) == (5.0, 199.0)
    assert keyframes.max_speed_m_per_s == pytest.approx(24.0, rel=1e-6)
    assert LIMITS.fitted(winding(200, speed=50.0)).max_speed_m_per_s == 60.0
    assert LIMITS.fitted(winding(200, speed=0.2)).max_speed_m_per_s == 5.0  # jitter at a standstill is no jump
    wild = winding(200)
    for at in (50, 90, 130):
        wild = jumping(wild, at, [300.0, 0.0, 0.0])
    assert LIMITS.fitted(wild).max_speed_m_per_s == pytest.approx(24.0, rel=1e-6)
    jittered = winding(200)
    late = jittered.stamp_ns.copy()
    late[5:150:10] += TENTH - TENTH // 100  # fifteen stamps a hundredth of a step before the next
    assert LIMITS.fitted(Trajectory(late, jittered.poses)).max_speed_m_per_s == pytest.approx(48.0)
    way = np.cumsum(np.where((np.arange(200) >= 100) & (np.arange(200) < 104), 3.0, 0.2))  # a dash of four steps
    dashing = Trajectory(np.arange(200) * TENTH, way[:, None] * [1.0, 0.0, 0.0], None, "odometry")
    assert LIMITS.fitted(dashing).max_speed_m_per_s == 60.0
    assert len(believed_odometry(dashing, LIMITS)[1]) == 0
    assert LIMITS.fitted(winding(8)).max_speed_m_per_s == 60.0  # too few to say
    assert LIMITS.fitted(winding(1)) is LIMITS
    assert replace(LIMITS, gap_s=2.0).fitted(winding(200)).gap_s == 2.0


def test_the_end_of_what_nobody_watched_is_known_less_than_a_gap_of_the_same_time():
    for seconds in (0.5, 2.0, 10.0, 60.0):
        ratio = (
            LIMITS.beyond_covariance(seconds)[0, 0] / replace(LIMITS, clock_jump_s=60.0).gap_covariance(seconds)[0, 0]
        )
        assert 1.0 < ratio < 8.0
    with pytest.raises(SkyfixError, match="gap_growth_s: expected > 0, got 0"):
        OdometryLimits(gap_growth_s=0.0)


def test_no_doubts_are_none():
    assert len(OdometryDoubts.none()) == 0
    assert believed_odometry(winding(1), LIMITS)[1].kinds == ()


@pytest.fixture
def long_steps(made_drive: MadeDrive) -> tuple[MadeDrive, TrackSettings]:
    """The made drive, and its odometry with a jump of 40 m in the middle."""
    jumped = jumping(made_drive.odometry, 15, [40.0, 5.0, 0.2])
    write_tum(made_drive.path / "odometry" / "jumping.tum", jumped)
    return made_drive, TrackSettings("jumping", seed=3, particles=3000)


def test_a_drive_is_tracked_across_a_jump_of_its_odometry(long_steps, tmp_path):
    made, settings = long_steps
    sequence = FolderSequence(made.path)
    drive = load_drive(sequence, "jumping")
    assert drive.doubts.count(MotionKind.RESET) == 1
    np.testing.assert_allclose(drive.odometry.poses, sequence.odometry("jumping").poses, atol=1e-9)  # as it comes
    believing = replace(settings, limits=OdometryLimits(max_speed_m_per_s=1e6))
    results = {
        name: track(sequence, EmulatedMatcher(made.truth.poses), one)
        for name, one in {"limited": settings, "plain": replace(settings, odometry="wheels")}.items()
    }
    for method in ("filter", "smoother"):
        mean = {name: result.metrics[method]["position_error_m"]["mean"] for name, result in results.items()}
        assert mean["limited"] < mean["plain"] + 0.3
    result = results["limited"]
    assert len(result.snapshots) == len(results["plain"].snapshots)
    untold = replace(settings, start=tuple(made.truth.poses[0] * [1.0, 1.0, 180.0 / np.pi]))
    (made.path / "ground_truth.tum").unlink()
    unscored = track(FolderSequence(made.path), EmulatedMatcher(made.truth.poses), untold)
    assert unscored.length_m == pytest.approx(made.odometry.length_m, rel=0.1)  # 40 m of 60 were none
    assert result.metrics["odometry"]["position_error_m"]["max"] > 30.0  # odometry only is shown as it comes
    assert result.metrics["odometry_doubts"] == {"jumps": 1, "gaps": 0, "gap_seconds": 0.0}
    report = write_run(result, tmp_path / "run")
    assert "jumps 1 x" in (tmp_path / "run" / "log.txt").read_text()
    assert "jumps 1 x" in Path(report).read_text()
    assert (
        load_drive(sequence, "jumping", believing.limits).doubts.count(MotionKind.RESET) == 1
    )  # its own speeds say so
