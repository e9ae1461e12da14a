"""How the fixed-lag smoother behaves."""

from dataclasses import dataclass

import numpy as np

from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True)
class FixedLagSettings:
    """How the fixed-lag smoother behaves.

    Parameters
    ----------
    lag : int
        Most poses held, at least 2; the oldest beyond it are summed over.
    rounds : int
        Rounds of finding stale sites anew, an update.
    refreshes : int
        Most sites found anew a round; what a round costs grows with it.
    outlier_probability : float
        Prior chance that a measurement says nothing, in [0, 1); the chance p of a likelihood's own, given by its
        `with_outliers`, makes it ``1 - (1 - p) (1 - outlier_probability)``.
    clutter_log_density : float
        ln density per m^2 rad of such a measurement where it does not tell itself, as in `SmootherSettings`.
    huber_width : float
        Motions' residuals beyond so many standard deviations count less (Huber's loss); infinity for no robust loss.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    lag: int = 100
    rounds: int = 1
    refreshes: int = 8
    outlier_probability: float = 0.05
    clutter_log_density: float = -9.2
    huber_width: float = 4.0

    def __post_init__(self) -> None:
        for name, least in (("lag", 2), ("rounds", 1), ("refreshes", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < least:
                raise SkyfixError(f"{name}: expected a whole number >= {least}, got {value!r}")
        if not 0.0 <= self.outlier_probability < 1.0:
            raise SkyfixError(f"outlier_probability: expected in [0, 1), got {self.outlier_probability}")
        if not np.isfinite(self.clutter_log_density):
            raise SkyfixError(f"clutter_log_density: expected a number, got {self.clutter_log_density}")
        if not self.huber_width > 0.0:
            raise SkyfixError(f"huber_width: expected > 0, got {self.huber_width}")
