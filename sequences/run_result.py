"""What a tracked drive leaves behind: trajectories of every method, a row per frame, a few frames to look at, the
metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import Float32Array, FloatArray
from fusion.grid import MapGrid
from fusion.odometry_doubts import OdometryDoubts
from fusion.odometry_errors import OdometryCalibration
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.track_settings import TrackSettings


@dataclass(frozen=True, slots=True)
class FrameRow:
    """What happened at one frame.

    Attributes
    ----------
    index
        Index of the scan in the sequence.
    stamp_ns
        Its stamp, nanoseconds.
    measured
        Whether its scan was matched with the map.
    skipped_reason
        Why a scan that was due could not be used; empty otherwise.
    log_evidence
        ln density per m^2 rad that the measurement gave to the prediction; None at frames without one.
    effective_sample_size
        Of the particles after this frame.
    lost_score
        The filter's probability of being lost, 0 to 1.
    temperature
        By which the measurement was flattened for its error's correlation with the last one; None without one.
    search_half_extent_m, search_half_heading_rad
        The region that was searched about the prediction; None without a measurement.
    milliseconds
        Spent in each stage that the frame had, of `scan`, `match`, `predict`, `update`.
    """

    index: int
    stamp_ns: int
    measured: bool
    skipped_reason: str
    log_evidence: float | None
    effective_sample_size: float
    lost_score: float
    temperature: float | None
    search_half_extent_m: float | None
    search_half_heading_rad: float | None
    milliseconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """One measured frame to look at.

    Attributes
    ----------
    index
        Index of the scan in the sequence, as in `FrameRow`.
    bev
        (C, H, W) float32, the scan from above: body x along columns, body y against rows.
    map_crop
        The map around the search.
    heat
        (rows, cols) ln density per m^2 rad, the highest over the headings, untempered.
    heat_grid
        Where the cells of `heat` lie.
    truth
        True pose (3,), or None.
    estimate
        The filter's pose (3,) after the measurement.
    best
        The measurement's own best pose (3,).
    """

    index: int
    bev: Float32Array
    map_crop: MapRaster
    heat: Float32Array
    heat_grid: MapGrid
    truth: FloatArray | None
    estimate: FloatArray
    best: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """A tracked drive. Trajectories are in the map frame; covariances are on the axes of the map.

    Attributes
    ----------
    sequence_name, matcher_name, settings
        What was run. `odometry_source` is the odometry's name.
    prior
        What was known of the first pose.
    stamps_ns
        (M,) the frames' stamps.
    truth
        Ground truth at the frames that it covers, or None.
    odometry
        The odometry alone, started at the prior's mean.
    single_shot
        Each measurement's own best pose, at the measured frames only.
    filter, smoother
        Estimates at every frame, with covariances.
    frame_rows
        M rows.
    snapshots
        A few measured frames, spread along the drive.
    metrics
        The content of `metrics.json`.
    map
        The map.
    scans_simulated
        True when the scans were ray-cast from the map.
    length_m
        Path length of the truth, or of the odometry where the truth does not cover all frames.
    odometry_calibration
        The odometry's errors, as the smoother found and removed them.
    filter_calibration
        The same for a filter, which cannot follow a scale that wanders and takes it as noise.
    odometry_doubts
        Jumps and gaps of the odometry.
    log
        Lines of `log.txt`.
    origin_lat_lon
        Latitude and longitude of the map frame's origin, degrees, where they are known.
    """

    sequence_name: str
    matcher_name: str
    settings: TrackSettings
    prior: UniformPrior
    stamps_ns: NDArray[np.int64]
    truth: Trajectory | None
    odometry: Trajectory
    single_shot: Trajectory
    filter: Trajectory
    smoother: Trajectory
    frame_rows: list[FrameRow]
    snapshots: list[Snapshot]
    metrics: dict[str, Any]
    map: MapRaster
    scans_simulated: bool
    odometry_source: str
    length_m: float
    odometry_calibration: OdometryCalibration
    filter_calibration: OdometryCalibration
    odometry_doubts: OdometryDoubts
    log: list[str]
    origin_lat_lon: tuple[float, float] | None = None
