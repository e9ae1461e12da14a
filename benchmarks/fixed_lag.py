"""Smoothing online: what an update costs after a drive of so many, a lag of 100 poses; GTSAM's own smoother beside it.

The incremental smoother, which keeps the whole drive, is timed to 10,000 poses.

An update is a pose with its odometry and its measurement, a Gaussian; none is an outlier and odometry has no robust
loss, so that both minimise the same. skyfix relinearises every pose and gives all 100 with their covariances; GTSAM's
incremental smoother relinearises those that have moved and is asked for the newest pose alone. Once more, skyfix gets
the measurements as whole likelihoods on cells. Drive and measurements are drawn by formula from a seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np

from benchmarks.runner import Candidate, Case
from benchmarks.smoother import patch_around
from fusion import (
    FixedLagSettings,
    FixedLagSmoother,
    GaussianMixture,
    IncrementalSettings,
    IncrementalSmoother,
    LagState,
    OdometryIncrement,
    se2,
)
from fusion.arrays import FloatArray
from fusion.graph.covariances import noises_of
from fusion.graph.measurements import Measurement

SIZES = (100, 1_000, 10_000, 100_000)
_MOST_KEPT = 10_000
LAG = 100
UPDATES = 20
"""That are timed together."""
SEED = 0
SETTINGS = FixedLagSettings(lag=LAG, outlier_probability=0.0, huber_width=np.inf)
_DELTA = np.array([2.0, 0.0, 0.02])
_ODOMETRY = np.diag([0.15, 0.1, 0.01]) ** 2
_MEASURED = np.diag([0.7, 0.7, np.deg2rad(2.0)]) ** 2
_START = np.diag([1.0, 1.0, 0.1]) ** 2


def truth_at(index: int) -> FloatArray:
    """Pose (3,) on a circle."""
    return se2.exp(se2.log(_DELTA) * (index % 10_000))


def update_at(index: int) -> tuple[OdometryIncrement, GaussianMixture]:
    """The odometry into a pose, from 1 on, and its measurement."""
    rng = np.random.default_rng([SEED, index])
    before, truth = truth_at(index - 1), truth_at(index)
    delta = se2.between(before, truth) + rng.multivariate_normal(np.zeros(3), _ODOMETRY, method="cholesky")
    mean = truth + rng.multivariate_normal(np.zeros(3), _MEASURED, method="cholesky")
    return OdometryIncrement(index, delta, _ODOMETRY), GaussianMixture(np.ones(1), mean[None], _MEASURED[None])


@dataclass(slots=True)
class SkyfixRun:
    """A smoother after any number of updates; histories are made once, each from the one before.

    Parameters
    ----------
    measurement : callable
        From a Gaussian to what the smoother is given.
    """

    measurement: Callable[[GaussianMixture], Measurement]
    states: dict[int, LagState] = field(default_factory=dict)

    def after(self, size: int) -> FixedLagSmoother:
        """A smoother that has had `size` updates."""
        known = max((one for one in self.states if one <= size), default=0)
        smoother = FixedLagSmoother(0, np.zeros(3), _START, SETTINGS)
        if known:
            smoother.restore(self.states[known])
        for index in range(known + 1, size + 1):
            self.update(smoother, index)
        self.states[size] = smoother.state()
        return smoother

    def update(self, smoother: FixedLagSmoother, index: int) -> None:
        """One update."""
        increment, gaussian = update_at(index)
        smoother.add_odometry(increment)
        smoother.add_likelihood(index, self.measurement(gaussian))

    def prepare(self, size: int) -> Callable[[], FloatArray]:
        """The updates after a history, and the newest pose."""
        smoother = self.after(size)
        items = [update_at(index) for index in range(size + 1, size + UPDATES + 1)]
        given = [(increment, self.measurement(gaussian)) for increment, gaussian in items]

        def work() -> FloatArray:
            for increment, measurement in given:
                smoother.add_odometry(increment)
                smoother.add_likelihood(increment.stamp_ns, measurement)
            return smoother.estimate().pose

        return work


class GtsamRun:
    """GTSAM's incremental fixed-lag smoother, which goes on from wherever it is."""

    def __init__(self) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(LAG - 0.5)
        self.pose = np.zeros(3)
        self._size = 0
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        [noise] = noises_of(_START[None], np.zeros(1))
        graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise))
        values.insert(0, gtsam.Pose2())
        self._smoother.update(graph, values, {0: 0.0})

    def update(self, increment: OdometryIncrement, gaussian: GaussianMixture) -> FloatArray:
        """One update, and the newest pose."""
        key, graph, values = increment.stamp_ns, gtsam.NonlinearFactorGraph(), gtsam.Values()
        [moved] = noises_of(increment.covariance[None], increment.delta[None, 2])
        [seen] = noises_of(gaussian.covariances, gaussian.means[:, 2])
        graph.add(gtsam.BetweenFactorPose2(key - 1, key, gtsam.Pose2(*increment.delta), moved))
        graph.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(*gaussian.means[0]), seen))
        values.insert(key, gtsam.Pose2(*se2.compose(self.pose, increment.delta)))
        self._smoother.update(graph, values, {key: float(key)})
        found = self._smoother.calculateEstimatePose2(key)
        self.pose, self._size = np.array([found.x(), found.y(), found.theta()]), key
        return self.pose

    def prepare(self, size: int) -> Callable[[], FloatArray]:
        """The updates after a history of at least `size`, and the newest pose."""
        for index in range(self._size + 1, size + 1):
            self.update(*update_at(index))
        given = [update_at(index) for index in range(self._size + 1, self._size + UPDATES + 1)]

        def work() -> FloatArray:
            for increment, gaussian in given:
                self.update(increment, gaussian)
            return self.pose

        return work


class IncrementalRun:
    """The smoother of the whole drive, which goes on from wherever it is."""

    def __init__(self) -> None:
        settings = IncrementalSettings(outlier_probability=0.0, huber_width=np.inf)
        self._smoother = IncrementalSmoother(0, np.zeros(3), _START, settings)

    def update(self, increment: OdometryIncrement, gaussian: GaussianMixture) -> FloatArray:
        """One update, and the newest pose."""
        self._smoother.add_odometry(increment)
        self._smoother.add_likelihood(increment.stamp_ns, gaussian)
        return self._smoother.estimate().pose

    def prepare(self, size: int) -> Callable[[], FloatArray]:
        """The updates after a history of at least `size`, and the newest pose."""
        for index in range(len(self._smoother), size + 1):
            self.update(*update_at(index))
        first = len(self._smoother)
        given = [update_at(index) for index in range(first, first + UPDATES)]
        return lambda: [self.update(*one) for one in given][-1]


def cases(sizes: Sequence[int] = SIZES, whole: int = 1_000) -> Iterator[Case]:
    """One case a length of history, and one with whole likelihoods."""
    assert all(a < b for a, b in pairwise(sizes))
    gaussians, peer, cells, kept = SkyfixRun(lambda one: one), GtsamRun(), SkyfixRun(patch_around), IncrementalRun()
    for size in sizes:
        yield _case(f"{UPDATES} updates, lag {LAG}", size, gaussians, peer, kept if size <= _MOST_KEPT else None)
    yield _case(f"{UPDATES} updates, lag {LAG}, cells", whole, cells, GtsamRun(), None)


def _case(name: str, size: int, run: SkyfixRun, peer: GtsamRun, kept: IncrementalRun | None) -> Case:
    candidates = [
        Candidate("skyfix fixed lag, all poses with covariances", lambda: run.prepare(size)),
        Candidate("GTSAM incremental fixed lag, newest pose only", lambda: peer.prepare(size)),
    ]
    if kept is not None:
        candidates.append(Candidate("skyfix incremental, the whole drive kept", lambda: kept.prepare(size)))
    return Case(name, size, tuple(candidates))
