"""How the smoother behaves."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fusion.errors import SkyfixError
from fusion.graph.odometry_drift import OdometryDrift


@dataclass(frozen=True, slots=True)
class SmootherSettings:
    """How the smoother behaves.

    Parameters
    ----------
    outlier_probability : float
        Prior chance that a measurement says nothing, in [0, 1); the chance p of a likelihood's own, given by its
        `with_outliers`, makes it ``1 - (1 - p) (1 - outlier_probability)``.
    clutter_log_density : float
        ln density per m^2 rad of a measurement that is about nothing: `fusion.likelihood.log_uniform_density` of the
        crop. The default is that of 40 m x 40 m with all headings.
    odometry_kernel : {"huber", "dcs", "none"}
        Robust loss of the odometry factors, for a registration that failed. Measurements have the null hypothesis.
    odometry_kernel_width : float
        Where that loss bends, in standard deviations.
    max_iterations : int
        Most rounds of finding factors and solving.
    drift : OdometryDrift, optional
        When given, the odometry's own scale, mounting and heading drift are found along with the poses.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    outlier_probability: float = 0.05
    clutter_log_density: float = -9.2
    odometry_kernel: Literal["huber", "dcs", "none"] = "huber"
    odometry_kernel_width: float = 4.0
    max_iterations: int = 20
    drift: OdometryDrift | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in [0, 1), got {self.outlier_probability}")
        if not np.isfinite(self.clutter_log_density):
            raise SkyfixError(f"clutter_log_density: expected a number, got {self.clutter_log_density}")
        if self.odometry_kernel not in ("huber", "dcs", "none"):
            raise SkyfixError(f"odometry_kernel: expected huber, dcs or none, got {self.odometry_kernel!r}")
        if not self.odometry_kernel_width > 0.0:
            raise SkyfixError(f"odometry_kernel_width: expected > 0, got {self.odometry_kernel_width}")
        if self.odometry_kernel == "dcs" and self.drift is not None:
            raise SkyfixError("odometry_kernel: expected huber or none for an odometry that drifts, got 'dcs'")
        if self.max_iterations < 1:
            raise SkyfixError(f"max_iterations: expected >= 1, got {self.max_iterations}")
