"""Odometry as increments with covariances: how far the vehicle went, and how well that is known.

An increment's covariance is that of the coordinates of its delta, on the axes of the body where the increment begins;
the true motion is ``delta + e`` with ``e ~ N(0, covariance)``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, checked, keep_plain, read_only
from fusion.errors import SkyfixError
from fusion.odometry_doubts import OdometryDoubts
from fusion.trajectory import Trajectory, rising_stamps

_NS = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class OdometryIncrement:
    """Motion since the previous increment.

    Parameters
    ----------
    stamp_ns : int
        Time at which the motion ends.
    delta : (3,) float64
        Pose now in the body frame of then, ``[x, y, yaw]``.
    covariance : (3, 3) float64
        Covariance of `delta`, symmetric positive semidefinite.

    Raises
    ------
    SkyfixError
        When a value is not finite or the covariance is not symmetric positive semidefinite.
    """

    stamp_ns: int
    delta: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        delta = checked("increment delta", self.delta, (3,)).copy()
        delta[2] = se2.wrap(delta[2])
        covariance = checked("increment covariance", self.covariance, (3, 3))
        largest = np.abs(covariance).max()
        if np.abs(covariance - covariance.T).max() > 1e-9 * largest:
            raise SkyfixError("increment covariance: expected a symmetric matrix, got one that is not")
        if np.linalg.eigvalsh(covariance)[0] < -1e-9 * largest:
            raise SkyfixError("increment covariance: expected positive semidefinite, got a negative eigenvalue")
        object.__setattr__(self, "delta", read_only(delta))
        object.__setattr__(self, "covariance", read_only(0.5 * (covariance + covariance.T)))


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """Random-walk errors of an odometry: variances grow with the distance driven and with time.

    The heading error is a random walk along the way, so it also carries the position sideways. Splitting a straight
    drive at constant speed into pieces and accumulating them gives the covariance of the whole.

    Parameters
    ----------
    longitudinal_m_per_sqrt_m, lateral_m_per_sqrt_m : float
        Standard deviation of the position along and across the motion after one metre.
    heading_rad_per_sqrt_m : float
        Standard deviation of the heading after one metre.
    heading_rad_per_sqrt_rad : float
        Standard deviation of the heading after a turn by one radian: scale errors of a gyroscope, stamps that are a
        little off, a heading that lags.
    position_m_per_sqrt_s, heading_rad_per_sqrt_s : float
        The same after one second, whatever the motion: what is not known even at standstill.

    Raises
    ------
    SkyfixError
        When a value is negative or not finite.
    """

    longitudinal_m_per_sqrt_m: float = 0.1
    lateral_m_per_sqrt_m: float = 0.06
    heading_rad_per_sqrt_m: float = 0.002
    heading_rad_per_sqrt_rad: float = 0.06
    position_m_per_sqrt_s: float = 0.02
    heading_rad_per_sqrt_s: float = 0.001

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (np.isfinite(value) and value >= 0.0):
                raise SkyfixError(f"odometry noise {entry.name}: expected >= 0, got {value}")

    def covariance(self, delta: ArrayLike, seconds: float = 0.0) -> FloatArray:
        """Covariance (3, 3) of the increment `delta` (3,) that took `seconds`."""
        return self.covariances(checked("delta", delta, (3,))[None], np.array([seconds]))[0]

    def covariances(self, deltas: ArrayLike, seconds: ArrayLike) -> FloatArray:
        """Covariances (N, 3, 3) of the increments `deltas` (N, 3) that took `seconds` (N,)."""
        deltas = checked("deltas", deltas, ("N", 3))
        seconds = checked("seconds", seconds, (len(deltas),))
        if (seconds < 0.0).any():
            raise SkyfixError(f"seconds: expected zero or more, got {seconds.min():g}")
        distance = np.hypot(deltas[:, 0], deltas[:, 1])
        heading = self.heading_rad_per_sqrt_m**2 * distance + self.heading_rad_per_sqrt_s**2 * seconds
        heading += self.heading_rad_per_sqrt_rad**2 * np.abs(deltas[:, 2])
        position = self.position_m_per_sqrt_s**2 * seconds
        covariances = np.zeros((len(deltas), 3, 3))
        covariances[:, 0, 0] = self.longitudinal_m_per_sqrt_m**2 * distance + position
        covariances[:, 1, 1] = self.lateral_m_per_sqrt_m**2 * distance + position + heading * distance**2 / 3.0
        covariances[:, 1, 2] = covariances[:, 2, 1] = heading * distance / 2.0  # integral of a random walk: 1/3, 1/2
        covariances[:, 2, 2] = heading
        turn = se2.rotation(np.arctan2(deltas[:, 1], deltas[:, 0]))
        return np.asarray(turn @ covariances @ turn.swapaxes(1, 2))


def increments_at(
    stamps_ns: ArrayLike,
    odometry: Trajectory,
    noise: OdometryNoise,
    tolerance_ns: int = 0,
    doubts: OdometryDoubts | None = None,
) -> list[OdometryIncrement]:
    """The N - 1 motions between N stamps, by an odometry trajectory in a frame of its own.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Nanoseconds, strictly increasing; the odometry is interpolated on SE(2) at these.
    odometry : Trajectory
        Drifting poses in any fixed frame.
    noise : OdometryNoise
        Gives each motion its covariance.
    tolerance_ns : int
        How far a stamp may lie outside the odometry's span; there the odometry stands still.
    doubts : OdometryDoubts, optional
        Where the odometry is known less well, see `fusion.odometry_doubts.believed_odometry`.

    Raises
    ------
    SkyfixError
        When stamps do not increase or the odometry does not cover them.
    """
    stamps = rising_stamps(stamps_ns)
    poses = odometry.interpolate(stamps, tolerance_ns)
    deltas = se2.between(poses[:-1], poses[1:])
    covariances = noise.covariances(deltas, np.diff(stamps) * _NS)
    if doubts is not None:
        covariances = covariances + doubts.between(stamps)
    return [
        OdometryIncrement(int(stamp), delta, covariance)
        for stamp, delta, covariance in zip(stamps[1:], deltas, covariances, strict=True)
    ]


def accumulate(increments: Sequence[OdometryIncrement]) -> OdometryIncrement:
    """One increment in place of several in a row: deltas composed, covariances propagated to first order.

    Raises
    ------
    SkyfixError
        When there is none, or their stamps do not increase.
    """
    if not increments:
        raise SkyfixError("increments: expected at least one, got none")
    total = increments[0]
    for step in increments[1:]:
        if step.stamp_ns <= total.stamp_ns:
            raise SkyfixError(f"increments: expected a stamp after {total.stamp_ns} ns, got {step.stamp_ns} ns")
        delta = se2.compose(total.delta, step.delta)
        by_first = np.eye(3)
        by_first[0, 2] = -(delta[1] - total.delta[1])
        by_first[1, 2] = delta[0] - total.delta[0]
        by_second = se2.rotation(total.delta[2])
        covariance = by_first @ total.covariance @ by_first.T + by_second @ step.covariance @ by_second.T
        total = OdometryIncrement(step.stamp_ns, delta, 0.5 * (covariance + covariance.T))
    return total
