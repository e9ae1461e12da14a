"""Trajectory: stamped poses in one frame, with covariances where they are known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, IntArray, checked, read_only
from fusion.errors import SkyfixError


def checked_stamps(stamps_ns: ArrayLike) -> IntArray:
    """Stamps (N,) as int64 nanoseconds.

    Raises
    ------
    SkyfixError
        When they are not integers of 64 bits in one axis: float seconds must be converted where they are read.
    """
    stamps = np.asarray(stamps_ns)
    if stamps.ndim != 1 or not (np.issubdtype(stamps.dtype, np.integer) or stamps.size == 0):
        raise SkyfixError(f"stamps: expected (N,) int64 nanoseconds, got {stamps.shape} {stamps.dtype}")
    if stamps.size and int(stamps.max()) > np.iinfo(np.int64).max:
        raise SkyfixError(f"stamps: expected int64 nanoseconds, got {stamps.max()}")
    return stamps.astype(np.int64)


def rising_stamps(stamps_ns: ArrayLike) -> IntArray:
    """Stamps (N,) as `checked_stamps` gives them, each later than the one before.

    Raises
    ------
    SkyfixError
        As `checked_stamps`, and when one is not.
    """
    stamps = checked_stamps(stamps_ns)
    not_later = np.flatnonzero(stamps[1:] <= stamps[:-1])
    if len(not_later):
        raise SkyfixError(
            f"stamps: expected strictly increasing, got a repeat or a step back at index {not_later[0] + 1}"
        )
    return stamps


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time.

    Parameters
    ----------
    stamp_ns : (N,) int64
        Nanoseconds, strictly increasing.
    poses : (N, 3) float64
        ``[x, y, yaw]`` in `frame_id`; yaw is wrapped on entry.
    covariances : (N, 3, 3) float64, optional
        Covariance of ``[x, y, yaw]`` on the axes of `frame_id` (not of the body), m^2, m rad, rad^2.
    frame_id : str
        The frame the poses are in: ``"map"``, or an odometry's own frame.

    Raises
    ------
    SkyfixError
        When there is no pose, shapes disagree, a value is not finite or stamps do not increase.
    """

    stamp_ns: IntArray
    poses: FloatArray
    covariances: FloatArray | None = None
    frame_id: str = "map"

    def __post_init__(self) -> None:
        stamps = rising_stamps(self.stamp_ns)
        if len(stamps) == 0:
            raise SkyfixError("trajectory: expected at least one pose, got none")
        poses = checked("trajectory poses", self.poses, (len(stamps), 3)).copy()
        poses[:, 2] = se2.wrap(poses[:, 2])
        object.__setattr__(self, "stamp_ns", read_only(stamps))
        object.__setattr__(self, "poses", read_only(poses))
        if self.covariances is not None:
            covariances = checked("trajectory covariances", self.covariances, (len(stamps), 3, 3)).copy()
            object.__setattr__(self, "covariances", read_only(covariances))

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def length_m(self) -> float:
        """Length of the path through the poses."""
        return float(np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=1).sum())

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp."""
        return int(self.stamp_ns[0]), int(self.stamp_ns[-1])

    def within(self, first_ns: int, last_ns: int) -> "Trajectory | None":
        """The poses with stamps from one time to another, both included; None when there are none."""
        kept = (self.stamp_ns >= first_ns) & (self.stamp_ns <= last_ns)
        if not kept.any():
            return None
        covariances = None if self.covariances is None else self.covariances[kept]
        return Trajectory(self.stamp_ns[kept], self.poses[kept], covariances, self.frame_id)

    def interpolate(self, stamps_ns: ArrayLike, tolerance_ns: int = 0) -> FloatArray:
        """Poses (M, 3) at `stamps_ns` (M,), moving at a constant body twist between neighbouring poses.

        Stamps up to `tolerance_ns` outside the span get the nearest end's pose.

        Raises
        ------
        SkyfixError
            When a stamp lies further outside.
        """
        stamps = checked_stamps(stamps_ns)
        first, last = self.span_ns
        outside = (stamps < first - tolerance_ns) | (stamps > last + tolerance_ns)
        if outside.any():
            at = int(stamps[outside][0])
            raise SkyfixError(f"trajectory: expected stamps in [{first}, {last}] ns, got {at}")
        if len(self) == 1:
            return np.repeat(self.poses, len(stamps), axis=0)
        stamps = np.clip(stamps, first, last)
        left = np.clip(np.searchsorted(self.stamp_ns, stamps, side="right") - 1, 0, len(self) - 2)
        step_ns = self.stamp_ns[left + 1] - self.stamp_ns[left]
        fraction = (stamps - self.stamp_ns[left]) / step_ns
        a, b = self.poses[left], self.poses[left + 1]
        poses = se2.compose(a, se2.exp(fraction[:, None] * se2.log(se2.between(a, b))))
        return np.where((fraction == 1.0)[:, None], b, poses)
