"""The recent past of an odometry that arrives sample by sample, in any order: motions between any two times in it."""

from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.odometry import OdometryIncrement, OdometryNoise, accumulate
from fusion.odometry_limits import FROZEN_M_PER_S, MotionKind, OdometryLimits, part_of
from fusion.tracking.archive import Tree

_LONGEST_AHEAD_S = 300.0  # afterwards it is known no less
_LEAST_BASE_S = 0.05  # over less, stamps and noise make any velocity
BEGINNING = -(2**63)
"""Before every stamp."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometrySample:
    """One message of an odometry.

    Parameters
    ----------
    stamp_ns : int
        When.
    value : (3,) float64
        Pose in the odometry's own frame; or, with a covariance, the motion since the sample before.
    covariance : (3, 3) float64 or None
        Of the motion; None says that the value is a pose.
    """

    stamp_ns: int
    value: FloatArray
    covariance: FloatArray | None = None

    def same_as(self, other: "OdometrySample") -> bool:
        """Whether both say the same."""
        if self.covariance is None or other.covariance is None:
            same = self.covariance is other.covariance
        else:
            same = np.array_equal(self.covariance, other.covariance)
        return same and self.stamp_ns == other.stamp_ns and np.array_equal(self.value, other.value)


class _Motion(NamedTuple):
    """The motion (3,) into a sample, its kind, and since when the sample's position has been repeated."""

    delta: FloatArray
    kind: MotionKind
    held_since_ns: int


class OdometryBuffer:
    """Samples in order of their stamps, each with the kind of the motion into it.

    Parameters
    ----------
    noise : OdometryNoise
        Gives poses' motions their covariance; samples with a covariance of their own keep that.
    limits : OdometryLimits
        What can be believed.
    entry : OdometrySample or None
        The last sample on a clock that has been set back since: the motion into the first sample begins there.
    """

    def __init__(self, noise: OdometryNoise, limits: OdometryLimits, entry: OdometrySample | None = None) -> None:
        self.kind_counts: Counter[str] = Counter()
        self._noise, self._limits, self._entry = noise, limits, entry
        self._stamps: list[int] = []
        self._samples: list[OdometrySample] = []
        self._motions: list[_Motion] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def copy(self) -> Self:
        """One of its own with the same samples."""
        other = type(self)(self._noise, self._limits, self._entry)
        other.kind_counts = self.kind_counts.copy()
        other._stamps, other._samples = self._stamps.copy(), self._samples.copy()
        other._motions = self._motions.copy()
        return other

    @property
    def first_ns(self) -> int:
        """Oldest stamp held."""
        return self._stamps[0]

    @property
    def newest(self) -> OdometrySample:
        """The sample with the newest stamp."""
        return self._samples[-1]

    def covers(self, stamp_ns: int) -> bool:
        """Whether the samples reach from before a stamp to after it, or hit it."""
        return bool(self._stamps) and self._stamps[0] <= stamp_ns <= self._stamps[-1]

    def get(self, stamp_ns: int) -> OdometrySample | None:
        """The sample with exactly this stamp."""
        index = bisect_left(self._stamps, stamp_ns)
        return self._samples[index] if index < len(self) and self._stamps[index] == stamp_ns else None

    def at_or_before(self, stamp_ns: int) -> int | None:
        """Stamp of the last sample that is not after `stamp_ns`."""
        index = bisect_right(self._stamps, stamp_ns)
        return self._stamps[index - 1] if index else None

    def insert(self, sample: OdometrySample) -> int:
        """Put a sample with a new stamp in its place; all that was known up to the returned stamp still holds."""
        index = bisect_left(self._stamps, sample.stamp_ns)
        self._stamps.insert(index, sample.stamp_ns)
        self._samples.insert(index, sample)
        self._motions.insert(index, self._motion_into(index))
        self.kind_counts[self._motions[index].kind] += 1
        for later in range(index + 1, len(self)):
            before, now = self._motions[later], self._motion_into(later)
            self.kind_counts[before.kind] -= 1
            self._motions[later] = now
            self.kind_counts[now.kind] += 1
            if now.held_since_ns == before.held_since_ns:
                break
        return self._stamps[index - 1] if index else BEGINNING

    def next_step(self, after_ns: int, step_ns: int) -> int | None:
        """The first stamp after another at which a new multiple of `step_ns` has been passed, or odometry begins."""
        index = bisect_right(self._stamps, after_ns)
        if index == 0 and self._stamps:
            return self._stamps[0]
        for later in range(index, len(self)):
            if self._stamps[later] // step_ns != self._stamps[later - 1] // step_ns:
                return self._stamps[later]
        return None

    def entry_motion(self) -> OdometryIncrement | None:
        """The motion into the first sample from before the clock was set back; None at the start of everything."""
        if self._entry is None:
            return None
        return self._piece(0, 1.0, self._limits.gap_s, self._stamps[0])

    def motion(self, start_ns: int, end_ns: int) -> OdometryIncrement:
        """The motion between two covered stamps, the first before the second."""
        index, last = bisect_right(self._stamps, start_ns), bisect_left(self._stamps, end_ns)
        pieces = []
        while index <= last:
            stop = index
            while stop < last and self._is_driven_pose(index) and self._is_driven_pose(stop + 1):
                stop += 1
            begin, end = max(start_ns, self._stamps[index - 1]), min(end_ns, self._stamps[stop])
            pieces.append(self._chord(index, stop, begin, end))
            index = stop + 1
        return accumulate(pieces)

    def extrapolated(self, stamp_ns: int) -> OdometryIncrement:
        """The motion from the newest sample to a later stamp: the mean velocity of the last `gap_s`, or gap, goes on.

        It turns for `gap_s` at most and goes on for `clock_jump_s` at most. After anything else, or samples that reach
        back too short, nothing is known of the velocity, and the vehicle may be anywhere within its reach.
        """
        newest_ns, gap_ns = self._stamps[-1], round(1e9 * self._limits.gap_s)
        ahead_ns = stamp_ns - newest_ns
        seconds = min(1e-9 * ahead_ns, _LONGEST_AHEAD_S)
        start_ns = self._steady_since(newest_ns - gap_ns)
        base_s = 0.0 if start_ns is None else 1e-9 * (newest_ns - start_ns)
        if start_ns is None or base_s < _LEAST_BASE_S:
            return OdometryIncrement(stamp_ns, np.zeros(3), self._limits.reset_covariance(seconds))
        velocity = self._limits.possible(se2.log(self.motion(start_ns, newest_ns).delta) / base_s)
        straight_s = max(0.0, min(1e-9 * ahead_ns, self._limits.clock_jump_s) - self._limits.gap_s)
        turned = se2.exp(velocity * 1e-9 * min(ahead_ns, gap_ns))
        delta = se2.compose(turned, np.array([*(straight_s * velocity[:2]), 0.0]))
        over_s = base_s if self._motions[-1].kind is MotionKind.GAP else 0.0
        covariance = self._noise.covariance(delta, seconds) + self._limits.beyond_covariance(seconds, over_s)
        return OdometryIncrement(stamp_ns, delta, covariance)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the samples that motions from `stamp_ns` on do not need."""
        count = bisect_right(self._stamps, stamp_ns) - 1
        if count > 0:
            del self._stamps[:count], self._samples[:count], self._motions[:count]
            self._entry = None

    def forget_after(self, stamp_ns: int) -> int:
        """Drop the samples that motions up to a covered stamp do not need, and say how many."""
        first = bisect_left(self._stamps, stamp_ns) + 1
        self.kind_counts.subtract(motion.kind for motion in self._motions[first:])
        count = max(0, len(self) - first)
        del self._stamps[first:], self._samples[first:], self._motions[first:]
        return count

    def to_tree(self) -> Tree:
        """Everything, for a file."""
        return {
            "samples": [sample_tree(sample) for sample in self._samples],
            "entry": None if self._entry is None else sample_tree(self._entry),
            "held_since_ns": self._motions[0].held_since_ns if self._motions else None,
            "kind_counts": dict(self.kind_counts),
        }

    @classmethod
    def from_tree(cls, tree: Any, noise: OdometryNoise, limits: OdometryLimits) -> Self:
        """The buffer that was written."""
        entry = None if tree["entry"] is None else OdometrySample(**tree["entry"])
        buffer = cls(noise, limits, entry)
        for sample in tree["samples"]:
            buffer.insert(OdometrySample(**sample))
            if len(buffer) == 1:  # what came before it may have been forgotten
                buffer._motions[0] = buffer._motions[0]._replace(held_since_ns=tree["held_since_ns"])
        buffer.kind_counts = Counter(tree["kind_counts"])
        return buffer

    def _steady_since(self, earliest_ns: int) -> int | None:
        """Since when, but for `earliest_ns`, the velocity is that of the newest motion; None where it is not known."""
        last = len(self) - 1
        if last < 1 or self._motions[last].kind not in (MotionKind.DRIVEN, MotionKind.GAP):
            return None
        if self._motions[last].kind is MotionKind.GAP:
            return self._stamps[last - 1]
        first = last
        while (
            first > 1 and self._motions[first - 1].kind is MotionKind.DRIVEN and self._stamps[first - 1] > earliest_ns
        ):
            first -= 1
        return max(self._stamps[first - 1], earliest_ns)

    def _motion_into(self, index: int) -> _Motion:
        before = self._samples[index - 1] if index else self._entry
        sample = self._samples[index]
        if before is None:
            return _Motion(np.zeros(3), MotionKind.START, sample.stamp_ns)
        delta = sample.value if sample.covariance is not None else se2.between(before.value, sample.value)
        if not index:
            is_reset = self._limits.kind(delta, self._limits.gap_s) is MotionKind.RESET
            return _Motion(delta, MotionKind.RESET if is_reset else MotionKind.CLOCK_JUMP, sample.stamp_ns)
        since_ns = self._motions[index - 1].held_since_ns
        seconds, held_s = 1e-9 * (sample.stamp_ns - before.stamp_ns), 1e-9 * (before.stamp_ns - since_ns)
        kind = self._limits.kind(delta, seconds, held_s if held_s + seconds <= self._limits.gap_s else 0.0)
        is_held = np.hypot(delta[0], delta[1]) < FROZEN_M_PER_S * seconds
        return _Motion(delta, kind, since_ns if is_held else sample.stamp_ns)

    def _is_driven_pose(self, index: int) -> bool:
        return self._motions[index].kind is MotionKind.DRIVEN and self._samples[index].covariance is None

    def _chord(self, first: int, last: int, start_ns: int, end_ns: int) -> OdometryIncrement:
        """The motion within the motions into samples `first` to `last`: several only where poses were driven."""
        begin, end = self._share(first, start_ns), self._share(last, end_ns)
        if not self._is_driven_pose(first):
            return self._piece(first, end - begin, 1e-9 * (self._stamps[first] - self._stamps[first - 1]), end_ns)
        delta = se2.between(self._pose(first, begin), self._pose(last, end))
        return OdometryIncrement(end_ns, delta, self._noise.covariance(delta, 1e-9 * (end_ns - start_ns)))

    def _share(self, index: int, stamp_ns: int) -> float:
        before_ns = self._stamps[index - 1]
        return (stamp_ns - before_ns) / (self._stamps[index] - before_ns)

    def _pose(self, index: int, share: float) -> FloatArray:
        if share == 1.0:
            return self._samples[index].value
        return se2.compose(self._samples[index - 1].value, part_of(self._motions[index].delta, share))

    def _piece(self, index: int, share: float, seconds: float, stamp_ns: int) -> OdometryIncrement:
        """A share, ending at `stamp_ns`, of the one motion into a sample, which took `seconds` as a whole."""
        motion, own = self._motions[index], self._samples[index].covariance
        if motion.kind is MotionKind.RESET:
            return OdometryIncrement(stamp_ns, np.zeros(3), share * self._limits.reset_covariance(seconds))
        delta = part_of(motion.delta, share)
        known = share * min(seconds, self._limits.clock_jump_s)
        covariance = self._noise.covariance(delta, known) if own is None else share * own
        return OdometryIncrement(
            stamp_ns, delta, covariance + share * self._limits.added_covariance(motion.kind, seconds)
        )


def sample_tree(sample: OdometrySample) -> dict[str, Tree]:
    """A sample, for a file."""
    return {"stamp_ns": sample.stamp_ns, "value": sample.value, "covariance": sample.covariance}
