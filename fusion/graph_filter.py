"""The factor graph in the place of a filter: predict, update, estimate, and a state to go back to.

`GraphFilter` is a `HypothesisSmoother` whose poses are those of the measurements, the odometry in between composed. It
needs a start that is known to some metres, or several such; it never finds a place that it has lost.

`FilterAndGraph` has a particle filter find the place, and find it again. Once the filter's clusters are compact, graphs
begin, one in each of the heaviest; from then on they answer for as long as they agree with the filter. While they do
not, or the filter holds itself for lost, the filter answers; after a few such measurements in a row the graph
begins anew from the filter's clusters. What a cluster knows of the measurements before counts once: it is the graph's
prior.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.fixed_lag import FixedLagSettings
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.basins import distance
from fusion.hypotheses import HypothesisSettings, HypothesisSmoother, HypothesisState
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement, accumulate
from fusion.particle_filter import ParticleFilter, ParticleFilterState
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior

__all__ = ["FilterAndGraph", "FilterAndGraphState", "GraphFilter", "GraphFilterState"]

_MOST_CLUSTERS = 4
_LEAST_WEIGHT = 0.95  # of these clusters together
_COMPACT = np.array([5.0, 5.0, 0.35])  # standard deviations of a cluster in which a graph can begin: metres, radians
_AGREEMENT = 4.0  # standard deviations of the difference
_PATIENCE = 3  # measurements
_LOST = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class GraphFilterState:
    """All that a graph filter knows.

    Parameters
    ----------
    smoother : HypothesisState
        At the last measurement.
    delta, covariance : (3,), (3, 3) float64
        Motion since then.
    """

    smoother: HypothesisState
    delta: FloatArray
    covariance: FloatArray


class GraphFilter:
    """Fixed-lag smoothers as a `ResumableFilter`.

    Parameters
    ----------
    starts : GaussianMixture
        First poses.
    settings : FixedLagSettings
        How each smoother behaves.
    hypothesis_settings : HypothesisSettings
        When hypotheses end.
    """

    def __init__(
        self,
        starts: GaussianMixture,
        settings: FixedLagSettings | None = None,
        hypothesis_settings: HypothesisSettings | None = None,
    ) -> None:
        self.settings = settings or FixedLagSettings()
        self.hypothesis_settings = hypothesis_settings or HypothesisSettings()
        self._smoother = HypothesisSmoother(0, starts, self.hypothesis_settings, self.settings)
        self._delta, self._covariance = np.zeros(3), np.zeros((3, 3))

    @classmethod
    def from_prior(cls, prior: UniformPrior, settings: FixedLagSettings | None = None) -> Self:
        """A filter that begins with the mean and covariance of a prior's box."""
        return cls(GaussianMixture(np.ones(1), prior.mean[None], prior.covariance[None]), settings)

    def predict(self, increment: OdometryIncrement) -> None:
        """Move by an odometry increment; a pose comes with the next measurement."""
        steps = [(self._delta, self._covariance), (increment.delta, increment.covariance)]
        total = accumulate([OdometryIncrement(k, delta, covariance) for k, (delta, covariance) in enumerate(steps)])
        self._delta, self._covariance = total.delta, total.covariance

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Add a pose with a likelihood and smooth.

        Raises
        ------
        SkyfixError
            When the likelihood gives NaN or an infinity; the filter is then as it was before.
        """
        before = self.state()
        try:
            self._move()
            stamp = self._smoother.span_ns[1]
            report = self._smoother.add_likelihood(stamp, likelihood.tempered(temperature))
        except Exception:
            self.restore(before)
            raise
        return UpdateReport(report.log_evidence, effective_sample_size=self._smoother.estimate().effective_sample_size)

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """Mean and covariance; hypotheses when `max_modes` is not 0. A graph has no model of being lost."""
        before = self.state()
        self._move()
        try:
            return replace(self._smoother.estimate(max_modes), stamp_ns=stamp_ns)
        finally:
            self.restore(before)

    def state(self) -> GraphFilterState:
        """All that the filter knows."""
        return GraphFilterState(self._smoother.state(), self._delta, self._covariance)

    def restore(self, state: GraphFilterState) -> None:
        """Go back to a state."""
        self._smoother.restore(state.smoother)
        self._delta, self._covariance = state.delta, state.covariance

    def reseed(self, key: int) -> None:
        """There is nothing random."""

    def _move(self) -> None:
        """Make the motion so far a pose; poses are numbered, whatever their stamps."""
        self._smoother.add_odometry(OdometryIncrement(self._smoother.span_ns[1] + 1, self._delta, self._covariance))
        self._delta, self._covariance = np.zeros(3), np.zeros((3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class FilterAndGraphState:
    """All that both know.

    Parameters
    ----------
    particles : ParticleFilterState
        The filter's.
    graph : GraphFilterState or None
        None while there is no graph.
    disagreements : int
        Measurements in a row after which the two disagreed.
    """

    particles: ParticleFilterState
    graph: GraphFilterState | None
    disagreements: int


class FilterAndGraph:
    """A particle filter that finds the place and a graph that tells where exactly, as a `ResumableFilter`.

    Parameters
    ----------
    particle_filter : ParticleFilter
        At its prior.
    settings : FixedLagSettings
        How each smoother of the graph behaves.
    """

    def __init__(self, particle_filter: ParticleFilter, settings: FixedLagSettings | None = None) -> None:
        self.filter = particle_filter
        self.settings = settings or FixedLagSettings()
        self._graph: GraphFilter | None = None
        self._disagreements = 0

    @property
    def graph_answers(self) -> bool:
        """Whether estimates are the graph's at present."""
        return self._graph is not None and self._disagreements == 0

    def predict(self, increment: OdometryIncrement) -> None:
        """Move both."""
        self.filter.predict(increment)
        if self._graph is not None:
            self._graph.predict(increment)

    def update(self, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        """Weigh both, and see whether they agree; the report is the filter's.

        Raises
        ------
        SkyfixError
            When the likelihood gives NaN or an infinity; both are then as they were.
        """
        report = self.filter.update(likelihood, temperature)
        if not report.used:
            return report
        if self._graph is not None:
            try:
                self._graph.update(likelihood, temperature)
            except SkyfixError:  # one that the filter could use: the graph begins anew
                self._graph = None
        if self._graph is not None:
            mine, theirs = self._graph.estimate(0), self.filter.estimate(0)
            far = distance((mine.pose, mine.covariance), (theirs.pose, theirs.covariance)) > _AGREEMENT
            self._disagreements = self._disagreements + 1 if far or report.lost_score > _LOST else 0
        if self._graph is None or self._disagreements >= _PATIENCE:
            self._begin()
        return report

    def estimate(self, stamp_ns: int, max_modes: int = 0) -> Estimate:
        """The graph's answer while it agrees with the filter, the filter's otherwise; being lost is the filter's."""
        found = self.filter.estimate(stamp_ns, max_modes)
        if self._graph is None or not self.graph_answers:
            return found
        graph = self._graph.estimate(stamp_ns, max_modes)
        return replace(found, pose=graph.pose, covariance=graph.covariance, modes=graph.modes)

    def state(self) -> FilterAndGraphState:
        """All that both know."""
        graph = None if self._graph is None else self._graph.state()
        return FilterAndGraphState(self.filter.state(), graph, self._disagreements)

    def restore(self, state: FilterAndGraphState) -> None:
        """Go back to a state."""
        self.filter.restore(state.particles)
        self._disagreements, self._graph = state.disagreements, None
        if state.graph is not None:
            self._graph = GraphFilter.from_prior(_ANYWHERE, self.settings)
            self._graph.restore(state.graph)

    def reseed(self, key: int) -> None:
        """Make the filter's further randomness a function of `key`."""
        self.filter.reseed(key)

    def _begin(self) -> None:
        """A graph in each of the filter's heaviest clusters, if they are compact and nearly all there is."""
        self._graph, self._disagreements = None, 0
        modes = self.filter.estimate(0, _MOST_CLUSTERS).modes
        if modes is None or modes.weights.sum() < _LEAST_WEIGHT or self.filter.lost_score > _LOST:
            return
        sigmas = np.sqrt(np.diagonal(modes.covariances, axis1=1, axis2=2))
        if (sigmas <= _COMPACT).all():
            self._graph = GraphFilter(modes, self.settings)


_ANYWHERE = UniformPrior(np.zeros(3), 1.0, 1.0)
"""For a graph whose state is about to be put in."""
