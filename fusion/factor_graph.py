"""Offline smoothing of a whole drive: a chain of poses with whole likelihoods as factors; with loops, a GTSAM graph.

Between neighbouring nodes stands an odometry factor; on a measured node the Gaussian that has the likelihood's effect
there, found anew in every round (see `fusion.graph.propagation`). Mixtures of a few modes can be had in place of whole
likelihoods. Covariances are those of the probability mass, not of the curvature at a peak.

The rounds see the measured nodes only, with the motions between them composed; all others are solved for at the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.assembly import pose_graph
from fusion.graph.chain import Chain
from fusion.graph.covariances import positive_definite
from fusion.graph.measurements import NOT_MEASURED, REJECTED, Measurement, Measurements
from fusion.graph.odometry_drift import OdometryDrift
from fusion.graph.other_factors import AbsoluteFix, LoopClosure, OtherFactor, bound_nodes, native_factors
from fusion.graph.propagation import Propagated, propagate
from fusion.graph.sites import Sites
from fusion.graph.smoother_settings import SmootherSettings
from fusion.graph.solution import Solution, SteppedGraph
from fusion.odometry import OdometryIncrement
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory, checked_stamps

__all__ = [
    "NOT_MEASURED",
    "REJECTED",
    "AbsoluteFix",
    "LoopClosure",
    "OdometryDrift",
    "SmootherResult",
    "SmootherSettings",
    "smooth",
]

_UNKNOWN_START = np.diag([9.0, 9.0, np.deg2rad(10.0) ** 2])  # of start values that come without covariances
_MOST_LAST_STEPS = 10
_WIDENINGS = (16.0, 4.0)
_WIDENED_ROUNDS = 4
_TOLERANCE = np.array([1e-5, 1e-5, 1e-6])


@dataclass(frozen=True, slots=True, eq=False)
class SmootherResult:
    """What the smoother found.

    Parameters
    ----------
    trajectory : Trajectory
        Smoothed poses with marginal covariances on the axes of the map.
    chosen : (N,) int64
        Which mode of its mixture explains each node best, 0 for a whole likelihood, `REJECTED` (-1) where an outlier
        explains better, `NOT_MEASURED` (-2) elsewhere.
    iterations : int
        Rounds of finding factors and solving.
    converged : bool
        Whether the last round changed nothing to speak of.
    log_evidence : float
        ln density of all measurements given the odometry, up to a constant of the odometry's noise, to compare
        smoothings of the same drive by.
    calibrations, calibration_covariances : (S, 3), (S, 3, 3) float64
        The odometry's ln scale, mounting yaw (rad) and heading bias (rad / m) on every stretch of road, when the
        settings have a drift; S is 0 otherwise.
    other_residuals : (F,) float64
        How far the smoothed poses are from each of the loop closures and absolute fixes, in the order in which they
        were given: Mahalanobis distances, in standard deviations.
    other_weights : (F,) float64
        Share of its information, in [0, 1], that the robust loss left each: near 1 for one that is believed, near 0
        for one that was let go.
    """

    trajectory: Trajectory
    chosen: IntArray
    iterations: int
    converged: bool
    log_evidence: float
    calibrations: FloatArray
    calibration_covariances: FloatArray
    other_residuals: FloatArray
    other_weights: FloatArray


def smooth(
    stamps_ns: ArrayLike,
    increments: Sequence[OdometryIncrement],
    measurements: Sequence[Measurement | None],
    prior: UniformPrior,
    initial: Trajectory | Sequence[Trajectory],
    settings: SmootherSettings | None = None,
    others: Sequence[OtherFactor] = (),
) -> SmootherResult:
    """Trajectory given all odometry and all measurements.

    Parameters
    ----------
    stamps_ns : (N,) int64
        Times of the nodes, strictly increasing.
    increments : sequence of N - 1 OdometryIncrement
        Motion from each node to the next.
    measurements : sequence of N Measurement or None
        What was seen at each node: a likelihood, the patch of one, or the modes of one; tempered for errors that are
        correlated in time.
    prior : UniformPrior
        Of the first node; enters as the Gaussian with the box's mean and covariance.
    initial : Trajectory or sequence of them
        Start values covering the stamps, such as the filter's, and how far they can be trusted. Of several, the one
        with the highest evidence in the end wins.
    settings : SmootherSettings
        How the smoother behaves.
    others : sequence of LoopClosure or AbsoluteFix
        Whatever else binds the poses.

    Raises
    ------
    SkyfixError
        When the numbers of items or their stamps disagree, or the optimisation diverges.
    """
    settings = settings or SmootherSettings()
    stamps = checked_stamps(stamps_ns)
    if len(increments) != len(stamps) - 1 or len(measurements) != len(stamps):
        raise SkyfixError(
            f"smoother: expected {len(stamps) - 1} increments and {len(stamps)} measurements, "
            f"got {len(increments)} and {len(measurements)}"
        )
    if [increment.stamp_ns for increment in increments] != stamps[1:].tolist():
        raise SkyfixError("increments: expected one ending at every stamp after the first, got other stamps")
    starts = [initial] if isinstance(initial, Trajectory) else list(initial)
    if not starts:
        raise SkyfixError("initial: expected at least one trajectory, got none")
    seen = Measurements(measurements, settings.outlier_probability, settings.clutter_log_density)
    chain = Chain.of(increments)
    kept = np.union1d(np.union1d(seen.nodes, [0, len(stamps) - 1]), bound_nodes(others, len(stamps)))
    short, widenings = chain.between(kept), (*(_WIDENINGS if others else ()), 1.0)
    graphs = [pose_graph(short, prior, settings, native_factors(others, kept, width)) for width in widenings]
    among = seen.renumbered(np.searchsorted(kept, seen.nodes))
    found = max(
        (_from(start, stamps[kept], graphs, among, settings.max_iterations) for start in starts),
        key=lambda one: one.log_evidence,
    )
    if len(kept) == len(stamps):
        last = _solved(graphs[-1], found.solution, seen.nodes, found.sites)
    else:
        whole = pose_graph(chain, prior, settings, native_factors(others, np.arange(len(stamps))))
        filled = whole.at(chain.filled(kept, found.solution.poses), seen.nodes, found.sites)
        last = _solved(whole, filled, seen.nodes, found.sites)
    assert last.covariances is not None  # the last step gives them
    assert last.calibration_covariances is not None
    chosen = np.full(len(stamps), NOT_MEASURED, dtype=np.int64)
    chosen[seen.nodes] = found.chosen
    residuals = [other.residual(last.poses) for other in others]
    weights = [other.weight(residual) for other, residual in zip(others, residuals, strict=True)]
    return SmootherResult(
        Trajectory(stamps, last.poses, last.covariances),
        chosen,
        found.rounds,
        found.converged,
        found.log_evidence,
        last.calibrations,
        last.calibration_covariances,
        np.array(residuals, dtype=np.float64),
        np.array(weights, dtype=np.float64),
    )


def _from(
    start: Trajectory, stamps: IntArray, graphs: Sequence[SteppedGraph], measurements: Measurements, max_rounds: int
) -> Propagated:
    """From one graph's solution to the next, the last one to convergence."""
    poses, covariances = start.interpolate(stamps), _covariances_near(stamps, start)
    for graph in graphs[:-1]:
        solution = propagate(graph, measurements, poses, covariances, min(max_rounds, _WIDENED_ROUNDS)).solution
        assert solution.covariances is not None  # every round asks for them
        poses, covariances = solution.poses, solution.covariances
    return propagate(graphs[-1], measurements, poses, covariances, max_rounds)


def _solved(graph: SteppedGraph, solution: Solution, nodes: IntArray, sites: Sites) -> Solution:
    """Steps to the end with the sites as they are."""
    for _ in range(_MOST_LAST_STEPS):
        before = solution.poses
        solution = graph.step(solution, nodes, sites, marginals=False)
        if (np.abs(solution.poses - before).max(axis=0) < _TOLERANCE).all():
            break
    return graph.step(solution, nodes, sites)


def _covariances_near(stamps: IntArray, initial: Trajectory) -> FloatArray:
    """Covariances (N, 3, 3) of the start values: those of the last pose at or before each stamp."""
    if initial.covariances is None:
        return np.repeat(_UNKNOWN_START[None], len(stamps), axis=0)
    at = np.searchsorted(initial.stamp_ns, stamps, side="right") - 1
    return positive_definite(initial.covariances[np.maximum(at, 0)])
