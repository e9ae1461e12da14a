"""What every filter does: move by odometry, weigh by a likelihood, answer with an estimate."""

from dataclasses import dataclass
from math import inf
from typing import Protocol

from fusion.estimate import Estimate
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What one measurement did to a filter.

    Parameters
    ----------
    log_evidence : float
        ln density per m^2 rad that the measurement gave to the prediction, before normalising.
    effective_sample_size : float
        After weighting, before resampling; of a grid, the number of cells that an even spread would fill.
    resampled : bool
        Whether the particles were resampled.
    injected : int
        Number of particles drawn from the likelihood.
    lost_score : float
        Probability of being lost after this measurement; 0 where a filter has no such model.
    used : bool
        Whether the measurement counted; a filter may leave one out that it took while standing still. The other
        numbers are then those of the last one that did.
    log_jump_density : float
        Where particles were injected, ln of the odds, before the measurement, of being lost, times the density (per m^2
        rad) that a lost one has anywhere: what a smoother weighs against the odometry's density. Minus infinity where
        nothing but odometry leads to a particle.
    """

    log_evidence: float
    effective_sample_size: float
    resampled: bool = False
    injected: int = 0
    lost_score: float = 0.0
    used: bool = True
    log_jump_density: float = -inf


class PoseFilter(Protocol):
    """A Bayes filter over poses (x, y, yaw) in the map frame."""

    def predict(self, increment: OdometryIncrement) -> None:
        """Move by an odometry increment and spread by its covariance."""
        ...

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Weigh by a likelihood, flattened by a temperature.

        Raises
        ------
        SkyfixError
            When the likelihood gives NaN or an infinity; the filter is then as it was before.
        """
        ...

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """Mean, covariance and, when `max_modes` is not 0, the heaviest modes."""
        ...
