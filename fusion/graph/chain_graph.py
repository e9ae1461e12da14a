"""ChainGraph: poses bound by a prior and by the motions between neighbours alone, stepped without a call to GTSAM.

Factors, steps and covariances are those of the same `PoseGraph`, which this is tested against; for thousands of poses
that one spends nine tenths of its time on passing factors from Python to GTSAM and back.
"""

from typing import Protocol

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.errors import SkyfixError
from fusion.graph.chain_elimination import WIDTH, eliminate_chain, substitute_back
from fusion.graph.chain_marginals import covariances_back
from fusion.graph.covariances import positive_definite
from fusion.graph.plain_odometry import PlainOdometry
from fusion.graph.sites import Sites
from fusion.graph.solution import HALVINGS, Solution, is_no_worse

_ORIGIN = np.zeros((1, 3))
_NO_CALIBRATIONS = np.zeros((0, 3))


class Motions(Protocol):
    """The N - 1 motions of a chain, and the S calibrations that they may have: none, or the one of their stretch."""

    @property
    def count(self) -> int:
        """S."""

    @property
    def stretch(self) -> IntArray:
        """The calibration of each motion (N - 1,), non-decreasing."""

    @property
    def first_sigmas(self) -> FloatArray:
        """Standard deviations (3,) of the first calibration about zero; empty when S is 0."""

    @property
    def step_sigmas(self) -> FloatArray:
        """Of the differences between neighbouring ones."""

    def cost(self, poses: FloatArray, calibrations: FloatArray) -> float:
        """Minus the log density of the motions and the calibrations, up to a constant."""

    def linearised(self, poses: FloatArray, calibrations: FloatArray) -> tuple[FloatArray, ...]:
        """Derivatives by both poses and the calibration, right-hand sides; whitened, poses on the axes of the map."""


class ChainGraph:
    """A chain of N poses.

    Parameters
    ----------
    prior : PlainOdometry
        Of the first pose: one motion from the origin.
    motions : Motions
        Between each pose and the next.
    count : int
        N.
    """

    def __init__(self, prior: PlainOdometry, motions: Motions, count: int) -> None:
        self._prior, self._motions, self._count = prior, motions, count
        self._stretch = motions.stretch
        last = np.append(np.flatnonzero(np.diff(self._stretch)), count - 2)  # pose of each stretch that goes last
        self._slots = np.insert(np.zeros(count, dtype=np.int64), last[: motions.count] + 1, 1)

    def at(self, poses: FloatArray, nodes: IntArray, sites: Sites) -> Solution:
        """The graph at poses (N, 3), before any step."""
        calibrations = np.zeros((self._motions.count, 3))
        return Solution(poses, calibrations, None, None, self._cost(poses, calibrations, nodes, sites), 0.0)

    def step(self, before: Solution, nodes: IntArray, sites: Sites, marginals: bool = True) -> Solution:
        """A Gauss-Newton step, halved until the cost does not grow.

        Raises
        ------
        SkyfixError
            When the graph cannot be solved or the solution is not finite.
        """
        poses, calibrations = before.poses, before.calibrations
        roots, links, values, half_log_det = self._eliminated(poses, calibrations, nodes, sites)
        if not np.isfinite(half_log_det):
            raise SkyfixError("smoother: expected a solvable graph, got one without a unique solution")
        steps = np.empty_like(values)
        substitute_back(roots, links, values, self._slots, steps)
        moves, turns = steps[self._slots == 0], steps[self._slots == 1]
        cost, reached = self._cost(poses, calibrations, nodes, sites), np.inf
        for halving in range(HALVINGS):
            poses = before.poses + 0.5**halving * moves
            poses[:, 2] = se2.wrap(poses[:, 2])
            calibrations = before.calibrations + 0.5**halving * turns
            reached = self._cost(poses, calibrations, nodes, sites)
            if is_no_worse(reached, cost):
                break
        if not (np.isfinite(reached) and np.isfinite(poses).all()):
            raise SkyfixError("smoother: expected a finite solution, got NaN or an infinity")
        if not marginals:
            return Solution(poses, calibrations, None, None, reached, half_log_det)
        covariances = np.empty_like(roots)
        covariances_back(roots, links, self._slots, covariances)
        own = positive_definite(covariances[self._slots == 0])
        return Solution(poses, calibrations, own, covariances[self._slots == 1], reached, half_log_det)

    def _eliminated(
        self, poses: FloatArray, calibrations: FloatArray, nodes: IntArray, sites: Sites
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Roots, links and right-hand sides by variable, see `fusion.graph.chain_elimination`; half ln determinant."""
        motions, own = self._motions, sites.about(poses[nodes])
        precisions, informations = np.zeros((self._count, 3, 3)), np.zeros((self._count, 3))
        precisions[nodes], informations[nodes] = own.precision, own.information
        _, [root], _, [right] = self._prior.linearised(np.concatenate([_ORIGIN, poses[:1]]), _NO_CALIBRATIONS)
        message, left = np.zeros((WIDTH, WIDTH)), np.zeros(WIDTH)
        message[:3, :3], left[:3] = root.T @ root, root.T @ right
        if motions.count:
            weights = motions.first_sigmas**-2
            message[3:, 3:], left[3:] = np.diag(weights), -weights * calibrations[0]
        size = len(self._slots)
        roots, links, values = np.empty((size, 3, 3)), np.empty((size, 3, WIDTH)), np.empty((size, 3))
        half_log_det = eliminate_chain(
            *motions.linearised(poses, calibrations),
            self._stretch,
            message,
            left,
            precisions,
            informations,
            motions.step_sigmas**-2,
            np.diff(calibrations, axis=0),
            roots,
            links,
            values,
        )
        return roots, links, values, float(half_log_det)

    def _cost(self, poses: FloatArray, calibrations: FloatArray, nodes: IntArray, sites: Sites) -> float:
        own = self._prior.cost(np.concatenate([_ORIGIN, poses[:1]]), _NO_CALIBRATIONS)
        return own + self._motions.cost(poses, calibrations) + float(sites.costs(poses[nodes]).sum())
