"""Where a recorded odometry cannot be believed: its jumps are taken out, and its gaps and jumps cost certainty.

An odometry that has lost track often repeats its last pose. That is a gap too, where a vehicle cannot have stopped or
set off so hard. One that is published more often than it is computed repeats each pose for a moment: where it then
jumps ahead, the repeats are left out, so that the vehicle goes on between them.

`fusion.tracking.odometry_buffer` does the same for an odometry that is still arriving.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion import se2
from fusion.arrays import BoolArray, FloatArray, IntArray
from fusion.odometry_limits import FROZEN_M_PER_S, MotionKind, OdometryLimits
from fusion.trajectory import Trajectory

_HARDEST_M_PER_S2 = 10.0  # braking of a car on a dry road
_STOPPING_S, _COARSE_M = 0.5, 0.5  # looked at beside a standstill; wheels tell the way in steps
_REPEATS, _NOW_AND_THEN = 2.0, 0.1  # times the usual time between two poses that differ; share of them


@dataclass(frozen=True, slots=True, eq=False)
class OdometryDoubts:
    """Spans of time in which an odometry's motion is known less than its noise says.

    Parameters
    ----------
    spans_ns : (K, 2) int64
        From one sample to the next; in order, not overlapping.
    kinds : K MotionKind
        What is wrong with each.
    covariances : (K, 3, 3) float64
        What each adds to the covariance of the motion across it, the same in all directions.
    """

    spans_ns: IntArray
    kinds: tuple[MotionKind, ...]
    covariances: FloatArray

    @classmethod
    def none(cls) -> Self:
        """An odometry to be believed throughout."""
        return cls(np.zeros((0, 2), dtype=np.int64), (), np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.kinds)

    def __str__(self) -> str:
        """What is wrong, in words."""
        jumps, gaps = self.count(MotionKind.RESET), self.count(MotionKind.GAP)
        seconds = self.seconds(MotionKind.GAP)
        found = [f"jumps {jumps} x, faster than the vehicle can go (not believed)"] if jumps else []
        found += [f"{gaps} x without odometry, {seconds:.1f} s in all (bridged, with less certainty)"] if gaps else []
        return "; ".join(found) or "nothing doubtful"

    def count(self, kind: MotionKind) -> int:
        """Spans of one kind."""
        return self.kinds.count(kind)

    def seconds(self, kind: MotionKind) -> float:
        """Duration of all spans of one kind."""
        chosen = [kind is other for other in self.kinds]
        return 1e-9 * float(np.diff(self.spans_ns[chosen], axis=1).sum())

    def later(self, seconds: float) -> "OdometryDoubts":
        """The same with later stamps."""
        return OdometryDoubts(self.spans_ns + round(1e9 * seconds), self.kinds, self.covariances)

    def between(self, stamps_ns: IntArray) -> FloatArray:
        """What they add to the covariances (N - 1, 3, 3) of the motions between N increasing stamps."""
        added = np.zeros((len(stamps_ns) - 1, 3, 3))
        for (begin, end), covariance in zip(self.spans_ns.tolist(), self.covariances, strict=True):
            inside = np.diff(np.clip(stamps_ns, begin, end))
            added += (inside / (end - begin))[:, None, None] * covariance
        return added


def believed_odometry(odometry: Trajectory, limits: OdometryLimits) -> tuple[Trajectory, OdometryDoubts]:
    """An odometry without the motions that the vehicle cannot have made, and what is doubtful in it.

    Across a jump it stands still, so that what follows goes on from where it was. Gaps keep their motion; where it is
    shorter or longer than the speed before and after them would have made it, the odometry may have missed some or have
    started anew, and half of the difference is one standard deviation more.

    Parameters
    ----------
    odometry : Trajectory
        As it comes.
    limits : OdometryLimits
        What the vehicle can do; they are fitted to the odometry, see `OdometryLimits.fitted`.
    """
    if len(odometry) < 2:
        return odometry, OdometryDoubts.none()
    odometry = _thawed(_without_repeats(odometry, limits), limits)
    limits = limits.fitted(odometry)
    steps = _Steps.of(odometry, limits)
    kinds = steps.kinds
    at = [index for index, kind in enumerate(kinds) if kind is not MotionKind.DRIVEN]
    added = [limits.added_covariance(kinds[index], steps.seconds[index]) for index in at]
    for index, covariance in zip(at, added, strict=True):
        if kinds[index] is MotionKind.GAP:
            covariance[:2, :2] += np.eye(2) * (0.5 * steps.unexpected_m(index)) ** 2
    doubts = OdometryDoubts(
        spans_ns=np.array([odometry.stamp_ns[index : index + 2] for index in at], dtype=np.int64).reshape(-1, 2),
        kinds=tuple(kinds[index] for index in at),
        covariances=np.array(added).reshape(-1, 3, 3),
    )
    poses = odometry.poses.copy()
    for index in (index for index in at if kinds[index] is MotionKind.RESET):
        poses[index + 1 :] = se2.compose(poses[index], se2.between(poses[index + 1], poses[index + 1 :]))
    if doubts.count(MotionKind.RESET) == 0:
        return odometry, doubts
    return Trajectory(odometry.stamp_ns, poses, None, odometry.frame_id), doubts


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """The motions between an odometry's samples: how long (N - 1,), how far (N - 1,), and of what kind."""

    seconds: FloatArray
    lengths: FloatArray
    kinds: tuple[MotionKind, ...]

    @classmethod
    def of(cls, odometry: Trajectory, limits: OdometryLimits) -> Self:
        """All of them, judged by limits that are fitted."""
        deltas = se2.between(odometry.poses[:-1], odometry.poses[1:])
        seconds = 1e-9 * np.diff(odometry.stamp_ns)
        judged = np.maximum(seconds, np.median(seconds)).tolist()  # stamps jitter
        kinds = tuple(limits.kind(delta, time) for delta, time in zip(deltas, judged, strict=True))
        return cls(seconds, np.hypot(deltas[:, 0], deltas[:, 1]), kinds)

    def before(self, sample: int) -> slice:
        """Those before a sample, the newest first."""
        return slice(sample - 1, None, -1) if sample else slice(0, 0)

    def speed(self, side: slice) -> float | None:
        """Mean speed of the driven steps on one side for as long as a vehicle takes to stop; None without any."""
        time = way = 0.0
        for seconds, length, kind in zip(self.seconds[side], self.lengths[side], self.kinds[side], strict=True):
            if kind is not MotionKind.DRIVEN or time >= _STOPPING_S:
                break
            time, way = time + float(seconds), way + float(length)
        return way / time if time else None

    def unexpected_m(self, gap: int) -> float:
        """By how much the motion across a gap differs from one at the mean of the speeds on both sides of it."""
        speeds = [self.speed(side) for side in (self.before(gap), slice(gap + 1, None))]
        known = [speed for speed in speeds if speed is not None]
        return abs(float(np.mean(known)) * float(self.seconds[gap]) - float(self.lengths[gap])) if known else 0.0

    def is_too_hard(self, side: slice) -> bool:
        """Whether no vehicle can stand at the beginning of the steps on one side; jumps do not count."""
        driven = [kind is not MotionKind.RESET for kind in self.kinds[side]]
        count = int(np.searchsorted(np.cumsum(self.seconds[side]), _STOPPING_S)) + 1
        most_m = 0.5 * _HARDEST_M_PER_S2 * float(self.seconds[side][:count].sum()) ** 2 + _COARSE_M
        return float((self.lengths[side] * driven)[:count].sum()) > most_m

    def catches_up(self, first: int, last: int) -> bool:
        """Whether the jump after samples that are alike makes up for a way that they missed."""
        if last == len(self.kinds) or self.kinds[last] is not MotionKind.RESET:
            return False
        expected = (self.speed(self.before(first)) or 0.0) * float(self.seconds[first : last + 1].sum())
        return abs(float(self.lengths[last]) - expected) < 0.5 * expected


def _repeats(odometry: Trajectory) -> IntArray:
    """First and last sample (K, 2) of each run that repeats a position."""
    seconds = 1e-9 * np.diff(odometry.stamp_ns)
    lengths = np.linalg.norm(np.diff(odometry.poses[:, :2], axis=0), axis=1)
    is_repeat = np.concatenate([[False], lengths < FROZEN_M_PER_S * seconds, [False]])
    return np.flatnonzero(np.diff(is_repeat)).reshape(-1, 2)


def _without_repeats(odometry: Trajectory, limits: OdometryLimits) -> Trajectory:
    """Without the samples that repeat a position until the next is computed, where that looks like a jump.

    If it does so more than now and then, all short repeats are of that kind.
    """
    repeats = _repeats(odometry)
    is_new = np.ones(len(odometry), dtype=bool)
    for first, last in repeats.tolist():
        is_new[first + 1 : last + 1] = False
    usual_s = float(np.median(1e-9 * np.diff(odometry.stamp_ns[is_new]))) if is_new.sum() > 1 else 0.0
    short_s, limits = max(limits.gap_s, _REPEATS * usual_s), limits.fitted(odometry)
    short, jumping = [], []
    for first, last in repeats[repeats[:, 1] < len(odometry) - 1].tolist():
        motion = se2.between(odometry.poses[last], odometry.poses[last + 1])
        held_s, step_s = (1e-9 * np.diff(odometry.stamp_ns[[first, last, last + 1]])).tolist()
        is_jump = [limits.kind(motion, step_s, held) is MotionKind.RESET for held in (0.0, held_s)]
        if held_s + step_s <= short_s:
            short.append((first, last))
            jumping += short[-1:] if is_jump == [True, False] else []
    kept = np.ones(len(odometry), dtype=bool)
    for first, last in short if len(jumping) > _NOW_AND_THEN * len(short) else jumping:
        kept[first + 1 : last + 1] = False
    return _only(odometry, kept)


def _thawed(odometry: Trajectory, limits: OdometryLimits) -> Trajectory:
    """Without the samples that repeat a position for long at which the vehicle cannot have stood."""
    steps = _Steps.of(odometry, limits.fitted(odometry))
    kept = np.ones(len(odometry), dtype=bool)
    for first, last in _repeats(odometry).tolist():
        if steps.seconds[first:last].sum() <= limits.gap_s:
            continue
        too_hard = any(steps.is_too_hard(side) for side in (steps.before(first), slice(last, None)))
        if too_hard or steps.catches_up(first, last):
            kept[first + 1 : last + 1] = False
    kept[-1] = True
    return _only(odometry, kept)


def _only(odometry: Trajectory, kept: BoolArray) -> Trajectory:
    if kept.all():
        return odometry
    return Trajectory(odometry.stamp_ns[kept], odometry.poses[kept], None, odometry.frame_id)
