"""A vehicle that may be anywhere on the map: what is known of it beforehand, and the places where it may be.

What is known of a vehicle that was given up is a mixture: with the probability of being lost it is anywhere on the map,
else where the filter has it. So one that was given up wrongly is not thrown away, it is one candidate among the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.estimate import Estimate
from fusion.grid import MapGrid
from fusion.particle_filter import ParticleFilter
from fusion.particles.clusters import VARIANCE_FLOOR, Clusters, find_clusters
from fusion.particles.lattice_density import LatticeDensity
from fusion.particles.regularisation import regularised
from fusion.prior import UniformPrior
from fusion.resampling import systematic

_LOST_RANGE = (0.5, 0.99)
"""Bounds of the probability of being lost: who gave the vehicle up has reasons, and may be wrong."""
_LIKELY_PLACES = 12
_KERNEL = 0.5  # of Silverman's bandwidth, as in the filter


def map_box(grid: MapGrid) -> UniformPrior:
    """The square about a whole map, of any heading: where a vehicle is that nothing is known about."""
    return UniformPrior(np.array([*grid.centre_xy, 0.0]), 0.5 * max(grid.width_m, grid.height_m), np.pi)


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """A filter that has been moved to a measurement and not been weighed by it.

    Attributes
    ----------
    poses, log_weights
        (N, 3) and (N,) of its particles.
    lost_score
        Its probability of being lost.
    """

    poses: FloatArray
    log_weights: FloatArray
    lost_score: float

    @classmethod
    def of(cls, particles: ParticleFilter) -> Predicted:
        """The filter as it is now."""
        return cls(particles.particles, particles.log_weights, particles.lost_score)


@dataclass(frozen=True, slots=True, eq=False)
class GivenUp:
    """What is known of a vehicle that was given up; a `start_cloud.StartPrior`.

    Attributes
    ----------
    box
        The map.
    kept
        The filter's density.
    lost
        Probability that the filter is wrong.
    """

    box: UniformPrior
    kept: LatticeDensity
    lost: float

    @classmethod
    def by(cls, predicted: Predicted, grid: MapGrid) -> GivenUp:
        """From a filter before the measurement that the search begins with."""
        lost = min(max(predicted.lost_score, _LOST_RANGE[0]), _LOST_RANGE[1])
        return cls(map_box(grid), LatticeDensity.of(predicted.poses, predicted.log_weights), lost)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3)."""
        from_box = round(self.lost * n)
        return np.concatenate([self.box.sample(from_box, rng), self.kept.sample(n - from_box, rng)])

    def log_density(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) at poses (N, 3), per m^2 rad."""
        anywhere, kept = self.box.log_density(poses), self.kept.log_density(poses)
        return np.logaddexp(np.log(self.lost) + anywhere, np.log1p(-self.lost) + kept)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """The places where the vehicle may be: the clusters of the cloud.

    Attributes
    ----------
    clusters
        Of the filter's particles.
    """

    clusters: Clusters

    @classmethod
    def of(cls, particles: ParticleFilter) -> Candidates:
        """From the filter, as it is."""
        return cls(find_clusters(particles.particles, np.exp(particles.log_weights)))

    @property
    def share(self) -> float:
        """Of the heaviest."""
        return float(self.clusters.weights.max())

    def likely(self) -> FloatArray:
        """Mean poses (M, 3) of the heaviest."""
        heaviest = np.argsort(-self.clusters.weights, kind="stable")[:_LIKELY_PLACES]
        means = self.clusters.means[heaviest]
        means[:, 2] = se2.wrap(means[:, 2])
        return means

    def likeliest(self, estimate: Estimate) -> Estimate:
        """An estimate of the whole cloud, made one of its heaviest place; the others' share is the chance of error."""
        heaviest = int(np.argmax(self.clusters.weights))
        return replace(
            estimate,
            pose=self.clusters.means[heaviest],
            covariance=self.clusters.covariances[heaviest] + VARIANCE_FLOOR,
            lost_score=max(estimate.lost_score, 1.0 - self.share),
        )

    def heaviest_alone(self, particles: ParticleFilter, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw particles (count, 3) from the heaviest place."""
        members = self.clusters.labels == int(np.argmax(self.clusters.weights))
        log_weights = particles.log_weights[members]
        weights = np.exp(log_weights - log_weights.max())
        drawn = systematic(weights / weights.sum(), count, rng)
        return regularised(particles.particles[members][drawn], _KERNEL, rng)
