"""OdometryDrift: how an odometry's own errors are allowed to be, when a graph is to find them."""

from dataclasses import dataclass, fields

import numpy as np

from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True)
class OdometryDrift:
    """Standard deviations of an odometry's errors about zero at the start, and of how they change along the way.

    Parameters
    ----------
    log_scale, mount_yaw_rad, heading_bias_rad_per_m : float
        At the start: of ln true over told distance, of the heading of the odometry's forward axis in the vehicle's
        body, of what its heading lacks per metre.
    log_scale_walk, mount_yaw_walk_rad, heading_bias_walk_rad_per_m : float
        Of their changes over 100 m, a random walk.
    stretch_m : float
        They are constant over so many metres.

    Raises
    ------
    SkyfixError
        When a value is not positive and finite.
    """

    log_scale: float = 0.02
    mount_yaw_rad: float = 0.01
    heading_bias_rad_per_m: float = 1e-4
    log_scale_walk: float = 0.005
    mount_yaw_walk_rad: float = 0.002
    heading_bias_walk_rad_per_m: float = 1e-4
    stretch_m: float = 50.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (np.isfinite(value) and value > 0.0):
                raise SkyfixError(f"odometry drift {entry.name}: expected > 0, got {value}")

    @classmethod
    def steady(cls) -> "OdometryDrift":
        """Scale and mounting that stay, and no heading bias: all that a filter, which has no such states, can take out.

        What does wander is then found as noise.
        """
        return cls(
            log_scale_walk=1e-4,
            mount_yaw_walk_rad=2e-5,
            heading_bias_rad_per_m=1e-6,
            heading_bias_walk_rad_per_m=1e-7,
        )

    @property
    def first_sigmas(self) -> FloatArray:
        """(3,), of the first stretch."""
        return np.array([self.log_scale, self.mount_yaw_rad, self.heading_bias_rad_per_m])

    @property
    def step_sigmas(self) -> FloatArray:
        """(3,), of the difference between neighbouring stretches."""
        walk = np.array([self.log_scale_walk, self.mount_yaw_walk_rad, self.heading_bias_walk_rad_per_m])
        return walk * np.sqrt(self.stretch_m / 100.0)

    def stretches(self, deltas: FloatArray) -> IntArray:
        """Which stretch each delta (M, 3) belongs to, from 0 without a gap."""
        way = np.cumsum(np.hypot(deltas[:, 0], deltas[:, 1]))
        place = np.floor((way - way[0]) / self.stretch_m).astype(np.int64)
        return np.unique(place, return_inverse=True)[1].astype(np.int64)
