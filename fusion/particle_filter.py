"""The particle filter: online fusion of odometry increments with map likelihoods.

Sequential importance resampling on SE(2) with log weights, kernel regularisation and a model of being lost.

Being lost is the second state of a two-state hidden Markov model. A filter that is on track gives a measurement the
evidence ``Z = sum_i w_i L(x_i)``; a lost one gives it ``1 / V``, the evidence of a pose uniform over the crop of volume
V, because L integrates to 1 there. With the probability of becoming lost and of recovering between two measurements,

    lost' = lost (1 - recovery) + (1 - lost) kidnap
    lost_score = lost' / V / (lost' / V + (1 - lost') Z)

When its log odds exceed a margin, particles drawn from the likelihood are injected with the total weight `lost_score`:
exactly the posterior of the mixture of both states. Z is taken before the weights are normalised, otherwise this could
never fire.

Sources: Gordon, Salmond, Smith 1993; Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.3.5 (augmented MCL).
"""

import json
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, logit, logsumexp

from fusion import se2
from fusion.arrays import FloatArray, checked, read_only
from fusion.clusters import VARIANCE_FLOOR, find_clusters
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.likelihood import PoseLikelihood, log_uniform_density
from fusion.odometry import OdometryIncrement
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior
from fusion.regularisation import matrix_root, regularised
from fusion.resampling import RESAMPLERS, effective_sample_size


@dataclass(frozen=True, slots=True)
class ParticleFilterSettings:
    """How the filter behaves.

    Parameters
    ----------
    resampler : str
        Name in `fusion.resampling.RESAMPLERS`.
    ess_fraction : float
        Resample when the effective sample size falls below this share of the particles, in [0, 1].
    outlier_probability : float
        Chance that a measurement is about nothing, in (0, 1); bounds what one measurement can do.
    regularisation : float
        Kernel noise after resampling, in units of Silverman's bandwidth, in [0, 1]; 0 switches it off.
    kidnap_probability : float
        Chance of getting lost between two measurements, in (0, 1).
    recovery_probability : float
        Chance of being on track again at the next measurement once lost, in (0, 1).
    collapse_log_evidence_margin : float
        Inject particles when being lost is ahead of being on track by this many nats.
    injection_share : float
        Share of the particles that is injected then, in [0, 1); 0 switches recovery off.

    Raises
    ------
    SkyfixError
        When a value is out of range or the resampler unknown.
    """

    resampler: str = "systematic"
    ess_fraction: float = 0.5
    outlier_probability: float = 0.05
    regularisation: float = 0.5
    kidnap_probability: float = 1e-3
    recovery_probability: float = 0.1
    collapse_log_evidence_margin: float = 1.0
    injection_share: float = 0.25

    def __post_init__(self) -> None:
        if self.resampler not in RESAMPLERS:
            raise SkyfixError(f"resampler: expected one of {', '.join(RESAMPLERS)}, got {self.resampler!r}")
        for name in ("ess_fraction", "regularisation"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise SkyfixError(f"{name}: expected in [0, 1], got {getattr(self, name)}")
        for name in ("outlier_probability", "kidnap_probability", "recovery_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise SkyfixError(f"{name}: expected in (0, 1), got {getattr(self, name)}")
        if not 0.0 <= self.injection_share < 1.0:
            raise SkyfixError(f"injection_share: expected in [0, 1), got {self.injection_share}")
        if not np.isfinite(self.collapse_log_evidence_margin):
            raise SkyfixError(
                f"collapse_log_evidence_margin: expected a number, got {self.collapse_log_evidence_margin}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ParticleFilterState:
    """All that a particle filter knows at one time; with the same settings it continues bit for bit.

    Parameters
    ----------
    particles : (N, 3) float64
        Poses, map frame.
    log_weights : (N,) float64
        Normalised.
    log_evidence : float
        Of the last measurement.
    lost_score : float
        After the last measurement.
    generator : str
        State of the random generator, JSON.
    """

    particles: FloatArray
    log_weights: FloatArray
    log_evidence: float
    lost_score: float
    generator: str


class ParticleFilter:
    """Weighted particles over (x, y, yaw) in the map frame.

    Parameters
    ----------
    particles : (N, 3) array_like
        First cloud.
    seed : int or numpy Generator
        Source of all randomness; the same seed gives the same run.
    settings : ParticleFilterSettings
        How the filter behaves.
    log_weights : (N,) array_like, optional
        Of the first cloud, up to a constant; equal when left out.

    Raises
    ------
    SkyfixError
        When there is no particle, or one of them or of the weights is not finite.
    """

    def __init__(
        self,
        particles: ArrayLike,
        seed: int | np.random.Generator,
        settings: ParticleFilterSettings | None = None,
        log_weights: ArrayLike | None = None,
    ) -> None:
        cloud = checked("particles", particles, ("N", 3)).copy()
        if len(cloud) == 0:
            raise SkyfixError("particles: expected at least one, got none")
        weights = np.zeros(len(cloud)) if log_weights is None else checked("log weights", log_weights, (len(cloud),))
        cloud[:, 2] = se2.wrap(cloud[:, 2])
        self.settings = settings or ParticleFilterSettings()
        self._rng = np.random.default_rng(seed)
        self._particles = cloud
        self._log_weights = weights - logsumexp(weights)
        self._log_evidence = 0.0
        self._lost = self.settings.kidnap_probability

    @classmethod
    def from_prior(
        cls,
        prior: UniformPrior,
        count: int,
        seed: int | np.random.Generator,
        settings: ParticleFilterSettings | None = None,
    ) -> Self:
        """A filter with `count` particles drawn from a prior."""
        rng = np.random.default_rng(seed)
        return cls(prior.sample(count, rng), rng, settings)

    @classmethod
    def from_state(cls, state: ParticleFilterState, settings: ParticleFilterSettings | None = None) -> Self:
        """A filter that goes on from a state."""
        restored = cls(state.particles, 0, settings, state.log_weights)
        restored.restore(state)
        return restored

    def state(self) -> ParticleFilterState:
        """A copy of all that the filter knows."""
        generator = json.dumps(self._rng.bit_generator.state, default=np.ndarray.tolist)
        particles, log_weights = read_only(self._particles.copy()), read_only(self._log_weights.copy())
        return ParticleFilterState(particles, log_weights, self._log_evidence, self._lost, generator)

    def restore(self, state: ParticleFilterState) -> None:
        """Go back to a state of this filter, or of one with the same settings.

        Raises
        ------
        SkyfixError
            When shapes disagree, a value is not finite, or the generator is unknown; the filter is then as it was.
        """
        particles = checked("particles", state.particles, ("N", 3)).copy()
        log_weights = checked("log weights", state.log_weights, (len(particles),)).copy()
        if len(particles) == 0 or not 0.0 <= state.lost_score <= 1.0 or not np.isfinite(state.log_evidence):
            raise SkyfixError(f"filter state: expected particles and finite numbers, got {len(particles)} particles")
        self._rng = _generator(state.generator)
        self._particles, self._log_weights = particles, log_weights
        self._log_evidence, self._lost = state.log_evidence, state.lost_score

    def reseed(self, key: int) -> None:
        """Draw all further randomness from a generator started with `key`, a non-negative integer."""
        self._rng = np.random.default_rng(key)

    @property
    def particles(self) -> FloatArray:
        """Poses (N, 3), a read-only view."""
        return read_only(self._particles)

    @property
    def log_weights(self) -> FloatArray:
        """Normalised log weights (N,), a read-only view."""
        return read_only(self._log_weights)

    @property
    def lost_score(self) -> float:
        """Probability of being lost after the last measurement."""
        return self._lost

    def predict(self, increment: OdometryIncrement) -> None:
        """Move every particle by the increment plus noise of its covariance."""
        noise = self._rng.standard_normal(self._particles.shape) @ matrix_root(increment.covariance).T
        self._particles = se2.compose(self._particles, increment.delta + noise)

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Weight the particles by a likelihood; resample and recover when needed.

        Parameters
        ----------
        likelihood : PoseLikelihood
            Not masked by a prior, not tempered, without outliers: both are done here.
        temperature : float
            Flattens the likelihood for errors shared with the previous measurement, see `fusion.consistency`.

        Raises
        ------
        SkyfixError
            When the likelihood gives NaN or an infinity; the filter is then as it was before.
        """
        settings = self.settings
        measurement = likelihood.tempered(temperature).with_outliers(settings.outlier_probability)
        log_likelihood = np.asarray(measurement.log_density(self._particles), dtype=np.float64)
        if log_likelihood.shape != self._log_weights.shape or not np.isfinite(log_likelihood).all():
            raise SkyfixError(f"likelihood: expected {len(self._particles)} finite log densities, got others")

        joint = self._log_weights + log_likelihood
        log_evidence = float(logsumexp(joint))
        log_odds = self._lost_log_odds(log_evidence - log_uniform_density(measurement.grid))
        is_collapsed = log_odds > settings.collapse_log_evidence_margin
        count = len(self._particles)
        injected = min(round(settings.injection_share * count), count - 1) if is_collapsed else 0
        fresh = measurement.sample(injected, self._rng) if injected else np.empty((0, 3))

        self._log_evidence, self._lost = log_evidence, float(expit(log_odds))
        self._log_weights = joint - log_evidence
        size = effective_sample_size(self._log_weights)
        is_degenerate = size < settings.ess_fraction * count
        if injected or is_degenerate:
            self._resample(count - injected)
        if injected:
            self._particles = np.concatenate([self._particles, fresh])
            of_the_fresh = np.full(injected, np.log(self._lost) - np.log(injected))
            self._log_weights = np.concatenate([self._log_weights + np.log1p(-self._lost), of_the_fresh])
        return UpdateReport(log_evidence, size, bool(injected or is_degenerate), injected, self._lost)

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """Summary of the cloud; with its `max_modes` heaviest clusters when that is not 0."""
        weights = np.exp(self._log_weights)
        pose, covariance = se2.weighted_mean_and_covariance(self._particles, weights)
        modes = find_clusters(self._particles, weights).mixture(max_modes) if max_modes else None
        size = effective_sample_size(self._log_weights)
        covariance = covariance + VARIANCE_FLOOR
        return Estimate(stamp_ns, pose, covariance, modes, size, self._log_evidence, self._lost)

    def _lost_log_odds(self, log_ratio: float) -> float:
        """Log odds of being lost after a measurement with evidence ``exp(log_ratio)`` times that of a lost filter."""
        stays = self._lost * (1.0 - self.settings.recovery_probability)
        return float(logit(stays + (1.0 - self._lost) * self.settings.kidnap_probability) - log_ratio)

    def _resample(self, count: int) -> None:
        """Replace the cloud by `count` equally weighted particles."""
        chosen = RESAMPLERS[self.settings.resampler](np.exp(self._log_weights), count, self._rng)
        self._particles = regularised(self._particles[chosen], self.settings.regularisation, self._rng)
        self._log_weights = np.full(count, -np.log(count))


def _generator(state: str) -> np.random.Generator:
    """The random generator of a state, JSON."""
    try:
        fields = json.loads(state)
        generator = np.random.Generator(getattr(np.random, fields["bit_generator"])())
        generator.bit_generator.state = fields
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SkyfixError(f"filter state: expected the state of a random generator, got {state[:40]!r}") from error
    return generator
