"""Am I lost? The second state of a filter, as a hidden Markov model of two states.

A filter that is on track gives a measurement the evidence ``Z = sum_i w_i L(x_i)``; a lost one gives it

    U = (1 - p) / V_s + p / V

the evidence of a pose uniform over the searched volume V_s: the crop times the headings that were looked at, because
the measurement integrates to 1 there. Its outliers, of probability p, are uniform over the crop times all headings, V.
With the probability of becoming lost and of recovering between two measurements,

    lost' = lost (1 - recovery) + (1 - lost) kidnap
    lost_score = lost' U / (lost' U + (1 - lost') Z)

Z is taken before the weights are normalised, otherwise this could never fire.

Source: Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.3.5, for why; the forward recursion of Rabiner, "A
tutorial on hidden Markov models", 1989, III.A.
"""

from dataclasses import dataclass
from math import exp, isfinite, log

from fusion import se2
from fusion.errors import SkyfixError
from fusion.likelihood import PoseLikelihood


@dataclass(frozen=True, slots=True)
class LostModel:
    """The chances of the two-state model.

    Parameters
    ----------
    kidnap_probability : float
        Chance of getting lost between two measurements, in (0, 1).
    recovery_probability : float
        Chance of being on track again at the next measurement once lost, in (0, 1).

    Raises
    ------
    SkyfixError
        When a probability is out of range.
    """

    kidnap_probability: float = 1e-3
    recovery_probability: float = 0.1

    def __post_init__(self) -> None:
        for name in ("kidnap_probability", "recovery_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise SkyfixError(f"{name}: expected in (0, 1), got {getattr(self, name)}")

    def log_odds(self, lost: float, log_evidence: float, log_uniform: float) -> float:
        """Log odds of being lost after a measurement, from the probability of being lost before it.

        Parameters
        ----------
        lost : float
            Probability of being lost before.
        log_evidence : float
            ln Z.
        log_uniform : float
            ln U, see `log_uniform_evidence`.
        """
        after = lost * (1.0 - self.recovery_probability) + (1.0 - lost) * self.kidnap_probability
        return log(after) - log(1.0 - after) + log_uniform - log_evidence


def log_uniform_evidence(likelihood: PoseLikelihood, outlier_probability: float) -> float:
    """ln U: the evidence that a pose uniform over what `likelihood` searched gives to it, with outliers.

    Raises
    ------
    SkyfixError
        When the searched volume is not a positive number.
    """
    searched, p = likelihood.searched_volume, outlier_probability
    if not (isfinite(searched) and searched > 0.0):
        raise SkyfixError(f"likelihood: expected a searched volume > 0 m^2 rad, got {searched}")
    return log((1.0 - p) / searched + p / (likelihood.grid.area_m2 * se2.TWO_PI))


def probability(log_odds: float) -> float:
    """Probability of something from its log odds, without overflow."""
    if log_odds >= 0.0:
        return 1.0 / (1.0 + exp(-log_odds))
    odds = exp(max(log_odds, -745.0))
    return odds / (1.0 + odds)
