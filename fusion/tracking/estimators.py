"""The estimators that a tracker can be asked for by name, and how each is made again from what a file says of it."""

from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from fusion.errors import SkyfixError
from fusion.fixed_lag import FixedLagSettings
from fusion.graph_filter import FilterAndGraph, GraphFilter
from fusion.hypotheses import HypothesisSettings
from fusion.particle_filter import ParticleFilter, ParticleFilterSettings
from fusion.particles.kld_sampling import KldSampling
from fusion.prior import UniformPrior
from fusion.tracking.archive import Tree
from fusion.tracking.resumable import ResumableFilter

EstimatorName = Literal["filter", "graph", "both"]


def estimator(
    name: EstimatorName,
    prior: UniformPrior,
    particles: int,
    seed: int,
    filter_settings: ParticleFilterSettings | None,
    graph_settings: FixedLagSettings | None,
) -> ResumableFilter:
    """A particle filter, a graph, or both, at a prior."""
    if name not in ("filter", "graph", "both"):
        raise SkyfixError(f"estimator: expected filter, graph or both, got {name!r}")
    if name == "graph":
        return GraphFilter.from_prior(prior, graph_settings)
    particle_filter = ParticleFilter.from_prior(prior, particles, seed, filter_settings)
    return particle_filter if name == "filter" else FilterAndGraph(particle_filter, graph_settings)


def settings_of(pose_filter: ResumableFilter) -> Tree:
    """What is needed to make a filter like this one; None for a filter of the caller's own."""
    if isinstance(pose_filter, ParticleFilter):
        return asdict(pose_filter.settings)
    if isinstance(pose_filter, GraphFilter):
        return {"graph": asdict(pose_filter.settings), "hypotheses": asdict(pose_filter.hypothesis_settings)}
    if isinstance(pose_filter, FilterAndGraph):
        return {"graph": asdict(pose_filter.settings), "filter": asdict(pose_filter.filter.settings)}
    return None


def estimator_like(name: str, settings: Any) -> ResumableFilter:
    """A filter of a type and with settings that were written, its state to be put in."""
    nowhere = UniformPrior(np.zeros(3), 1.0, 1.0)
    if name == GraphFilter.__name__:
        graph, hypotheses = FixedLagSettings(**settings["graph"]), HypothesisSettings(**settings["hypotheses"])
        start = GraphFilter.from_prior(nowhere).estimate(0, 1).modes
        assert start is not None  # asked for
        return GraphFilter(start, graph, hypotheses)
    if name == FilterAndGraph.__name__:
        inner = ParticleFilter(np.zeros((1, 3)), 0, _filter_settings(settings["filter"]))
        return FilterAndGraph(inner, FixedLagSettings(**settings["graph"]))
    return ParticleFilter(np.zeros((1, 3)), 0, _filter_settings(settings))


def _filter_settings(tree: Any) -> ParticleFilterSettings:
    adaptive = tree["adaptive"]
    return ParticleFilterSettings(**{**tree, "adaptive": None if adaptive is None else KldSampling(**adaptive)})
