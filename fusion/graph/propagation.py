"""Expectation propagation: whole likelihoods on a graph of poses, each as the Gaussian that has its effect.

Round by round, every measurement's factor is divided out of its pose's marginal; what is left, the cavity, is what all
else says of the pose; the likelihood times the cavity has a mass, a mean and a covariance; and the new factor is the
Gaussian that, times the cavity, has the same. Broad, flat, skewed and many-peaked likelihoods count for what they are
under that window, and a likelihood that is somewhere else altogether counts for nothing: it is an outlier. Factors that
a round would hardly change are left as they are, see `fusion.graph.looks`.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001; the evidence is its equation 20.
"""

from dataclasses import dataclass

import numpy as np

from fusion.arrays import FloatArray, IntArray
from fusion.graph.looks import Looks
from fusion.graph.measurements import Measurements
from fusion.graph.sites import Sites
from fusion.graph.solution import Solution, SteppedGraph

_POSITION_TOLERANCE_M = 2e-3
_HEADING_TOLERANCE_RAD = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Propagated:
    """What a run of expectation propagation ended with.

    Parameters
    ----------
    solution : Solution
        Poses and marginals.
    sites : Sites
        Factors of the measurements.
    chosen : (M,) int64
        See `Measurements.windowed`.
    log_evidence : float
        ln density of all measurements, up to a constant of the graph.
    rounds : int
        Number of rounds.
    converged : bool
        Whether the last round changed nothing to speak of.
    """

    solution: Solution
    sites: Sites
    chosen: IntArray
    log_evidence: float
    rounds: int
    converged: bool


def propagate(
    graph: SteppedGraph,
    measurements: Measurements,
    poses: FloatArray,
    covariances: FloatArray,
    max_rounds: int,
) -> Propagated:
    """Run to convergence from poses (N, 3) whose errors have covariances (N, 3, 3)."""
    nodes = measurements.nodes
    centres, windows = poses[nodes], covariances[nodes]
    looks = Looks(measurements, centres)
    solution = graph.at(poses, nodes, looks.sites)
    rounds, converged = 0, False
    while not converged and rounds < max_rounds:
        looks.renew(centres, windows)
        before = solution.poses
        solution = graph.step(solution, nodes, looks.sites)
        moved = np.abs(solution.poses - before).max(axis=0)
        rounds += 1
        settled = moved[:2].max() < _POSITION_TOLERANCE_M and moved[2] < _HEADING_TOLERANCE_RAD
        converged = bool(settled and rounds > 1)
        if not converged:
            assert solution.covariances is not None  # asked for
            centres, windows = looks.sites.cavities(solution.poses[nodes], solution.covariances[nodes])
    if not converged:
        looks.look(centres, windows)
    log_evidence = looks.log_evidence() - solution.cost - solution.half_log_det
    return Propagated(solution, looks.sites, looks.chosen, log_evidence, rounds, converged)
