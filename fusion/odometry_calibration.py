"""An odometry's constant errors, found from the drive itself: its clock, its headings' lead, its mounting, its scale.

An odometry comes from another pipeline than the scans. Its stamps are a tenth of a second off; headings taken from the
tangent of a path run ahead of the vehicle; a camera looks a little to one side; a stereo baseline is one per cent
short. None of these is noise: they do not average out, and each is a drift, or half a degree in every turn. With the
right values odometry and map agree best, so the values are those that make the smoothed drive most probable, under a
prior that holds them at zero where the drive tells nothing (in the spirit of Furgale, Rehder and Siegwart, "Unified
temporal and spatial calibration for multi-sensor systems", IROS 2013).
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray
from fusion.factor_graph import SmootherSettings, smooth
from fusion.gaussian_mixture import GaussianMixture
from fusion.odometry import OdometryNoise, increments_at
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory, checked_stamps

_NS = 1_000_000_000
_LARGEST_S = 0.45
_DIRECTIONS = np.array(
    [
        [0.1, 0.0, 0.0, 0.0],  # the clock of positions and headings
        [0.0, 0.1, 0.0, 0.0],  # that of the headings alone
        [0.1, -0.1, 0.0, 0.0],  # that of the positions alone
        [0.0, 0.0, 0.01, 0.0],
        [0.0, 0.0, 0.0, 0.01],
    ]
)
"""Steps of the search over the fields of an `OdometryCalibration`, in their order."""
_SWEEPS = 2
_MOST_STEPS = 4


@dataclass(frozen=True, slots=True)
class OdometryCalibration:
    """Constant errors of an odometry, all zero where there are none.

    Parameters
    ----------
    clock_offset_s : float
        To be added to its stamps.
    heading_lead_s : float
        How long before its time it shows a heading, in seconds; headings are put back by as much.
    mount_yaw_rad : float
        Heading of its forward axis in the vehicle's body, radians counter-clockwise.
    log_scale : float
        ln of the true distance over the distance that it tells.
    """

    clock_offset_s: float = 0.0
    heading_lead_s: float = 0.0
    mount_yaw_rad: float = 0.0
    log_scale: float = 0.0

    def corrected(self, odometry: Trajectory) -> Trajectory:
        """The odometry of the vehicle's body, carried on at both ends as it last moved."""
        at = _delayed(odometry, self.clock_offset_s)
        headings = _delayed(odometry, self.clock_offset_s + self.heading_lead_s)
        first = max(at.span_ns[0], headings.span_ns[0])
        last = min(at.span_ns[1], headings.span_ns[1])
        stamps = np.union1d(np.clip(at.stamp_ns, first, last), [first, last])
        xy = at.interpolate(stamps)[:, :2] * np.exp(self.log_scale)
        yaw = headings.interpolate(stamps)[:, 2] - self.mount_yaw_rad
        return Trajectory(stamps, np.column_stack([xy, se2.wrap(yaw)]), None, odometry.frame_id)


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Standard deviations of what an odometry's constant errors are before the drive is seen, about zero."""

    clock_offset_s: float = 0.1
    heading_lead_s: float = 0.1
    mount_yaw_rad: float = 0.01
    log_scale: float = 0.015

    def cost(self, calibration: OdometryCalibration) -> float:
        """Half a squared Mahalanobis distance from zero."""
        return 0.5 * float(np.sum((np.array(astuple(calibration)) / np.array(astuple(self))) ** 2))


def calibrate_odometry(
    stamps_ns: ArrayLike,
    odometry: Trajectory,
    noise: OdometryNoise,
    measurements: Sequence[GaussianMixture],
    prior: UniformPrior,
    initial: Trajectory,
    settings: SmootherSettings | None = None,
    calibration_prior: CalibrationPrior | None = None,
) -> OdometryCalibration:
    """The most probable constant errors of an odometry, given what was measured along the drive.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Times of the measurements, strictly increasing.
    odometry : Trajectory
        In a frame of its own; it covers the stamps but for less than half a second.
    noise : OdometryNoise
        Its random errors.
    measurements : sequence of N GaussianMixture
        Modes seen at each time, tempered for errors that are correlated in time.
    prior, initial, settings
        As for `fusion.factor_graph.smooth`.
    calibration_prior : CalibrationPrior
        How large constant errors are usually.

    Raises
    ------
    SkyfixError
        As `smooth` does.
    """
    stamps = checked_stamps(stamps_ns)
    before = calibration_prior or CalibrationPrior()

    def cost(calibration: OdometryCalibration) -> float:
        increments = increments_at(stamps, calibration.corrected(odometry), noise)
        return smooth(stamps, increments, measurements, prior, initial, settings).log_evidence * -1.0 + before.cost(calibration)

    found = np.zeros(4)
    for _ in range(_SWEEPS):
        for step in _DIRECTIONS:
            found = _best_along(step, found, lambda values: cost(_bounded(values)))
    return _bounded(found)


def _best_along(step: FloatArray, origin: FloatArray, cost: Callable[[FloatArray], float]) -> FloatArray:
    """The minimum along a direction: downhill by steps, then the vertex of a parabola through three costs."""
    costs = {k: cost(origin + k * step) for k in (-1, 0, 1)}
    best = min(costs, key=costs.__getitem__)
    while 0 < abs(best) < _MOST_STEPS and (further := best + int(np.sign(best))) not in costs:
        costs[further] = cost(origin + further * step)
        best = min(costs, key=costs.__getitem__)
    if best - 1 not in costs or best + 1 not in costs:
        return origin + best * step
    below, here, above = (costs[best + k] for k in (-1, 0, 1))
    bend = below - 2.0 * here + above
    vertex = origin + step * (best + (0.5 * (below - above) / bend if bend > 0.0 else 0.0))
    return vertex if cost(vertex) < here else origin + best * step


def _bounded(values: FloatArray) -> OdometryCalibration:
    """A calibration whose delays an odometry that is carried on by a second can follow."""
    clock, lead, mount, log_scale = values.tolist()
    clock = float(np.clip(clock, -_LARGEST_S, _LARGEST_S))
    return OdometryCalibration(clock, float(np.clip(lead, -_LARGEST_S, _LARGEST_S)), mount, log_scale)


def _delayed(odometry: Trajectory, seconds: float) -> Trajectory:
    """The odometry with later stamps, carried on at both ends by a second as it last moved."""
    first, last = odometry.span_ns
    near, far = min(first + _NS, last), max(last - _NS, first)
    ends: FloatArray = odometry.interpolate(np.array([first, near, far, last]))
    before = se2.compose(ends[0], se2.inverse(se2.between(ends[0], ends[1])))
    after = se2.compose(ends[3], se2.between(ends[2], ends[3]))
    stamps = np.concatenate([[first - _NS], odometry.stamp_ns, [last + _NS]]) + round(seconds * 1e9)
    return Trajectory(stamps, np.concatenate([before[None], odometry.poses, after[None]]), None, odometry.frame_id)
