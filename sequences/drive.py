"""The part of a sequence that can be tracked with one odometry: frames, odometry and truth at the same stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.odometry_doubts import OdometryDoubts, believed_odometry
from fusion.odometry_limits import OdometryLimits
from fusion.trajectory import Trajectory
from sequences.sequence import Sequence
from sequences.trajectory_io import format_seconds

_LONGEST_STEP_S = 600.0  # between two scans or two odometry poses, in the middle of all
STAMP_TOLERANCE_NS = 1_000_000
"""Files round their seconds: a scan up to 1 ms outside a trajectory's span takes its end pose."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Frames of a sequence that an odometry covers.

    Attributes
    ----------
    sequence
        Where the scans and the map come from.
    indices
        (M,) scan index of each frame.
    odometry
        Odometry poses at the frames' stamps, in their own frame, as they come.
    motion, doubts
        All of the odometry with its jumps taken out, and where it is known less well than its noise says.
    truth
        True poses at the stamps of the frames that it covers, which are in a row; None where there is no ground truth.
    """

    sequence: Sequence
    indices: NDArray[np.int64]
    odometry: Trajectory
    motion: Trajectory
    doubts: OdometryDoubts
    truth: Trajectory | None

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(M,) stamps of the frames."""
        return self.odometry.stamp_ns

    @property
    def length_m(self) -> float:
        """Path length of the truth, or of the odometry without its jumps where it does not cover all frames."""
        if self.truth is not None and len(self.truth) == len(self.indices):
            return self.truth.length_m
        return _at(self.motion, self.stamps_ns).length_m

    def true_pose(self, frame: int) -> FloatArray | None:
        """True pose (3,) at a frame, None where there is no truth."""
        if self.truth is None:
            return None
        at = self.truth.within(int(self.stamps_ns[frame]), int(self.stamps_ns[frame]))
        return None if at is None else at.poses[0]


def load_drive(
    sequence: Sequence, odometry_name: str, limits: OdometryLimits | None = None, *, starts_at_truth: bool = True
) -> Drive:
    """Bring scans, odometry and truth to common stamps.

    Parameters
    ----------
    sequence
        Scans, odometry and truth.
    odometry_name
        One of the sequence's.
    limits
        What the vehicle can do, fitted to the odometry.
    starts_at_truth
        Leave out frames before the ground truth, where there is any, so that the first true pose is known.

    Raises
    ------
    SkyfixError
        If the odometry is unknown or unreadable, times are in another unit, or it or the truth covers fewer than two of
        the scans.
    """
    odometry = sequence.odometry(odometry_name)
    truth = sequence.ground_truth
    stamps = sequence.stamps_ns
    _check_seconds(stamps, "scans")
    _check_seconds(odometry.stamp_ns, f"odometry {odometry_name!r}")
    covered = _covered(stamps, odometry, f"odometry {odometry_name!r}")
    known = covered
    if truth is not None:
        known = covered & _covered(stamps, truth, "ground truth")
        if known.sum() < 2:
            raise SkyfixError(f"{sequence.name}: expected two scans covered by odometry and truth, got {known.sum()}")
        if starts_at_truth:
            covered &= stamps >= stamps[known][0]
    indices = np.flatnonzero(covered).astype(np.int64)
    if len(indices) < 2:
        raise SkyfixError(f"{sequence.name}: expected two scans covered by the odometry, got {len(indices)}")
    used = stamps[indices]
    motion, doubts = believed_odometry(odometry, limits or OdometryLimits())
    return Drive(
        sequence=sequence,
        indices=indices,
        odometry=_at(odometry, used),
        motion=motion,
        doubts=doubts,
        truth=None if truth is None else _at(truth, stamps[known]),
    )


def place_odometry(drive: Drive, start: FloatArray) -> Trajectory:
    """The odometry alone, in the map frame, begun at `start` (3,)."""
    moved = se2.between(drive.odometry.poses[:1], drive.odometry.poses)
    return Trajectory(drive.stamps_ns, se2.compose(start[None], moved), None, "map")


def _check_seconds(stamps: NDArray[np.int64], label: str) -> None:
    """Refuse what has been read as seconds and was nanoseconds, or the like: a file read so still has an order."""
    step_s = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 0.0
    if step_s > _LONGEST_STEP_S:
        raise SkyfixError(f"{label}: expected times in seconds, got steps of {step_s:.3g}")


def _covered(stamps: NDArray[np.int64], trajectory: Trajectory, label: str) -> NDArray[np.bool_]:
    first, last = trajectory.span_ns
    covered = (stamps >= first - STAMP_TOLERANCE_NS) & (stamps <= last + STAMP_TOLERANCE_NS)
    if not covered.any():
        scans = f"{format_seconds(int(stamps[0]))} .. {format_seconds(int(stamps[-1]))} s"
        span = f"{format_seconds(first)} .. {format_seconds(last)} s"
        raise SkyfixError(f"{label}: expected an overlap in time with the scans ({scans}), got {span}")
    return covered


def _at(trajectory: Trajectory, stamps: NDArray[np.int64]) -> Trajectory:
    poses = trajectory.interpolate(stamps, STAMP_TOLERANCE_NS)
    return Trajectory(stamps, poses, None, trajectory.frame_id)
