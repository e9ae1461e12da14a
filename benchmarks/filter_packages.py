"""The same filter step by filters from PyPI, where they are installed: `particles` and `stonesoup`.

Both are given the numpy lookup, which is faster than scipy's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.filter_model import SEED, Estimated, Lookup, mixture, moments, moved
from benchmarks.runner import Candidate
from fusion.arrays import FloatArray

PACKAGES = ("particles", "stonesoup")


def missing_packages() -> list[str]:
    """Names of the packages that are not installed and so will not be measured."""
    return [name for name in PACKAGES if find_spec(name) is None]


def package_candidates(particles: FloatArray, lookup: Lookup) -> Iterator[Candidate]:
    """One candidate for each package that is installed."""
    makers = {"particles": particles_filter, "stonesoup": stonesoup_filter}
    for name in PACKAGES:
        if find_spec(name) is not None:
            yield Candidate(f"{name} (PyPI)", partial(makers[name], particles, lookup))


def particles_filter(cloud: FloatArray, lookup: Lookup) -> Callable[[], Estimated]:
    """A step of `particles.SMC`, resampling every time."""
    from particles import SMC, FeynmanKac

    rng = np.random.default_rng(SEED)

    methods = {  # names are the package's
        "M0": lambda self, N: cloud.copy(),
        "M": lambda self, t, xp: moved(xp, rng),
        "logG": lambda self, t, xp, x: np.log(mixture(lookup, x)) if t else np.zeros(len(x)),
    }
    drive = type("Drive", (FeynmanKac,), methods)(T=100)
    smc = SMC(fk=drive, N=len(cloud), resampling="systematic", ESSrmin=2.0)
    next(smc)

    def step() -> Estimated:
        next(smc)
        return moments(smc.X, smc.W)

    return step


def stonesoup_filter(cloud: FloatArray, lookup: Lookup) -> Callable[[], Estimated]:
    """Predict, update and resample by Stone Soup's predictor, updater and resampler."""
    from stonesoup.models.measurement import MeasurementModel
    from stonesoup.models.transition import TransitionModel
    from stonesoup.predictor.particle import ParticlePredictor
    from stonesoup.resampler.particle import SystematicResampler
    from stonesoup.types.array import StateVector, StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import ParticleState
    from stonesoup.updater.particle import ParticleUpdater

    rng, now = np.random.default_rng(SEED), datetime(2020, 1, 1)

    def poses_of(state: Any) -> FloatArray:
        return np.ascontiguousarray(np.asarray(state.state_vector, dtype=np.float64).T)

    class Motion(TransitionModel):
        ndim_state = 3

        def function(self, state: Any, noise: bool = True, **kwargs: Any) -> Any:
            return StateVectors(moved(poses_of(state), rng).T)

        def rvs(self, *args: Any, **kwargs: Any) -> Any:
            return StateVector(np.zeros(3))

        def pdf(self, *args: Any, **kwargs: Any) -> float:
            return 1.0

    class Volume(MeasurementModel):
        ndim_state, ndim_meas, mapping = 3, 3, (0, 1, 2)

        def function(self, state: Any, noise: bool = False, **kwargs: Any) -> Any:
            return state.state_vector

        def rvs(self, *args: Any, **kwargs: Any) -> Any:
            return StateVector(np.zeros(3))

        def pdf(self, first: Any, second: Any, **kwargs: Any) -> FloatArray:
            return mixture(lookup, poses_of(second))

        def logpdf(self, first: Any, second: Any, **kwargs: Any) -> FloatArray:
            return np.log(self.pdf(first, second))

    prior = ParticleState(StateVectors(cloud.T), timestamp=now, weight=np.full(len(cloud), 1.0 / len(cloud)))
    predictor = ParticlePredictor(Motion())
    updater = ParticleUpdater(Volume(), SystematicResampler())
    seen = Detection(StateVector(np.zeros(3)), timestamp=now + timedelta(seconds=1), measurement_model=Volume())

    def step() -> Estimated:
        posterior = updater.update(SingleHypothesis(predictor.predict(prior, timestamp=seen.timestamp), seen))
        return moments(poses_of(posterior), np.asarray(posterior.weight, dtype=np.float64))

    return step
