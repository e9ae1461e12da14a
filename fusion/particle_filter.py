"""The particle filter: online fusion of odometry increments with map likelihoods.

Sequential importance resampling on SE(2) with log weights, kernel regularisation and a model of being lost, see
`fusion.particles.lost`. When the log odds of being lost exceed a margin, particles drawn from the likelihood are
injected with the total weight `lost_score`: exactly the posterior of the mixture of both states.

A step is one pass over the particles, see `fusion.particles.cloud`: `predict` writes an increment down, and the
`update` that follows moves, weighs and sums. Estimates are of the weighted cloud, before resampling adds its noise.

Sources: Gordon, Salmond, Smith 1993; Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, 8.3.5 (augmented MCL).
"""

from math import hypot, inf, log
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.grid import MapGrid
from fusion.likelihood import OutlierMixture, PoseLikelihood, checked_temperature
from fusion.odometry import OdometryIncrement
from fusion.particles.cloud import Cloud
from fusion.particles.clusters import find_clusters
from fusion.particles.filter_state import ParticleFilterState, generator_of, generator_state
from fusion.particles.guided_proposal import guided
from fusion.particles.lattice_density import LatticeDensity
from fusion.particles.lookup import lookup_of
from fusion.particles.lost import LostModel, log_uniform_evidence, probability
from fusion.particles.map_start import stratified_poses
from fusion.particles.moments import Moments, positive_definite
from fusion.particles.particle_filter_settings import ParticleFilterSettings
from fusion.particles.regularisation import is_compact, silverman_bandwidth
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior
from fusion.resampling import RESAMPLERS

__all__ = ["ParticleFilter", "ParticleFilterSettings", "ParticleFilterState"]

_MISSED_NATS = -1.0  # of evidence against a random pose, where particles have missed a likelihood or are lost


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
        key = self._rng.integers(2**32, size=4, dtype=np.uint32)
        self._cloud = Cloud(cloud, None if log_weights is None else weights, key, self.settings.threads)
        self._lost_model = LostModel(self.settings.kidnap_probability, self.settings.recovery_probability)
        self._log_evidence = 0.0
        self._travelled_m = self._turned_rad = inf  # since the last measurement that counted: the first one does
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
    def from_map(
        cls,
        grid: MapGrid,
        count: int,
        seed: int | np.random.Generator,
        settings: ParticleFilterSettings | None = None,
        allowed: ArrayLike | None = None,
    ) -> Self:
        """A filter that knows nothing: `count` particles all over a map, see `fusion.particles.map_start`."""
        rng = np.random.default_rng(seed)
        return cls(stratified_poses(grid, count, rng, allowed), rng, settings)

    @classmethod
    def from_state(cls, state: ParticleFilterState, settings: ParticleFilterSettings | None = None) -> Self:
        """A filter that goes on from a state."""
        restored = cls(state.particles, 0, settings, state.log_weights)
        restored.restore(state)
        return restored

    def state(self) -> ParticleFilterState:
        """A copy of all that the filter knows; it goes on from there itself, so that a restored one does the same."""
        cloud = self._cloud
        moments = cloud.moments()
        state = ParticleFilterState(
            particles=read_only(cloud.poses()),
            log_weights=read_only(cloud.log_weights()),
            anchor=read_only(np.array(cloud.anchor)),
            mean=read_only(np.array(moments.mean)),
            covariance=read_only(np.array(moments.covariance)),
            effective_sample_size=moments.effective_sample_size,
            log_evidence=self._log_evidence,
            lost_score=self._lost,
            moved=read_only(np.array([self._travelled_m, self._turned_rad])),
            key=read_only(cloud.key),
            epoch=cloud.epoch,
            generator=generator_state(self._rng),
        )
        self.restore(state)
        return state

    def restore(self, state: ParticleFilterState) -> None:
        """Go back to a state of this filter, or of one with the same settings.

        Raises
        ------
        SkyfixError
            When shapes disagree, a value is not finite, or the generator is unknown; the filter is then as it was.
        """
        state.check()
        self._rng = generator_of(state.generator)
        x, y, yaw = state.mean.tolist()
        moments = Moments(state.effective_sample_size, (x, y, yaw), state.covariance.tolist())
        self._cloud.resume(state.particles, state.log_weights, state.anchor, moments)
        self._cloud.rekey(state.key.astype(np.uint32), state.epoch)
        self._log_evidence, self._lost = state.log_evidence, state.lost_score
        self._travelled_m, self._turned_rad = state.moved.tolist()

    def reseed(self, key: int) -> None:
        """Draw all further randomness from a generator started with `key`, a non-negative integer."""
        self._rng = np.random.default_rng(key)
        self._cloud.rekey(self._rng.integers(2**32, size=4, dtype=np.uint32))

    @property
    def particles(self) -> FloatArray:
        """Poses (N, 3), read-only."""
        return read_only(self._cloud.poses())

    @property
    def log_weights(self) -> FloatArray:
        """Normalised log weights (N,), read-only."""
        return read_only(self._cloud.log_weights())

    @property
    def lost_score(self) -> float:
        """Probability of being lost after the last measurement."""
        return self._lost

    def predict(self, increment: OdometryIncrement) -> None:
        """Move every particle by the increment plus noise of its covariance."""
        delta = increment.delta.tolist()
        self._cloud.move(delta, increment.covariance.tolist())
        self._travelled_m += hypot(delta[0], delta[1])
        self._turned_rad += abs(delta[2])

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
        if self._travelled_m < settings.standstill_m and self._turned_rad < settings.standstill_rad:
            size = self._cloud.moments().effective_sample_size
            return UpdateReport(self._log_evidence, size, lost_score=self._lost, used=False)
        log_uniform = log_uniform_evidence(likelihood, settings.outlier_probability)
        log_evidence = self._weigh(likelihood, temperature)
        if self._is_missed(log_evidence - log_uniform):
            log_evidence = self._weigh_guided(
                likelihood.tempered(temperature).with_outliers(settings.outlier_probability)
            )
        self._log_evidence = log_evidence
        self._travelled_m = self._turned_rad = 0.0
        log_odds = self._lost_model.log_odds(self._lost, log_evidence, log_uniform)
        self._lost = probability(log_odds)
        size = self._cloud.moments().effective_sample_size
        is_degenerate = size < settings.ess_fraction * len(self._cloud) or settings.adaptive is not None
        count = self._next_count()
        is_collapsed = log_odds > settings.collapse_log_evidence_margin
        injected = min(round(settings.injection_share * count), count - 1) if is_collapsed else 0
        if injected or is_degenerate:
            self._resample(count - injected)
        if injected:
            measurement = likelihood.tempered(temperature).with_outliers(settings.outlier_probability)
            self._inject(measurement.sample(injected, self._rng))
        jump = log_odds - log_uniform + log_evidence - log(likelihood.searched_volume) if injected else -inf
        return UpdateReport(
            log_evidence, size, bool(injected or is_degenerate), injected, self._lost, log_jump_density=jump
        )

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """Summary of the cloud; with its `max_modes` heaviest clusters when that is not 0.

        The covariance is the unbiased one of a weighted sample: that of the cloud times ``1 / (1 - sum w^2)``, which
        is ``ESS / (ESS - 1)``, at most 2; and never less than 1 mm and 0.1 mrad.
        """
        moments, modes = self._cloud.moments(), None
        if max_modes:
            modes = find_clusters(self._cloud.poses(), np.exp(self._cloud.log_weights())).mixture(max_modes)
        x, y, yaw = moments.mean
        pose = np.array((x + self._cloud.anchor[0], y + self._cloud.anchor[1], yaw))
        size = moments.effective_sample_size
        covariance = positive_definite(moments.covariance, size / (size - 1.0) if size > 2.0 else 2.0)
        return Estimate(stamp_ns, pose, covariance, modes, size, self._log_evidence, self._lost)

    def most_likely_pose(self) -> FloatArray:
        """The particle (3,) where the cloud is densest, by a kernel estimate: a mode; the mean may lie between two."""
        poses = self._cloud.poses()
        density = LatticeDensity.of(poses, self._cloud.log_weights()).log_density(poses)
        return poses[int(np.argmax(density))]

    def _weigh(self, likelihood: PoseLikelihood, temperature: float) -> float:
        """Weigh the cloud, in one pass when the likelihood can be looked up, and give the log evidence."""
        checked_temperature(temperature)
        mixture = likelihood.with_outliers(self.settings.outlier_probability)
        if isinstance(mixture, OutlierMixture):
            lookup = lookup_of(mixture.likelihood, temperature, self._cloud.poses)
            if lookup is not None:
                return self._cloud.weigh(lookup, mixture.probability)
        measurement = likelihood.tempered(temperature).with_outliers(self.settings.outlier_probability)
        log_likelihood = np.asarray(measurement.log_density(self._cloud.poses()), dtype=np.float64)
        if log_likelihood.shape != (len(self._cloud),) or not np.isfinite(log_likelihood).all():
            raise SkyfixError(f"likelihood: expected {len(self._cloud)} finite log densities, got others")
        return self._cloud.add_log_likelihood(log_likelihood)

    def _is_missed(self, nats: float) -> bool:
        """Whether too few particles are where the measurement says, which gave them `nats` more than a random pose."""
        least = self.settings.guided_below if self.settings.guided_share > 0.0 else 0.0
        return self._cloud.moments().effective_sample_size < least or (least > 0.0 and nats < _MISSED_NATS)

    def _weigh_guided(self, measurement: PoseLikelihood) -> float:
        """Take back what a measurement has done to the weights, replace the cloud by draws from it and from the
        measurement, weigh these and give the log evidence."""
        self._cloud.add_log_likelihood(-measurement.log_density(self._cloud.poses()))
        predicted = LatticeDensity.of(self._cloud.poses(), self._cloud.log_weights())
        count = len(self._cloud)
        poses, log_weights = guided(predicted, measurement, count, self.settings.guided_share, self._rng)
        if not np.isfinite(log_weights).all():
            raise SkyfixError(f"likelihood: expected {count} finite log densities, got others")
        self._cloud.replace(poses, log_weights)
        largest = log_weights.max()
        return float(largest + np.log(np.exp(log_weights - largest).mean()))

    def _next_count(self) -> int:
        """How many particles the cloud is to have after this measurement."""
        if self.settings.adaptive is None:
            return len(self._cloud)
        return self.settings.adaptive.count(self._cloud.poses(), np.exp(self._cloud.log_weights()), self._rng)

    def _resample(self, count: int) -> None:
        """Replace the cloud by `count` equally weighted particles."""
        cloud, scale, moments = self._cloud, self.settings.regularisation, self._cloud.moments()
        if self.settings.resampler == "systematic":
            cloud.resample(count, self._rng.random())
        else:
            weights = np.exp(cloud.log_weights())
            cloud.keep(RESAMPLERS[self.settings.resampler](weights, count, self._rng).astype(np.int32))
        cloud.arrange()
        if scale > 0.0:
            if is_compact(moments.covariance):
                cloud.regularise(scale * silverman_bandwidth(count, 3))
            else:
                cloud.regularise_in_clusters(scale)

    def _inject(self, fresh: FloatArray) -> None:
        """Add particles (n, 3) that have the weight of being lost together."""
        kept = self._cloud.poses()
        weights = np.full(len(kept) + len(fresh), np.log1p(-self._lost) - np.log(len(kept)))
        weights[len(kept) :] = np.log(self._lost) - np.log(len(fresh))
        self._cloud.replace(np.concatenate([kept, fresh]), weights)
