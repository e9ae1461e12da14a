"""Solution: where a graph stands, and the interface of graphs that get there step by step."""

from dataclasses import dataclass
from typing import Protocol

from fusion.arrays import FloatArray, IntArray
from fusion.graph.sites import Sites

HALVINGS = 12
"""Of a step that would make the cost grow, at most."""
_SLACK = 1e-9  # of a cost, by which rounding may make a step look worse


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where a graph stands.

    Parameters
    ----------
    poses : (N, 3) float64
        By node.
    calibrations : (S, 3) float64
        See `fusion.graph.odometry_factors`; S is 0 where the odometry is taken as it is.
    covariances : (N, 3, 3) float64
        Marginals on the axes of the map, linearised one step before `poses`; None when they were not asked for.
    calibration_covariances : (S, 3, 3) float64
        Of the calibrations, likewise.
    cost : float
        Minus the log posterior density, up to a constant.
    half_log_det : float
        Half ln of the determinant of the information.
    """

    poses: FloatArray
    calibrations: FloatArray
    covariances: FloatArray | None
    calibration_covariances: FloatArray | None
    cost: float
    half_log_det: float


class SteppedGraph(Protocol):
    """Factors of N poses to which those of the measurements, sites on some nodes, are added."""

    def at(self, poses: FloatArray, nodes: IntArray, sites: Sites) -> Solution:
        """The graph at poses (N, 3), before any step."""

    def step(self, before: Solution, nodes: IntArray, sites: Sites, marginals: bool = True) -> Solution:
        """A Gauss-Newton step, halved until the cost does not grow."""


def is_no_worse(reached: float, cost: float) -> bool:
    """Whether a step may be taken that leads from a cost to another."""
    return reached <= cost + _SLACK * (1.0 + abs(cost))
