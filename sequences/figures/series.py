"""A run as curves over the distance travelled: the numbers that the figures draw.

The vehicle-frame errors are signed, estimate minus truth, on the axes of the true vehicle: longitudinal forward,
lateral to the left. Covariances are turned onto the same axes so that a band and the error inside it can be compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.consistency import nees
from fusion.trajectory import Trajectory
from sequences.metrics import distance_along, map_frame_errors, scored, vehicle_frame_errors
from sequences.run_result import RunResult

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MethodErrors:
    """One method's errors, one entry a pose.

    Attributes
    ----------
    distance_m
        (N,) distance travelled at each pose that the truth covers.
    position_m
        (N,) distance from the true position.
    signed
        (N, 3) longitudinal (m), lateral (m), heading (rad) in the true vehicle's frame.
    """

    distance_m: FloatArray
    position_m: FloatArray
    signed: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What a method says of its own errors, one entry a pose of its `MethodErrors`.

    Attributes
    ----------
    sigma
        (N, 3) standard deviations: longitudinal (m), lateral (m), heading (rad) in the true vehicle's frame.
    nees
        (N,) normalised estimation error squared of (x, y, heading): 3 degrees of freedom.
    """

    sigma: FloatArray
    nees: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RunSeries:
    """Curves of a run over the distance travelled.

    Attributes
    ----------
    stamps_ns, distance_m
        (M,) the run's stamps and the distance travelled at each.
    errors
        By method; empty without ground truth.
    claims
        By method; only methods in `errors` whose trajectory has covariances.
    """

    stamps_ns: NDArray[np.int64]
    distance_m: FloatArray
    errors: dict[str, MethodErrors]
    claims: dict[str, Claim]

    def distance_at(self, stamps_ns: NDArray[np.int64]) -> FloatArray:
        """Distance travelled (N,) at any stamps of the run."""
        start = self.stamps_ns[0]
        return np.interp(stamps_ns - start, self.stamps_ns - start, self.distance_m)


def trajectories_of(result: RunResult) -> dict[str, Trajectory]:
    """Key a run's estimated trajectories as metrics.json does."""
    return {
        "odometry": result.odometry,
        "single_shot": result.single_shot,
        "filter": result.filter,
        "smoother": result.smoother,
    }


def series_of(result: RunResult) -> RunSeries:
    """Compute the curves of a run; distance is along the truth where it covers all frames, else along the odometry."""
    truth = result.truth
    path = result.odometry if truth is None or len(truth) < len(result.stamps_ns) else truth
    series = RunSeries(result.stamps_ns, distance_along(path.interpolate(result.stamps_ns)), {}, {})
    if truth is not None:
        for name, whole in trajectories_of(result).items():
            trajectory = scored(truth, whole)
            if trajectory is None:
                continue
            true_poses = truth.interpolate(trajectory.stamp_ns)
            signed = np.stack(vehicle_frame_errors(true_poses, trajectory.poses), axis=-1)
            position_m = np.hypot(signed[:, 0], signed[:, 1])
            series.errors[name] = MethodErrors(series.distance_at(trajectory.stamp_ns), position_m, signed)
            if trajectory.covariances is not None:
                series.claims[name] = Claim(
                    sigma=_vehicle_frame_sigma(true_poses[:, 2], trajectory.covariances),
                    nees=nees(map_frame_errors(true_poses, trajectory.poses), trajectory.covariances),
                )
    return series


def _vehicle_frame_sigma(yaw: FloatArray, covariances: FloatArray) -> FloatArray:
    """Standard deviations (N, 3) along the vehicle, across it and in heading, of map-frame covariances (N, 3, 3)."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along = np.stack([cosine, sine], axis=-1)
    across = np.stack([-sine, cosine], axis=-1)
    in_plane = covariances[:, :2, :2]
    variances = [np.einsum("ni,nij,nj->n", axis, in_plane, axis) for axis in (along, across)]
    return np.sqrt(np.stack([*variances, covariances[:, 2, 2]], axis=-1))
