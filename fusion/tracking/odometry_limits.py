"""What odometry can be believed: gaps, clocks that jump, odometries that start anew, and what is done about each.

The motion between two odometry samples is of one of these kinds:

- DRIVEN: the samples are close in time and the motion is possible.
- GAP: the samples are further apart than `gap_s`. Their motion is taken, with variances that also grow with the time.
- CLOCK_JUMP: further apart than `clock_jump_s`, or across a clock that was set back. As a gap, but how long it really
  took is unknown: the variances grow no further.
- RESET: the motion is faster than the vehicle can be, so that the odometry must have started anew. Nothing is taken
  of it: the vehicle may be anywhere within its reach, uniformly over a disc of positions and an interval of headings.

Every variance is proportional to time within one such motion, so it does not matter how many pieces it is cut into.
"""

from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, keep_plain
from fusion.errors import SkyfixError

_SLACK_M = 0.5  # of a possible motion: position noise and stamps that jitter, whatever the time between two samples
_SLACK_RAD = 0.1


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
        Samples further apart than this have a gap between them. Also the longest time for which the last velocity is
        held when an estimate is asked for beyond the odometry.
    clock_jump_s : float
        Samples further apart than this are on either side of a jump of the clock; at least `gap_s`.
    max_speed_m_per_s, max_turn_rad_per_s : float
        Faster motions are resets; half a metre and 0.1 rad are always allowed.
    gap_position_m_per_sqrt_s, gap_heading_rad_per_sqrt_s : float
        Standard deviation that a second of a gap adds, in both directions and in heading.

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
    gap_heading_rad_per_sqrt_s: float = 0.05

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (np.isfinite(value) and value > 0.0):
                raise SkyfixError(f"odometry limits {entry.name}: expected > 0, got {value}")
        if self.clock_jump_s < self.gap_s:
            raise SkyfixError(f"odometry limits clock_jump_s: expected >= gap_s {self.gap_s}, got {self.clock_jump_s}")

    def kind(self, delta: FloatArray, seconds: float) -> MotionKind:
        """Kind of the motion `delta` (3,) between samples `seconds` apart."""
        reach_m, reach_rad = self._reach(seconds)
        if np.hypot(delta[0], delta[1]) > reach_m or abs(delta[2]) > reach_rad:
            return MotionKind.RESET
        if seconds > self.clock_jump_s:
            return MotionKind.CLOCK_JUMP
        return MotionKind.GAP if seconds > self.gap_s else MotionKind.DRIVEN

    def gap_covariance(self, seconds: float) -> FloatArray:
        """Covariance (3, 3) that a gap adds to that of the motion."""
        position, heading = self.gap_position_m_per_sqrt_s**2, self.gap_heading_rad_per_sqrt_s**2
        return np.diag([position, position, heading]) * min(seconds, self.clock_jump_s)

    def reset_covariance(self, seconds: float) -> FloatArray:
        """Covariance (3, 3) of a motion of which nothing is known but the vehicle's limits."""
        reach_m, reach_rad = self._reach(seconds)
        disc, interval = reach_m**2 / 4.0, min(reach_rad, np.pi) ** 2 / 3.0
        return np.diag([disc, disc, interval])

    def _reach(self, seconds: float) -> tuple[float, float]:
        known = min(seconds, self.clock_jump_s)
        return self.max_speed_m_per_s * known + _SLACK_M, self.max_turn_rad_per_s * known + _SLACK_RAD


def part_of(delta: FloatArray, share: float) -> FloatArray:
    """The share in [0, 1] of a motion (3,) at constant twist."""
    return se2.exp(share * se2.log(delta))
