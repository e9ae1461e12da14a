"""What odometry can be believed: gaps, clocks that jump, odometries that start anew, and what is done about each.

The motion between two odometry samples is of one of these kinds:

- DRIVEN: the samples are close in time and the motion is possible.
- GAP: the samples are further apart than `gap_s`. Their motion is taken, with variances that also grow with the time,
  like it in short gaps and like its third power in long ones: a vehicle's acceleration is what is not known of it.
- CLOCK_JUMP: further apart than `clock_jump_s`, or across a clock that was set back. As a gap, but how long it really
  took is unknown: the variances grow no further.
- RESET: the motion is faster than the vehicle can be, so that the odometry must have started anew. Nothing is taken
  of it: the vehicle may be anywhere within its reach, uniformly over a disc of positions and an interval of headings.

Every variance is proportional to time within one such motion, so it does not matter how many pieces it is cut into.

The defaults are those of a car in a town. Where KITTI 00 and KITTI-360 are interpolated over 5, 10 and 32 s, the pose
in the middle is wrong by 2.1, 7.1 and 41 m on either axis (root mean square), and a gap's half gives 3.1, 7.8 and 43 m;
where they are carried on for 2, 5 and 32 s, the end is wrong by 2.0, 10.7 and 186 m, and `beyond_covariance` gives 3.0,
10.8 and 171 m.
"""

from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Self

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, keep_plain
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory

FROZEN_M_PER_S = 1e-3
"""Slower than this, an odometry repeats its position."""
_SLACK_M = 0.5  # of a possible motion: position noise and stamps that jitter, whatever the time between two samples
_SLACK_RAD = 0.1
_OWN_STEPS, _OWN_SPEEDS, _LEAST_SPEED = 5.0, 3.0, 5.0
_FAST_SHARE, _FAST_COUNT = 0.01, 4  # of an odometry's steps may be jumps
_OPEN_END = 8.0
"""An integrated random walk of intensity q is off by q t^3 / 3 at its free end and by q t^3 / 48 in the middle between
two known ends; a gap gives half of its variance to its middle."""


class MotionKind(StrEnum):
    """What the motion into an odometry sample is worth; START has no sample before it."""

    START = "start"
    DRIVEN = "driven"
    GAP = "gap"
    CLOCK_JUMP = "clock jump"
    RESET = "reset"


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """What the vehicle can do, and how far odometry is trusted where it was not watching.

    Parameters
    ----------
    gap_s : float
        Samples further apart than this have a gap between them. Also the longest time for which the last turn goes on
        when an estimate is asked for beyond the odometry.
    clock_jump_s : float
        Samples further apart than this are on either side of a jump of the clock; at least `gap_s`. Also the longest
        time for which the last speed is held beyond the odometry.
    max_speed_m_per_s, max_turn_rad_per_s : float
        Faster motions are resets; half a metre and 0.1 rad are always allowed.
    gap_position_m_per_sqrt_s, gap_heading_rad_per_sqrt_s : float
        Standard deviation that a second of a short gap adds, in both directions and in heading.
    gap_growth_s : float
        Gaps longer than this add more, like the root of the third power of their time.

    Raises
    ------
    SkyfixError
        When a value is not positive and finite, or `clock_jump_s` is less than `gap_s`.
    """

    gap_s: float = 0.5
    clock_jump_s: float = 10.0
    max_speed_m_per_s: float = 60.0
    max_turn_rad_per_s: float = 3.0
    gap_position_m_per_sqrt_s: float = 1.0
    gap_heading_rad_per_sqrt_s: float = 0.08
    gap_growth_s: float = 3.0

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (np.isfinite(value) and value > 0.0):
                raise SkyfixError(f"odometry limits {entry.name}: expected > 0, got {value}")
        if self.clock_jump_s < self.gap_s:
            raise SkyfixError(f"odometry limits clock_jump_s: expected >= gap_s {self.gap_s}, got {self.clock_jump_s}")

    def kind(self, delta: FloatArray, seconds: float, held_s: float = 0.0) -> MotionKind:
        """Kind of the motion `delta` (3,) between samples `seconds` apart.

        The first may have held its pose for `held_s` before; then the vehicle may have been on its way for so long.
        """
        reach_m, reach_rad = self._reach(seconds + held_s)
        if np.hypot(delta[0], delta[1]) > reach_m or abs(delta[2]) > reach_rad:
            return MotionKind.RESET
        if seconds > self.clock_jump_s:
            return MotionKind.CLOCK_JUMP
        return MotionKind.GAP if seconds > self.gap_s else MotionKind.DRIVEN

    def possible(self, velocity: FloatArray) -> FloatArray:
        """A velocity (3,), metres and radians a second, in the same direction but no faster than the vehicle is."""
        speed = max(float(np.hypot(velocity[0], velocity[1])), self.max_speed_m_per_s)
        turn = max(abs(float(velocity[2])), self.max_turn_rad_per_s)
        return velocity * [*2 * [self.max_speed_m_per_s / speed], self.max_turn_rad_per_s / turn]

    def gap_covariance(self, seconds: float) -> FloatArray:
        """Covariance (3, 3) that a gap adds to that of the motion."""
        known = min(seconds, self.clock_jump_s)
        return self._gap_variances(known * (1.0 + (known / self.gap_growth_s) ** 2))

    def beyond_covariance(self, seconds: float, velocity_over_s: float = 0.0) -> FloatArray:
        """Covariance (3, 3) that a time adds at whose end there is no odometry.

        The velocity at its beginning is known, or only its mean over a time before.
        """
        growth = _OPEN_END * seconds * (seconds + velocity_over_s) / self.gap_growth_s**2
        return self._gap_variances(seconds * (1.0 + growth))

    def added_covariance(self, kind: MotionKind, seconds: float) -> FloatArray:
        """Covariance (3, 3) that a motion of some kind has besides the odometry's noise."""
        if kind is MotionKind.RESET:
            return self.reset_covariance(seconds)
        return np.zeros((3, 3)) if kind is MotionKind.DRIVEN else self.gap_covariance(seconds)

    def reset_covariance(self, seconds: float) -> FloatArray:
        """Covariance (3, 3) of a motion of which nothing is known but the vehicle's limits."""
        reach_m, reach_rad = self._reach(seconds)
        disc, interval = reach_m**2 / 4.0, min(reach_rad, np.pi) ** 2 / 3.0
        return np.diag([disc, disc, interval])

    def fitted(self, odometry: Trajectory) -> Self:
        """The limits for a whole recorded odometry: its own steps and speeds say what is usual.

        Gaps are five of its usual steps at least; three times its highest speed is too fast, where a few fast steps are
        left out unless they follow one another in one direction; and since it is of one recording, no time in it is a
        jump of the clock.
        """
        if len(odometry) < 2:
            return self
        seconds = 1e-9 * np.diff(odometry.stamp_ns)
        gap_s = max(self.gap_s, _OWN_STEPS * float(np.median(seconds)))
        steps_m = np.linalg.norm(np.diff(odometry.poses[:, :2], axis=0), axis=1)
        is_new = np.concatenate([[True], steps_m >= FROZEN_M_PER_S * seconds])  # speeds are from pose to other pose
        xy, seconds_each = odometry.poses[is_new, :2], 1e-9 * np.diff(odometry.stamp_ns[is_new])
        usual_s = float(np.median(seconds_each)) if len(seconds_each) else 0.0
        seconds_each = np.maximum(seconds_each, 0.5 * usual_s)  # stamps jitter
        speeds = np.linalg.norm(np.diff(xy, axis=0), axis=1) / seconds_each
        in_pairs = np.linalg.norm(xy[2:] - xy[:-2], axis=1) / (seconds_each[1:] + seconds_each[:-1])
        kept_up = float(np.minimum(in_pairs, np.minimum(speeds[1:], speeds[:-1])).max(initial=0.0))
        jumps = max(_FAST_COUNT, int(_FAST_SHARE * len(speeds)))
        usual = float(np.sort(speeds)[-1 - jumps]) if len(speeds) > 2 * jumps else np.inf
        own = max(_OWN_SPEEDS * max(usual, kept_up), _LEAST_SPEED)
        return replace(
            self,
            gap_s=gap_s,
            clock_jump_s=max(self.clock_jump_s, gap_s, float(seconds.sum())),
            max_speed_m_per_s=min(self.max_speed_m_per_s, own),
        )

    def _gap_variances(self, seconds: float) -> FloatArray:
        position, heading = self.gap_position_m_per_sqrt_s**2, self.gap_heading_rad_per_sqrt_s**2
        return np.diag([position, position, heading]) * seconds

    def _reach(self, seconds: float) -> tuple[float, float]:
        known = min(seconds, self.clock_jump_s)
        return self.max_speed_m_per_s * known + _SLACK_M, self.max_turn_rad_per_s * known + _SLACK_RAD


def part_of(delta: FloatArray, share: float) -> FloatArray:
    """The share in [0, 1] of a motion (3,) at constant twist."""
    return se2.exp(share * se2.log(delta))
