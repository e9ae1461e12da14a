"""Looking for the vehicle on the whole map: the posterior of all measurements since it was given up, until one wins.

As at a start, the cloud is made anew with each of a few measurements from all of them (`start_cloud`); after these it
begins once more, with the posterior so far as one half of what is known. The scans are matched with the whole map,
and looked at closely about the places where the cloud is, so that far-apart places are weighed against each other by
one density.
"""

from __future__ import annotations

import numpy as np

from fusion.arrays import Float32Array
from fusion.estimate import Estimate
from fusion.odometry import OdometryIncrement
from fusion.particle_filter import ParticleFilter
from fusion.two_level import TwoLevelLikelihood
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion
from learned.whole_map import WholeMapSearch, search_over
from sequences.anywhere import Candidates, GivenUp, Predicted, map_box
from sequences.start_cloud import MOST_MEASUREMENTS, StartCloud
from sequences.track_settings import TrackSettings

_LEAST_PARTICLES = 20_000  # while they are all over the map
_NEAR_SIGMAS = 3.0
_NEAR = np.array([[2.0, 2.0, np.radians(5.0)], [10.0, 10.0, np.radians(10.0)]])
"""Least and most that counts as near the filter's pose: metres, metres, radians."""


class AnywhereSearch:
    """A search of the whole map, or one that could begin.

    Parameters
    ----------
    matcher
        Asked for its whole-map search when that is first wanted.
    map_raster, ground_z
        The map; the ground's height in the scan frame, metres.
    settings
        Particles, outliers.
    rng
        Source of all randomness.
    """

    def __init__(
        self,
        matcher: MapMatcher,
        map_raster: MapRaster,
        ground_z: float,
        settings: TrackSettings,
        rng: np.random.Generator,
    ) -> None:
        self._matcher, self._map, self._ground_z = matcher, map_raster, ground_z
        self._settings, self._rng = settings, rng
        self._filter_settings = settings.filter
        self._whole_map: WholeMapSearch | None = None
        self._cloud: StartCloud | None = None

    @property
    def is_running(self) -> bool:
        """Whether a measurement has been taken in since the vehicle was given up."""
        return self._cloud is not None

    def prepare(self) -> None:
        """Have the map ready, which may take seconds the first time.

        Raises
        ------
        SkyfixError
            If the matcher cannot search a whole map, or not this one.
        """
        self._prepared()

    def region(self) -> SearchRegion:
        """The square about the map, any heading."""
        box = map_box(self._map.grid)
        return SearchRegion(box.mean, box.half_extent_m, box.half_heading_rad)

    def contrast(self, points: Float32Array, estimate: Estimate) -> float:
        """By how many nats a scan fits elsewhere on the map better than where the filter has the vehicle.

        What is near is not more than the filter leaves open: in 10 m about a wrong place, something fits.
        """
        reach = np.clip(_NEAR_SIGMAS * np.sqrt(np.diag(estimate.covariance)), *_NEAR)
        return self._prepared().contrast(points, self._ground_z, estimate.pose, reach)

    def match(self, points: Float32Array, particles: ParticleFilter | None) -> TwoLevelLikelihood:
        """Likelihood of all poses on the map, looked at closely about the particles too."""
        near = None if particles is None else Candidates.of(particles).likely()
        return self._prepared().match(points, self._ground_z, near)

    def update(
        self,
        predicted: Predicted | None,
        likelihood: TwoLevelLikelihood,
        temperature: float,
        motion: OdometryIncrement | None,
    ) -> ParticleFilter:
        """The filter after one more measurement.

        Parameters
        ----------
        predicted
            The filter before this measurement; None at the start of a drive.
        likelihood, temperature
            The measurement.
        motion
            Odometry since the one before; not looked at for the first.
        """
        if self._cloud is None or (predicted is not None and len(self._cloud) >= MOST_MEASUREMENTS):
            grid, settings = self._map.grid, self._settings
            prior = map_box(grid) if predicted is None else GivenUp.by(predicted, grid)
            count = max(settings.particles, _LEAST_PARTICLES)
            self._cloud = StartCloud(prior, count, settings.filter.outlier_probability, self._rng)
            motion = None
        cloud, log_weights = self._cloud.add(likelihood.tempered(temperature), motion, likelihood)
        return ParticleFilter(cloud, self._rng, self._filter_settings, log_weights)

    def share(self, particles: ParticleFilter) -> float:
        """Of the likeliest place in the posterior."""
        return Candidates.of(particles).share

    def estimate(self, particles: ParticleFilter, stamp_ns: int) -> Estimate:
        """That of the likeliest place; its lost score is the share of the others."""
        return Candidates.of(particles).likeliest(particles.estimate(stamp_ns))

    def settle(self, particles: ParticleFilter) -> ParticleFilter:
        """End the search: a filter of the likeliest place alone."""
        self._cloud = None
        cloud = Candidates.of(particles).heaviest_alone(particles, self._settings.particles, self._rng)
        return ParticleFilter(cloud, self._rng, self._filter_settings)

    def _prepared(self) -> WholeMapSearch:
        if self._whole_map is None:
            self._whole_map = search_over(self._matcher, self._map)
        return self._whole_map
