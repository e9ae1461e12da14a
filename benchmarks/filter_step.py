"""One step of a particle filter on a likelihood volume, and its two dearest parts alone: lookup and resampling.

A step moves N particles by a noisy increment, weights them by a volume of 96 x 96 cells and 360 headings, resamples
and gives mean and covariance. The peer is put together as filterpy's documentation and its author's book show it:
weights multiplied in numpy, `filterpy.monte_carlo.systematic_resample`; filterpy has no maps, so
`scipy.ndimage.map_coordinates` looks the volume up. It has the same measurement model, outliers included, and the
same noise for the same seed, so that both give the same estimate. Only skyfix keeps log weights and a lost score.

Everything here is made up by formula: a cloud, and a volume with two peaks over clutter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.monte_carlo import systematic_resample
from scipy.ndimage import map_coordinates

from benchmarks.runner import Candidate, Case
from fusion import LikelihoodVolume, MapGrid, OdometryIncrement, ParticleFilter, ParticleFilterSettings, se2
from fusion.arrays import Float32Array, FloatArray
from fusion.likelihood import log_uniform_density
from fusion.regularisation import matrix_root
from fusion.resampling import systematic

SIZES = (1_000, 10_000, 100_000)
SEED = 0
INCREMENT = OdometryIncrement(1, np.array([1.0, 0.0, 0.02]), np.diag([0.05, 0.03, 0.01]) ** 2)
SAME_WORK = ParticleFilterSettings(ess_fraction=1.0, regularisation=0.0)
"""Resample at every step and add no kernel noise, as the peer does."""
WITH_KERNEL_NOISE = ParticleFilterSettings(ess_fraction=1.0)

Estimated = tuple[FloatArray, FloatArray]


def example_volume(cells: int = 96, bins: int = 360) -> LikelihoodVolume:
    """Two peaks of 1 m and 3 degrees, one of them twice as high, over clutter; cells of half a metre."""
    grid = MapGrid(cells, cells, 0.5, -0.25 * cells, -0.25 * cells)
    x, y = grid.centres()
    yaw = se2.TWO_PI * np.arange(bins) / bins

    def peak(x0: float, y0: float, yaw0: float) -> FloatArray:
        squared = (x[None, :, None] - x0) ** 2 + (y[:, None, None] - y0) ** 2
        return -0.5 * squared + (np.cos(yaw - yaw0) - 1.0) / np.deg2rad(3.0) ** 2

    quarter = 0.125 * cells
    scores = np.logaddexp(peak(0.0, 0.0, 0.1), peak(quarter, -quarter, 0.1 + np.pi) - np.log(2.0))
    return LikelihoodVolume.from_scores(np.logaddexp(scores, -12.0), grid)


def cloud(volume: LikelihoodVolume, count: int, spread: bool) -> FloatArray:
    """Particles (count, 3): all over the crop, or around the higher peak as in tracking."""
    rng = np.random.default_rng(SEED)
    if spread:
        half = np.array([0.5 * volume.grid.width_m, 0.5 * volume.grid.height_m, np.pi])
        return rng.uniform(-half, half, (count, 3))
    return np.array([-1.0, 0.0, 0.08]) + rng.standard_normal((count, 3)) * [1.0, 1.0, 0.05]


def skyfix_step(particles: ParticleFilter, volume: LikelihoodVolume) -> Estimated:
    """Mean (3,) and covariance (3, 3) after one step."""
    particles.predict(INCREMENT)
    particles.update(volume)
    estimate = particles.estimate(INCREMENT.stamp_ns)
    return estimate.pose, estimate.covariance


@dataclass(frozen=True, slots=True, eq=False)
class ScipyLookup:
    """Trilinear lookup in a volume by map_coordinates, its headings padded once so that they wrap."""

    padded: Float32Array
    volume: LikelihoodVolume

    @classmethod
    def of(cls, volume: LikelihoodVolume) -> ScipyLookup:
        """Pad the volume by its first heading."""
        return cls(np.concatenate([volume.log_prob, volume.log_prob[:, :, :1]], axis=2), volume)

    def __call__(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) at poses (N, 3); the floor outside the crop."""
        grid = self.volume.grid
        row, col = (grid.pixel_from_xy(poses[:, :2]) - 0.5).T
        turns = poses[:, 2] / se2.TWO_PI
        heading = (turns - np.floor(turns)) * (self.padded.shape[2] - 1)
        values = map_coordinates(self.padded, [row, col, heading], output=np.float64, order=1, mode="nearest")
        return np.where(grid.contains(poses[:, :2]), values, self.volume.floor)


@dataclass(slots=True, eq=False)
class FilterpyFilter:
    """A particle filter from filterpy's parts: particles and weights in arrays, its resampling between them."""

    particles: FloatArray
    weights: FloatArray
    lookup: ScipyLookup
    rng: np.random.Generator

    def step(self) -> Estimated:
        """Mean (3,) and covariance (3, 3) after predict, update, resample."""
        noise = self.rng.standard_normal(self.particles.shape) @ matrix_root(INCREMENT.covariance).T
        forward, left, turn = (INCREMENT.delta + noise).T
        cos, sin = np.cos(self.particles[:, 2]), np.sin(self.particles[:, 2])
        self.particles[:, 0] += cos * forward - sin * left
        self.particles[:, 1] += sin * forward + cos * left
        self.particles[:, 2] = (self.particles[:, 2] + turn + np.pi) % se2.TWO_PI - np.pi

        outlier = SAME_WORK.outlier_probability
        uniform = np.exp(log_uniform_density(self.lookup.volume.grid))
        self.weights *= (1.0 - outlier) * np.exp(self.lookup(self.particles)) + outlier * uniform
        self.weights += 1e-300
        self.weights /= self.weights.sum()

        indexes = systematic_resample(self.weights)
        self.particles[:] = self.particles[indexes]
        self.weights.fill(1.0 / len(self.weights))

        mean = np.average(self.particles, weights=self.weights, axis=0)
        mean[2] = np.arctan2(self.weights @ np.sin(self.particles[:, 2]), self.weights @ np.cos(self.particles[:, 2]))
        residual = self.particles - mean
        residual[:, 2] = (residual[:, 2] + np.pi) % se2.TWO_PI - np.pi
        return mean, (self.weights[:, None] * residual).T @ residual


def filterpy_filter(particles: FloatArray, lookup: ScipyLookup) -> FilterpyFilter:
    """The peer at its start, on a copy of the particles (N, 3)."""
    count = len(particles)
    return FilterpyFilter(particles.copy(), np.full(count, 1.0 / count), lookup, np.random.default_rng(SEED))


def _steps(particles: FloatArray, volume: LikelihoodVolume, lookup: ScipyLookup) -> tuple[Candidate, ...]:
    def skyfix(settings: ParticleFilterSettings) -> Callable[[], Callable[[], Estimated]]:
        def prepare() -> Callable[[], Estimated]:
            started = ParticleFilter(particles, SEED, settings)
            return lambda: skyfix_step(started, volume)

        return prepare

    return (
        Candidate("skyfix", skyfix(SAME_WORK)),
        Candidate("skyfix with kernel noise (its default)", skyfix(WITH_KERNEL_NOISE)),
        Candidate("filterpy parts + scipy map_coordinates", lambda: filterpy_filter(particles, lookup).step),
    )


def cases(sizes: Sequence[int] = SIZES, volume: LikelihoodVolume | None = None) -> Iterator[Case]:
    """Steps while tracking and with a cloud all over the crop, then lookup and resampling alone, at each size."""
    volume = volume or example_volume()
    lookup = ScipyLookup.of(volume)
    for size in sizes:
        for name, spread in (("step, tracking", False), ("step, spread", True)):
            yield Case(name, size, _steps(cloud(volume, size, spread), volume, lookup))
    for size in sizes:
        yield _lookup_case(cloud(volume, size, spread=True), volume, lookup)
    for size in sizes:
        yield _resampling_case(size)


def _lookup_case(poses: FloatArray, volume: LikelihoodVolume, lookup: ScipyLookup) -> Case:
    ours = Candidate("skyfix", lambda: lambda: volume.log_density(poses))
    return Case("lookup, spread", len(poses), (ours, Candidate("scipy map_coordinates", lambda: lambda: lookup(poses))))


def _resampling_case(count: int) -> Case:
    weights = np.random.default_rng(SEED).dirichlet(np.ones(count))
    rng = np.random.default_rng(SEED)
    ours = Candidate("skyfix", lambda: lambda: systematic(weights, count, rng))
    peer = Candidate("filterpy systematic_resample", lambda: lambda: systematic_resample(weights))
    return Case("systematic resampling", count, (ours, peer))
