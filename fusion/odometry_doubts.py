"""Where a recorded odometry cannot be believed: its jumps are taken out, and its gaps and jumps cost certainty.

An odometry that has lost track often repeats its last pose. That is a gap too, where a vehicle cannot have stopped or
set off so hard.

`fusion.tracking.odometry_buffer` does the same for an odometry that is still arriving.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.odometry_limits import MotionKind, OdometryLimits
from fusion.trajectory import Trajectory

_FROZEN_M_PER_S = 1e-3
_HARDEST_M_PER_S2 = 10.0  # braking of a car on a dry road
_STOPPING_S, _COARSE_M = 0.5, 0.5  # looked at beside a standstill; wheels tell the way in steps


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
    shorter than the speed before and after them would have made it, the odometry may have missed it, and half of what
    is missing is one standard deviation more.

    Parameters
    ----------
    odometry : Trajectory
        As it comes.
    limits : OdometryLimits
        What the vehicle can do; they are fitted to the odometry, see `OdometryLimits.fitted`.
    """
    odometry = _thawed(odometry, limits.gap_s)
    if len(odometry) < 2:
        return odometry, OdometryDoubts.none()
    limits = limits.fitted(odometry)
    deltas = se2.between(odometry.poses[:-1], odometry.poses[1:])
    seconds = 1e-9 * np.diff(odometry.stamp_ns)
    kinds = [limits.kind(delta, time) for delta, time in zip(deltas, seconds.tolist(), strict=True)]
    at = [index for index, kind in enumerate(kinds) if kind is not MotionKind.DRIVEN]
    added = [limits.added_covariance(kinds[index], seconds[index]) for index in at]
    for index, covariance in zip(at, added, strict=True):
        if kinds[index] is MotionKind.GAP:
            covariance[:2, :2] += np.eye(2) * (0.5 * _missing_m(deltas, seconds, kinds, index)) ** 2
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


def _thawed(odometry: Trajectory, longest_s: float) -> Trajectory:
    """Without the samples that repeat a pose for long at which the vehicle cannot have stood."""
    seconds = 1e-9 * np.diff(odometry.stamp_ns)
    lengths = np.linalg.norm(np.diff(odometry.poses[:, :2], axis=0), axis=1)
    frozen = np.concatenate([[False], lengths < _FROZEN_M_PER_S * seconds, [False]])  # of the step into a sample
    kept = np.ones(len(odometry), dtype=bool)
    for first, last in np.flatnonzero(np.diff(frozen)).reshape(-1, 2).tolist():  # samples first to last are alike
        if seconds[first:last].sum() <= longest_s:
            continue
        before, after = slice(first - 1, None, -1) if first else slice(0, 0), slice(last, None)
        if any(_is_too_hard(lengths[side], seconds[side]) for side in (before, after)):
            kept[first + 1 : last + 1] = False
    kept[-1] = True
    if kept.all():
        return odometry
    return Trajectory(odometry.stamp_ns[kept], odometry.poses[kept], None, odometry.frame_id)


def _is_too_hard(lengths: FloatArray, seconds: FloatArray) -> bool:
    """Whether no vehicle can stand at the beginning of steps that are this long, or at their end in reverse order."""
    count = int(np.searchsorted(np.cumsum(seconds), _STOPPING_S)) + 1
    most_m = 0.5 * _HARDEST_M_PER_S2 * float(seconds[:count].sum()) ** 2 + _COARSE_M
    return float(lengths[:count].sum()) > most_m


def _missing_m(deltas: FloatArray, seconds: FloatArray, kinds: list[MotionKind], gap: int) -> float:
    """By how much the motion across a gap is shorter than at the mean of the speeds on both sides of it."""
    beside = [index for index in (gap - 1, gap + 1) if 0 <= index < len(kinds) and kinds[index] is MotionKind.DRIVEN]
    lengths = np.hypot(deltas[:, 0], deltas[:, 1])
    speed = float(np.mean(lengths[beside] / seconds[beside])) if beside else 0.0
    return max(0.0, speed * float(seconds[gap]) - float(lengths[gap]))
