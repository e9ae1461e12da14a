"""A particle filter's state: a copy from which it goes on bit for bit, of arrays, numbers and strings alone."""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True, eq=False)
class ParticleFilterState:
    """All that a particle filter knows at one time; with the same settings it continues bit for bit.

    Parameters
    ----------
    particles : (N, 3) float64
        Poses, map frame.
    log_weights : (N,) float64
        Normalised.
    anchor : (2,) float64
        What the filter counts positions from, map frame.
    mean, covariance : (3,) and (3, 3) float64
        Of the last posterior: x and y of the mean relative to the anchor. Resampling since then has changed neither.
    effective_sample_size : float
        Of that posterior.
    log_evidence, lost_score : float
        Of and after the last measurement.
    moved : (2,) float64
        Metres travelled and radians turned since that measurement; infinite before the first.
    key : (4,) uint32
        Of the particles' random numbers.
    epoch : int
        How many orders have used it.
    generator : str
        State of the random generator for everything else, JSON.
    """

    particles: FloatArray
    log_weights: FloatArray
    anchor: FloatArray
    mean: FloatArray
    covariance: FloatArray
    effective_sample_size: float
    log_evidence: float
    lost_score: float
    moved: FloatArray
    key: NDArray[np.uint32]
    epoch: int
    generator: str

    def check(self) -> None:
        """Raise SkyfixError when shapes disagree or a value is out of range."""
        count = len(checked("particles", self.particles, ("N", 3)))
        checked("log weights", self.log_weights, (count,))
        checked("anchor", self.anchor, (2,))
        checked("mean", self.mean, (3,))
        checked("covariance", self.covariance, (3, 3))
        numbers = np.array([self.lost_score, self.log_evidence, self.effective_sample_size])
        if count == 0 or not np.isfinite(numbers).all() or not 0.0 <= self.lost_score <= 1.0:
            raise SkyfixError(f"filter state: expected particles and finite numbers, got {count} particles")
        if np.shape(self.moved) != (2,) or np.isnan(self.moved).any() or np.shape(self.key) != (4,):
            raise SkyfixError("filter state: expected 2 lengths and a key of 4 numbers, got others")


def generator_state(generator: np.random.Generator) -> str:
    """The state of a random generator, JSON."""
    return json.dumps(generator.bit_generator.state, default=np.ndarray.tolist)


def generator_of(state: str) -> np.random.Generator:
    """The random generator of a state.

    Raises
    ------
    SkyfixError
        When it is not one.
    """
    try:
        fields = json.loads(state)
        generator = np.random.Generator(getattr(np.random, fields["bit_generator"])())
        generator.bit_generator.state = fields
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SkyfixError(f"filter state: expected the state of a random generator, got {state[:40]!r}") from error
    return generator
