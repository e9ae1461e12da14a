"""Errors against ground truth, in the vehicle's frame, and the numbers of `metrics.json`.

No alignment anywhere: an estimate is compared with the truth in the map frame as it stands. Lateral and longitudinal
errors come from `vehicle_frame_errors` alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray, checked
from fusion.consistency import coverage, nees
from fusion.error_correlation import estimate_error_correlation
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory

RECALL_THRESHOLDS = (1, 3, 5)
"""Metres for positions, degrees for headings."""
_DIGITS = 6
_CORRELATION_REACH_M = 40.0


def vehicle_frame_errors(truth: NDArray[np.float64], estimate: NDArray[np.float64]) -> tuple[FloatArray, ...]:
    """Signed errors of `estimate` along the axes of the TRUE vehicle.

    Parameters
    ----------
    truth, estimate
        Poses (N, 3), map frame, metres and radians.

    Returns
    -------
    longitudinal
        (N,) metres, positive when the estimate lies ahead of the vehicle.
    lateral
        (N,) metres, positive when it lies to the vehicle's left.
    heading
        (N,) radians in [-pi, pi), positive when it is turned counter-clockwise.

    Raises
    ------
    SkyfixError
        If the shapes differ or a value is not finite.
    """
    truth = checked("truth", truth, ("N", 3))
    estimate = checked("estimate", estimate, (len(truth), 3))
    # The translation of between(truth, estimate) = truth^-1 * estimate is the displacement in the true body frame.
    error = se2.between(truth, estimate)
    return error[:, 0], error[:, 1], error[:, 2]


def position_errors(truth: NDArray[np.float64], estimate: NDArray[np.float64]) -> FloatArray:
    """Distances (N,), metres, between the positions of poses (N, 3)."""
    return np.linalg.norm(estimate[:, :2] - truth[:, :2], axis=1)


def map_frame_errors(truth: NDArray[np.float64], estimate: NDArray[np.float64]) -> FloatArray:
    """estimate - truth, (N, 3), on the axes of the map, the heading wrapped: what map-frame covariances speak of."""
    difference = estimate - truth
    difference[:, 2] = se2.wrap(difference[:, 2])
    return difference


def summarise(
    truth: NDArray[np.float64],
    estimate: NDArray[np.float64],
    covariances: NDArray[np.float64] | None = None,
    thresholds: Sequence[int] = RECALL_THRESHOLDS,
) -> dict[str, Any]:
    """One method's object in `metrics.json`.

    Parameters
    ----------
    truth, estimate
        Poses (N, 3) of the same frames, N > 0.
    covariances
        (N, 3, 3) of (x, y, yaw) on the axes of the map; adds `nees` and `ellipse95`.
    thresholds
        Metres and degrees of the recalls.

    Returns
    -------
    `position_error_m`, `heading_error_deg`, `position_recall`, `lateral_recall`, `longitudinal_recall`,
    `heading_recall` (fractions of frames below each threshold), `frames`; with covariances also `nees` = {mean,
    dof: 3, coverage95} of (x, y, yaw) and `ellipse95`, the fraction of frames with the true position in the 95 %
    ellipse (2 degrees of freedom).
    """
    if len(truth) == 0:
        raise SkyfixError("metrics: expected at least one frame, got none")
    longitudinal, lateral, heading = vehicle_frame_errors(truth, estimate)
    position = position_errors(truth, estimate)
    heading_deg = np.abs(np.rad2deg(heading))
    summary: dict[str, Any] = {
        "position_error_m": {
            "mean": _rounded(position.mean()),
            "median": _rounded(np.median(position)),
            "rmse": _rounded(np.sqrt(np.mean(position**2))),
            "max": _rounded(position.max()),
        },
        "heading_error_deg": {
            "mean": _rounded(heading_deg.mean()),
            "median": _rounded(np.median(heading_deg)),
            "max": _rounded(heading_deg.max()),
        },
        "position_recall": _recall(position, thresholds),
        "lateral_recall": _recall(np.abs(lateral), thresholds),
        "longitudinal_recall": _recall(np.abs(longitudinal), thresholds),
        "heading_recall": _recall(heading_deg, thresholds),
        "frames": len(truth),
    }
    if covariances is not None:
        errors = map_frame_errors(truth, estimate)
        pose_nees = nees(errors, covariances)
        position_nees = nees(errors[:, :2], covariances[:, :2, :2])
        summary["nees"] = {
            "mean": _rounded(pose_nees.mean()),
            "dof": 3,
            "coverage95": _rounded(coverage(pose_nees, dof=3, level=0.95)),
        }
        summary["ellipse95"] = _rounded(coverage(position_nees, dof=2, level=0.95))
    return summary


def distance_along(poses: NDArray[np.float64]) -> FloatArray:
    """Path length (N,), metres, from the first of poses (N, 3) to each."""
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def drift(truth: Trajectory, smoother: Trajectory, odometry: Trajectory) -> dict[str, float]:
    """Whether errors grow along the drive.

    Returns
    -------
    The smoother's mean position error over the first and over the last quarter of the true path length, and the
    position error of the odometry at the last frame when it is started at the true first pose: its drift, free of any
    error of the start.
    """
    errors = position_errors(truth.poses, smoother.poses)
    along = distance_along(truth.poses)
    first, last = along <= 0.25 * along[-1], along >= 0.75 * along[-1]
    final = from_true_start(truth, odometry).poses[-1]
    return {
        "first_quarter_mean_m": _rounded(errors[first].mean()),
        "last_quarter_mean_m": _rounded(errors[last].mean()),
        "odometry_final_error_m": _rounded(np.linalg.norm(final[:2] - truth.poses[-1, :2])),
    }


def from_true_start(truth: Trajectory, odometry: Trajectory) -> Trajectory:
    """The odometry alone (stamps of `truth`), begun at the true first pose: its drift without an error of the start."""
    moved = se2.between(odometry.poses[:1], odometry.poses)
    return Trajectory(odometry.stamp_ns, se2.compose(truth.poses[:1], moved), None, truth.frame_id)


def scored(truth: Trajectory, estimate: Trajectory) -> Trajectory | None:
    """The poses of an estimate whose stamps the truth covers; None when it covers none of them."""
    return estimate.within(*truth.span_ns)


def correlation_length(truth: NDArray[np.float64], single_shots: NDArray[np.float64]) -> float | None:
    """Over how many metres (1/e) the errors of poses (N, 3) repeat, by `fusion.estimate_error_correlation`.

    None where there are too few of them to say.
    """
    errors = np.column_stack(vehicle_frame_errors(truth, single_shots))
    try:
        found = estimate_error_correlation(errors, distance_along(truth), max_distance_m=_CORRELATION_REACH_M)
    except SkyfixError:
        return None
    return _rounded(found.length_m)


def after_first_quarter(truth: Trajectory, estimate: Trajectory) -> Trajectory:
    """The frames of `estimate` (stamps of `truth`) after the first quarter of the true path length."""
    along = distance_along(truth.poses)
    keep = along >= 0.25 * along[-1]
    covariances = None if estimate.covariances is None else estimate.covariances[keep]
    return Trajectory(estimate.stamp_ns[keep], estimate.poses[keep], covariances, estimate.frame_id)


def _recall(magnitudes: FloatArray, thresholds: Sequence[int]) -> dict[str, float]:
    return {str(limit): _rounded(np.mean(magnitudes < limit)) for limit in thresholds}


def _rounded(value: np.floating[Any] | float) -> float:
    """A plain float of six decimals: more says nothing about metres and degrees."""
    return round(float(value), _DIGITS)
