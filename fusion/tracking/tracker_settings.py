"""TrackerSettings: how an online tracker treats its streams."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from fusion.arrays import keep_plain
from fusion.errors import SkyfixError
from fusion.odometry import OdometryNoise
from fusion.odometry_limits import OdometryLimits
from fusion.tracking.archive import Tree


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """How a tracker behaves.

    Parameters
    ----------
    history_s : float
        How late, against the newest odometry, something may arrive and still count in full. Memory grows with it:
        all odometry and all likelihoods of so many seconds are kept, and the filter's state once a step.
    step_s : float
        The filter is moved at least so often, at the first odometry sample in every such interval.
    correlation_length_m : float
        Distance over which the errors of two measurements resemble each other, see `fusion.consistency`; a matcher's
        `error_correlation_length_m`. 0 for independent errors.
    max_waiting : int
        Likelihoods that odometry does not cover yet are kept up to this many, the last to arrive.
    clock_samples : int
        Odometry ahead of everything else by more than `history_s` is believed after so many samples in a row; of slow
        odometry every sample from then on.
    noise : OdometryNoise
        Of odometry that comes as poses.
    limits : OdometryLimits
        What odometry can be believed.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    history_s: float = 2.0
    step_s: float = 0.5
    correlation_length_m: float = 0.0
    max_waiting: int = 16
    clock_samples: int = 5
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    limits: OdometryLimits = field(default_factory=OdometryLimits)

    def __post_init__(self) -> None:
        keep_plain(self, self.__slots__)
        for name in ("history_s", "step_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 1e-6):
                raise SkyfixError(f"{name}: expected at least 1e-6, got {value}")
        if not (np.isfinite(self.correlation_length_m) and self.correlation_length_m >= 0.0):
            raise SkyfixError(f"correlation_length_m: expected >= 0, got {self.correlation_length_m}")
        for name in ("max_waiting", "clock_samples"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise SkyfixError(f"{name}: expected a whole number >= 1, got {getattr(self, name)}")

    @property
    def history_ns(self) -> int:
        """`history_s` in nanoseconds."""
        return round(1e9 * self.history_s)

    @property
    def step_ns(self) -> int:
        """`step_s` in nanoseconds."""
        return round(1e9 * self.step_s)

    def to_tree(self) -> Tree:
        """Everything, for a file."""
        return asdict(self)


def settings_from_tree(tree: Any) -> TrackerSettings:
    """The settings that were written."""
    inner = {"noise": OdometryNoise(**tree["noise"]), "limits": OdometryLimits(**tree["limits"])}
    return TrackerSettings(**{**tree, **inner})
