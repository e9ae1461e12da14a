"""OdometryCalibration: what is wrong with an odometry besides noise, put right, and how noisy it is.

Headings that are averages (chords of a path, filters) are sharpened by one step of van Cittert's iteration, "Zum
Einfluss der Spaltbreite auf die Intensitätsverteilung in Spektrallinien", Zeitschrift für Physik, 1931: white noise
grows to 2.1 times itself, whatever the span.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.odometry_drift import OdometryDrift
from fusion.odometry import OdometryNoise
from fusion.trajectory import Trajectory

_NS = 1_000_000_000
_BEYOND_S = 1.5
"""So far beyond its ends, whatever its headings' lead, an odometry is carried on: half a second that it may fall short
of the stamps by, and a clock that is off by up to a second."""
_LARGEST = {
    "clock_offset_s": 1e10,  # stamps hold 9.2e9
    "heading_lead_s": 60.0,
    "mount_yaw_rad": 100.0,
    "log_scale": 10.0,
    "heading_lead_m": 1000.0,
    "heading_bias_rad_per_m": 10.0,
    "heading_blur_s": 60.0,
}
_LARGEST_FACTOR = 1e6


@dataclass(frozen=True, slots=True)
class OdometryCalibration:
    """Errors of an odometry; without any, as it comes.

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
    heading_lead_m : float
        How far before its place, in metres: the tangent of the path of a sensor in front of the rear axle leads by
        about their distance.
    heading_bias_rad_per_m : float
        What its heading lacks per metre.
    heading_blur_s : float
        Standard deviation, in seconds, of the span of time over which it averages headings: a tangent that is a chord
        does, and so does any filter. The average is undone to first order: the heading less what averaging it once
        more would take from it.
    along_noise, across_noise, heading_noise : float
        Its noise over what was assumed, factors of standard deviations.
    scale_walk : float
        How its scale wanders over what was assumed, likewise.

    Raises
    ------
    SkyfixError
        When a value is not finite or larger than any odometry's, a factor not positive, or the blur negative.
    """

    clock_offset_s: float = 0.0
    heading_lead_s: float = 0.0
    mount_yaw_rad: float = 0.0
    log_scale: float = 0.0
    heading_lead_m: float = 0.0
    heading_bias_rad_per_m: float = 0.0
    heading_blur_s: float = 0.0
    along_noise: float = 1.0
    across_noise: float = 1.0
    heading_noise: float = 1.0
    scale_walk: float = 1.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, factor = getattr(self, entry.name), entry.default == 1.0
            if not np.isfinite(value) or (factor and value <= 0.0):
                expected = "a positive number" if factor else "a finite number"
                raise SkyfixError(f"odometry calibration {entry.name}: expected {expected}, got {value}")
            largest = _LARGEST.get(entry.name, _LARGEST_FACTOR)
            if abs(value) > largest:
                raise SkyfixError(f"odometry calibration {entry.name}: expected at most {largest:g}, got {value}")
        if self.heading_blur_s < 0.0:
            raise SkyfixError(f"odometry calibration heading_blur_s: expected >= 0, got {self.heading_blur_s}")

    def corrected(self, odometry: Trajectory) -> Trajectory:
        """The odometry of the vehicle's body, carried on at both ends as it last moved, by half a second or more.

        Raises
        ------
        SkyfixError
            When its stamps and the clock's offset are too large for 64 bits.
        """
        longer = _carried_on(odometry, math.ceil(_BEYOND_S + abs(self.heading_lead_s)))
        at = _delayed(longer, self.clock_offset_s)
        headings = _delayed(longer, self.clock_offset_s + self.heading_lead_s)
        first = max(at.span_ns[0], headings.span_ns[0])
        last = min(at.span_ns[1], headings.span_ns[1])
        stamps = np.union1d(np.clip(at.stamp_ns, first, last), [first, last])
        xy = np.exp(self.log_scale) * at.interpolate(stamps)[:, :2]
        steps = np.diff(xy, axis=0)
        way = np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1])))
        shown = _sharpened(headings, stamps, self.heading_blur_s)
        yaw = np.interp(way - self.heading_lead_m, way, shown) if self.heading_lead_m else shown
        turned = self.heading_bias_rad_per_m * way
        bends = np.column_stack([np.zeros((len(steps), 2)), 0.5 * (turned[1:] + turned[:-1])])
        xy = xy[0] + np.vstack([np.zeros(2), np.cumsum(se2.transform_points(bends, steps), axis=0)])
        return Trajectory(
            stamps, np.column_stack([xy, se2.wrap(yaw + turned - self.mount_yaw_rad)]), None, odometry.frame_id
        )

    def noise(self, assumed: OdometryNoise) -> OdometryNoise:
        """The noise that it has, given what was assumed of it."""
        return replace(
            assumed,
            longitudinal_m_per_sqrt_m=self.along_noise * assumed.longitudinal_m_per_sqrt_m,
            lateral_m_per_sqrt_m=self.across_noise * assumed.lateral_m_per_sqrt_m,
            heading_rad_per_sqrt_m=self.heading_noise * assumed.heading_rad_per_sqrt_m,
            heading_rad_per_sqrt_rad=self.heading_noise * assumed.heading_rad_per_sqrt_rad,
        )

    def drift(self, assumed: OdometryDrift) -> OdometryDrift:
        """How its errors change along the way, given what was assumed of that."""
        return replace(assumed, log_scale_walk=self.scale_walk * assumed.log_scale_walk)


def _sharpened(headings: Trajectory, stamps: IntArray, blur_s: float) -> FloatArray:
    """Headings (N,) at stamps, without jumps by whole turns; an average over a span of time taken out."""
    shown: FloatArray = np.unwrap(headings.interpolate(stamps)[:, 2])
    if blur_s == 0.0:
        return shown
    first, last = headings.span_ns
    span = np.minimum(round(blur_s * 1e9), np.minimum(stamps - first, last - stamps))  # as much as there is at the ends
    after, before = (se2.wrap(headings.interpolate(stamps + way * span)[:, 2] - shown) for way in (1, -1))
    return shown - 0.5 * (after + before)


def _carried_on(odometry: Trajectory, seconds: int) -> Trajectory:
    """The odometry with so many seconds more at both ends, each as the second nearest to it."""
    first, last = odometry.span_ns
    _check_stamps(first - seconds * _NS, last + seconds * _NS)
    near, far = min(first + _NS, last), max(last - _NS, first)
    ends: FloatArray = odometry.interpolate(np.array([first, near, far, last]))
    back, forth = se2.inverse(se2.between(ends[0], ends[1])), se2.between(ends[2], ends[3])
    before, after = [ends[0]], [ends[3]]
    for _ in range(seconds):
        before.append(se2.compose(before[-1], back))
        after.append(se2.compose(after[-1], forth))
    away = _NS * np.arange(1, seconds + 1)
    stamps = np.concatenate([first - away[::-1], odometry.stamp_ns, last + away])
    return Trajectory(stamps, np.concatenate([before[:0:-1], odometry.poses, after[1:]]), None, odometry.frame_id)


def _delayed(odometry: Trajectory, seconds: float) -> Trajectory:
    """The odometry with later stamps."""
    later = round(seconds * 1e9)
    first, last = odometry.span_ns
    _check_stamps(first + later, last + later)
    return Trajectory(odometry.stamp_ns + later, odometry.poses, None, odometry.frame_id)


def _check_stamps(first: int, last: int) -> None:
    if first < -(2**63) or last >= 2**63:
        raise SkyfixError(f"odometry: expected corrected stamps of 64 bits, got {first} to {last} ns")
