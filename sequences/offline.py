"""The offline half of a tracked drive: the odometry's errors found, then everything smoothed at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.arrays import IntArray
from fusion.factor_graph import OdometryDrift, SmootherResult, SmootherSettings, smooth
from fusion.graph.measurements import Measurement
from fusion.odometry import OdometryNoise, increments_at
from fusion.odometry_calibration import calibrate_odometry
from fusion.odometry_doubts import OdometryDoubts
from fusion.odometry_errors import OdometryCalibration
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory

_TOLERANCE_NS = 1_000_000  # by which stamps may lie beyond the odometry's


def calibrate_drive(
    stamps_ns: IntArray,
    odometry: Trajectory,
    noise: OdometryNoise,
    measurements: Sequence[Measurement | None],
    prior: UniformPrior,
    filtered: Trajectory,
    settings: SmootherSettings,
    doubts: OdometryDoubts | None = None,
) -> OdometryCalibration:
    """The odometry's errors by the frames that were measured; arguments as for `smooth_drive`."""
    seen = [(stamp, one) for stamp, one in zip(stamps_ns.tolist(), measurements, strict=True) if one is not None]
    measured_ns = np.array([stamp for stamp, _ in seen], dtype=np.int64)
    matched = [one for _, one in seen]
    return calibrate_odometry(measured_ns, odometry, noise, matched, prior, filtered, settings, doubts=doubts)


def smooth_drive(
    stamps_ns: IntArray,
    odometry: Trajectory,
    noise: OdometryNoise,
    measurements: Sequence[Measurement | None],
    prior: UniformPrior,
    filtered: Trajectory,
    settings: SmootherSettings | None = None,
    doubts: OdometryDoubts | None = None,
) -> tuple[SmootherResult, OdometryCalibration]:
    """Calibrate the odometry by the measurements, then smooth with what it came to.

    Parameters
    ----------
    stamps_ns
        (N,) of the frames.
    odometry, noise
        As they come.
    measurements
        N, None where nothing was measured; tempered for errors correlated in time.
    prior
        Of the first frame.
    filtered
        The filter's answer, where the smoother starts from.
    settings
        The smoother's; a drift of its own is replaced by the one that was found.
    doubts
        Where the odometry is known less well than its noise says.

    Raises
    ------
    SkyfixError
        If the odometry does not cover the stamps or the optimisation diverges.
    """
    settings = settings or SmootherSettings()
    calibration = calibrate_drive(stamps_ns, odometry, noise, measurements, prior, filtered, settings, doubts)
    moved = calibration.corrected(odometry)
    doubts = None if doubts is None else doubts.later(calibration.clock_offset_s)
    increments = increments_at(stamps_ns, moved, calibration.noise(noise), _TOLERANCE_NS, doubts)
    drifting = replace(settings, drift=calibration.drift(OdometryDrift()))
    return smooth(stamps_ns, increments, measurements, prior, filtered, drifting), calibration
