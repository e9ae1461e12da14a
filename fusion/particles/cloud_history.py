"""CloudHistory: what a particle filter believed at some stamps, and the odometry between them.

    history = CloudHistory(max_particles=2000, seed=0)
    history.record(particles, stamp_ns)          # after the first update, say
    for increment in ...:
        particles.predict(increment)
        history.move(increment)
        ...                                      # at some of the stamps:
        report = particles.update(likelihood)
        history.record(particles, increment.stamp_ns, report)

Every update has to be followed by a record, with no odometry in between: a smoother that goes back over two updates in
one step would have to know both likelihoods. A filter resamples inside its update, so a recorded cloud may be resampled
already; it is a sample of the same density, and its particles are the ones that the next prediction moves.

A cloud of more than `max_particles` is thinned by systematic resampling, to equal weights. Memory is 32 bytes times
the particles kept times the records.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp
from typing import Protocol

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, checked, read_only
from fusion.errors import SkyfixError
from fusion.odometry import OdometryIncrement
from fusion.pose_filter import UpdateReport
from fusion.resampling import systematic


class WeightedCloud(Protocol):
    """A filter with particles, such as `ParticleFilter`."""

    @property
    def particles(self) -> FloatArray:
        """Poses (N, 3)."""
        ...

    @property
    def log_weights(self) -> FloatArray:
        """Log weights (N,), up to a constant."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RecordedCloud:
    """The filtering density at one stamp.

    Parameters
    ----------
    stamp_ns : int
        When.
    particles : (N, 3) float64
        Poses.
    weights : (N,) float64
        Sum 1.
    jump_density : float
        With which a pose may have come from anywhere, beside the odometry's density; 0 when it cannot have.
    """

    stamp_ns: int
    particles: FloatArray
    weights: FloatArray
    jump_density: float = 0.0


class CloudHistory:
    """Records a filter as it runs.

    Parameters
    ----------
    max_particles : int, optional
        Most particles kept of a cloud; all when left out.
    seed : int or numpy Generator
        Of the thinning.

    Raises
    ------
    SkyfixError
        When `max_particles` is not positive.
    """

    def __init__(self, max_particles: int | None = None, seed: int | np.random.Generator = 0) -> None:
        if max_particles is not None and max_particles < 1:
            raise SkyfixError(f"max_particles: expected >= 1, got {max_particles}")
        self._max_particles = max_particles
        self._rng = np.random.default_rng(seed)
        self._clouds: list[RecordedCloud] = []
        self._motions: list[list[OdometryIncrement]] = []
        self._pending: list[OdometryIncrement] = []

    def __len__(self) -> int:
        return len(self._clouds)

    @property
    def clouds(self) -> Sequence[RecordedCloud]:
        """All records, in order."""
        return tuple(self._clouds)

    @property
    def motions(self) -> Sequence[Sequence[OdometryIncrement]]:
        """Increments from each record to the next."""
        return tuple(tuple(motion) for motion in self._motions)

    def move(self, increment: OdometryIncrement) -> None:
        """Tell of an increment that the filter was moved by.

        Raises
        ------
        SkyfixError
            When nothing was recorded yet, or the increment does not end after all that came before.
        """
        if not self._clouds:
            raise SkyfixError("history: expected a recorded cloud before the first increment, got none")
        last = self._pending[-1].stamp_ns if self._pending else self._clouds[-1].stamp_ns
        if increment.stamp_ns <= last:
            raise SkyfixError(f"increment: expected a stamp after {last} ns, got {increment.stamp_ns} ns")
        self._pending.append(increment)

    def record(self, cloud: WeightedCloud, stamp_ns: int, report: UpdateReport | None = None) -> None:
        """Keep the filter's cloud at a stamp; at the stamp of the last record, keep it in its place.

        Parameters
        ----------
        cloud : WeightedCloud
            The filter.
        stamp_ns : int
            When.
        report : UpdateReport, optional
            Of the measurement at this stamp. Without it a smoother takes every particle for one that odometry moved.

        Raises
        ------
        SkyfixError
            When the stamp is not that of the last increment, or weights or particles are not finite.
        """
        expected = self._pending[-1].stamp_ns if self._pending else None
        if self._clouds and not self._pending:
            expected = self._clouds[-1].stamp_ns
        if expected is not None and stamp_ns != expected:
            raise SkyfixError(f"history: expected the stamp of the last increment, {expected} ns, got {stamp_ns} ns")
        recorded = replace(self._thinned(cloud, stamp_ns), jump_density=exp(report.log_jump_density) if report else 0.0)
        if self._clouds and not self._pending:
            before = self._clouds[-1].jump_density
            self._clouds[-1] = replace(recorded, jump_density=before + recorded.jump_density)
            return
        if self._pending:
            self._motions.append(self._pending)
            self._pending = []
        self._clouds.append(recorded)

    def _thinned(self, cloud: WeightedCloud, stamp_ns: int) -> RecordedCloud:
        particles = checked("recorded particles", cloud.particles, ("N", 3))
        log_weights = checked("recorded log weights", cloud.log_weights, (len(particles),))
        if len(particles) == 0:
            raise SkyfixError("recorded particles: expected at least one, got none")
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        if self._max_particles is not None and len(particles) > self._max_particles:
            particles = particles[systematic(weights, self._max_particles, self._rng)]
            weights = np.full(len(particles), 1.0 / len(particles))
        kept = particles.copy()
        kept[:, 2] = se2.wrap(kept[:, 2])
        return RecordedCloud(stamp_ns, read_only(kept), read_only(weights))
