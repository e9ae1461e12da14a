"""Track a drive: the loop from a sequence, a matcher and an odometry to trajectories and numbers.

Online, a particle filter is moved by the odometry and weighed by scans matched with the map (`filter_pass`);
afterwards a factor graph smooths all frames at once from the same odometry and the same likelihoods.
Ground truth, where there is any, draws the start and scores the result; it is never tracked with.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Protocol

import numpy as np

from fusion.factor_graph import OdometryDrift
from fusion.odometry import OdometryIncrement, increments_at
from fusion.odometry_errors import OdometryCalibration
from fusion.trajectory import Trajectory
from learned.matcher import MapMatcher
from sequences.drive import STAMP_TOLERANCE_NS, Drive, load_drive, place_odometry
from sequences.filter_pass import FilterPass
from sequences.metrics import position_errors
from sequences.offline import calibrate_drive, smooth_drive
from sequences.run_metrics import run_metrics
from sequences.run_result import FrameRow, RunResult, Snapshot
from sequences.sequence import Sequence, origin_of
from sequences.start import start_prior
from sequences.track_settings import TrackSettings

__all__ = ["FrameRow", "Progress", "RunResult", "Snapshot", "TrackSettings", "track"]


class Progress(Protocol):
    """Told how a drive is going."""

    def start(self, frames: int) -> None:
        """The drive has so many frames."""
        ...

    def frame(self, row: FrameRow, error_m: float | None) -> None:
        """A frame is done; the filter's position error when the truth is known."""
        ...


def track(
    sequence: Sequence, matcher: MapMatcher, settings: TrackSettings, progress: Progress | None = None
) -> RunResult:
    """Track one drive with one odometry.

    Parameters
    ----------
    sequence
        Scans, map, odometry.
    matcher
        Turns a scan and a map into a likelihood.
    settings
        Everything else; with the same settings the result is the same, times apart.
    progress
        Told about every frame.

    Raises
    ------
    SkyfixError
        If the odometry is unknown or does not overlap the scans, the start is outside the map or cannot be had, the
        first scan cannot be used, or the matcher cannot use the map.
    """
    is_drawn = settings.start is None and not settings.start_anywhere
    drive = load_drive(sequence, settings.odometry, settings.limits, starts_at_truth=is_drawn)
    prior = start_prior(drive, settings)
    online = FilterPass(drive, _increments(drive, settings), matcher, prior, settings)
    if progress is not None:
        progress.start(len(drive.indices))
    for frame in range(len(drive.indices)):
        row = online.step(frame)
        if progress is not None:
            progress.frame(row, _error(drive, online, frame))
    filtered = Trajectory(
        drive.stamps_ns,
        np.array([estimate.pose for estimate in online.estimates]),
        np.array([estimate.covariance for estimate in online.estimates]),
        "map",
    )
    begin = time.perf_counter()
    seen = (drive.stamps_ns, drive.motion, settings.noise, online.patches, prior, filtered)
    smoothed, calibration = smooth_drive(*seen, settings.smoother, drive.doubts)
    smoothing_s = time.perf_counter() - begin
    steady = replace(settings.smoother, drift=OdometryDrift.steady())
    filter_calibration = calibrate_drive(*seen, steady, drive.doubts)
    measured = sorted(online.best)
    result = RunResult(
        sequence_name=sequence.name,
        matcher_name=matcher.name,
        settings=settings,
        prior=prior,
        stamps_ns=drive.stamps_ns,
        truth=drive.truth,
        odometry=place_odometry(drive, prior.mean),
        single_shot=Trajectory(
            drive.stamps_ns[measured], np.array([online.best[frame] for frame in measured]), None, "map"
        ),
        filter=_with_map_error(filtered, settings.map_error_m),
        smoother=_with_map_error(smoothed.trajectory, settings.map_error_m),
        frame_rows=online.rows,
        snapshots=online.snapshots,
        metrics={},
        map=sequence.map,
        scans_simulated=sequence.scans_simulated,
        odometry_source=settings.odometry,
        length_m=drive.length_m,
        odometry_calibration=calibration,
        filter_calibration=filter_calibration,
        odometry_doubts=drive.doubts,
        log=[*_described(drive), *online.log],
        origin_lat_lon=origin_of(sequence),
    )
    return replace(result, metrics=run_metrics(result, smoothing_s))


def _increments(drive: Drive, settings: TrackSettings) -> list[OdometryIncrement]:
    """What moves the filter: the odometry as it comes, or corrected by what an earlier drive has shown."""
    known = settings.calibration or OdometryCalibration()
    motion, doubts = drive.motion, drive.doubts
    if settings.calibration is not None:
        motion, doubts = known.corrected(motion), doubts.later(known.clock_offset_s)
    return increments_at(drive.stamps_ns, motion, known.noise(settings.noise), STAMP_TOLERANCE_NS, doubts)


def _with_map_error(estimate: Trajectory, sigma_m: float) -> Trajectory:
    """Claim no more than the map can give: its own error does not average out, so it is added to every covariance."""
    if estimate.covariances is None:
        return estimate
    covariances = estimate.covariances + np.diag([sigma_m**2, sigma_m**2, 0.0])
    return replace(estimate, covariances=covariances)


def _error(drive: Drive, online: FilterPass, frame: int) -> float | None:
    true_pose = drive.true_pose(frame)
    if true_pose is None:
        return None
    return float(position_errors(true_pose[None], online.estimates[frame].pose[None])[0])


def _described(drive: Drive) -> list[str]:
    total = len(drive.sequence.stamps_ns)
    lines = [f"{len(drive.indices)} of {total} frames, {drive.length_m:.0f} m"]
    if len(drive.indices) < total:
        because = "" if drive.truth is None else ", or before the ground truth that the start is drawn about"
        lines.append(f"{total - len(drive.indices)} frames left out: not covered by the odometry{because}")
    if drive.truth is not None and len(drive.truth) < len(drive.indices):
        lines.append(f"errors are of the {len(drive.truth)} frames that the ground truth covers")
    if len(drive.doubts):
        lines.append(f"odometry: {drive.doubts}")
    return lines
