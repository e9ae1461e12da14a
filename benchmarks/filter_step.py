"""One step of a particle filter on a likelihood volume beside its peers, and its dearest parts alone.

A step moves N particles by a noisy increment, weighs them by a volume, resamples and gives mean and covariance. All
implementations have the same motion, the same measurement model (trilinear, with outliers) and systematic resampling
at every step; see `filter_peers` and `filter_packages`. 'floor' is no filter: it reads the eight cells around every
particle at random and adds them up.

While tracking the cloud lies about the higher peak, and one step is timed. Spread out it lies all over the crop, and a
measurement that says little leaves it there; the time is that of one of several steps in a row, so that it contains
what a filter does now and then, such as putting its particles in order.

Everything here is made up by formula: a cloud, and a volume with two peaks over clutter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from filterpy.monte_carlo import systematic_resample

from benchmarks.filter_model import INCREMENT, SEED, Estimated, NumpyLookup, ScipyLookup, cloud, example_volume
from benchmarks.filter_packages import package_candidates
from benchmarks.filter_peers import FilterpyFilter, NumpyFilter, TorchFilter
from benchmarks.gather_floor import gather_floor
from benchmarks.runner import Candidate, Case
from fusion import LikelihoodVolume, MapGrid, OdometryIncrement, ParticleFilter, ParticleFilterSettings
from fusion.arrays import FloatArray
from fusion.resampling import systematic

SIZES = (1_000, 10_000, 100_000, 1_000_000)
MAP_SIDES = (64, 128, 256, 512)
MAP_PARTICLES = 100_000
SAME_WORK = ParticleFilterSettings(ess_fraction=1.0, regularisation=0.0)
"""Resample at every step and add no kernel noise, as the peers do."""
WITH_KERNEL_NOISE = ParticleFilterSettings(ess_fraction=1.0)
SPREAD_STEPS = 4
_STANDSTILL = OdometryIncrement(0, np.zeros(3), np.zeros((3, 3)))


def skyfix_step(particles: ParticleFilter, volume: LikelihoodVolume) -> Estimated:
    """Mean (3,) and covariance (3, 3) after one step."""
    particles.predict(INCREMENT)
    particles.update(volume)
    estimate = particles.estimate(INCREMENT.stamp_ns)
    return estimate.pose, estimate.covariance


def _skyfix(particles: FloatArray, volume: LikelihoodVolume, settings: ParticleFilterSettings) -> Candidate:
    faint = _faint(volume)

    def prepare() -> Callable[[], Estimated]:
        started = ParticleFilter(particles, SEED, settings)
        started.predict(_STANDSTILL)
        started.update(faint)  # resamples, and what that puts off until the next pass is in the time
        started.estimate(0)
        return lambda: skyfix_step(started, volume)

    name = "skyfix" if settings.regularisation == 0.0 else "skyfix with kernel noise (its default)"
    return Candidate(name if settings.threads == 1 else f"{name}, {settings.threads} threads", prepare)


def _flat(volume: LikelihoodVolume) -> LikelihoodVolume:
    """The volume with so little to say that a cloud all over it stays there."""
    return volume.tempered(60.0)


def _faint(volume: LikelihoodVolume) -> LikelihoodVolume:
    """Four cells over the same crop that say next to nothing: the cloud is resampled and stays where it is."""
    grid = volume.grid
    quarters = MapGrid(2, 2, 0.5 * grid.width_m, grid.x0, grid.y0)
    return LikelihoodVolume.from_scores(np.array([[[0.0], [0.01]], [[0.01], [0.0]]]), quarters)


def _floor(particles: FloatArray, volume: LikelihoodVolume) -> Candidate:
    return Candidate("floor: the gather alone", lambda: gather_floor(particles, volume))


def _steps(particles: FloatArray, volume: LikelihoodVolume) -> tuple[Candidate, ...]:
    numpy_lookup, scipy_lookup = NumpyLookup.of(volume), ScipyLookup.of(volume)
    return (
        _skyfix(particles, volume, SAME_WORK),
        _skyfix(particles, volume, WITH_KERNEL_NOISE),
        _skyfix(particles, volume, replace(SAME_WORK, threads=2)),
        _floor(particles, volume),
        Candidate("vectorised numpy", lambda: NumpyFilter.start(particles, numpy_lookup).step),
        Candidate("torch grid_sample", lambda: TorchFilter.start(particles, volume).step),
        Candidate("filterpy parts + scipy map_coordinates", lambda: FilterpyFilter.start(particles, scipy_lookup).step),
        *package_candidates(particles, numpy_lookup),
    )


def cases(
    sizes: Sequence[int] = SIZES, volume: LikelihoodVolume | None = None, map_sides: Sequence[int] = MAP_SIDES
) -> Iterator[Case]:
    """Steps while tracking and all over the crop at each size, steps on maps of each side, lookup and resampling."""
    volume = volume or example_volume()
    for size in sizes:
        yield Case("step, tracking", size, _steps(cloud(volume, size, spread=False), volume))
        yield Case("step, spread", size, _steps(cloud(volume, size, spread=True), _flat(volume)), SPREAD_STEPS)
    for side in map_sides:
        wide = _flat(example_volume(side, 64))
        particles = cloud(wide, min(MAP_PARTICLES, max(sizes)), spread=True)
        candidates = (_skyfix(particles, wide, SAME_WORK), _floor(particles, wide))
        yield Case(f"step, spread, map of {side} x {side} x 64", len(particles), candidates, SPREAD_STEPS)
    for size in sizes:
        yield _lookup_case(cloud(volume, size, spread=True), volume)
    for size in sizes:
        yield _resampling_case(size)


def _lookup_case(poses: FloatArray, volume: LikelihoodVolume) -> Case:
    lookup = ScipyLookup.of(volume)
    ours = Candidate("skyfix log_density (numpy)", lambda: lambda: volume.log_density(poses))
    return Case("lookup, spread", len(poses), (ours, Candidate("scipy map_coordinates", lambda: lambda: lookup(poses))))


def _resampling_case(count: int) -> Case:
    weights = np.random.default_rng(SEED).dirichlet(np.ones(count))
    rng = np.random.default_rng(SEED)
    ours = Candidate("skyfix systematic (numpy)", lambda: lambda: systematic(weights, count, rng))
    peer = Candidate("filterpy systematic_resample", lambda: lambda: systematic_resample(weights))
    return Case("systematic resampling", count, (ours, peer))
