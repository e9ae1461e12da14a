"""The particles while the start is being found: drawn from every measurement so far, weighted by all of them.

One scan often fits the wrong street best. A filter that begins with its first measurement alone then has hardly a
particle on the right one, and the next measurements, which would know, find nothing to weigh. So until the start is
settled the cloud is made anew with each measurement. Its target is the posterior of the path x_0 .. x_k,

    U(x_0) prod_i L_i(x_i) prod_i p(x_i | x_i-1, odometry),

with U the start's box and L_i the flattened likelihoods with their share of outliers. Paths are proposed from the box
and from each likelihood in turn, drawn there and carried to the other measurements by noisy odometry, and weighted by
the target over the mixture of the proposals (Veach and Guibas, "Optimally combining sampling techniques for Monte
Carlo rendering", 1995: the balance heuristic). The odometry's density is common to all of them and cancels.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import FloatArray
from fusion.likelihood import PoseLikelihood
from fusion.odometry import OdometryIncrement

_BOX_SHARE = 0.2
MOST_MEASUREMENTS = 8
"""To make a cloud from: their volumes are kept in memory, and each costs the more the more there are."""


class StartPrior(Protocol):
    """What is known of the first pose beforehand; `fusion.prior.UniformPrior` is one."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3)."""
        ...

    def log_density(self, poses: FloatArray) -> FloatArray:
        """ln density (N,) at poses (N, 3), per m^2 rad; minus infinity where the first pose cannot be."""
        ...


class StartCloud:
    """Weighted particles of the posterior after the first few measurements.

    Parameters
    ----------
    prior
        What is known of the first pose: the start's box.
    size
        Number of particles.
    outlier_probability
        Chance that a measurement is about nothing.
    rng
        Source of all randomness.
    """

    def __init__(self, prior: StartPrior, size: int, outlier_probability: float, rng: np.random.Generator) -> None:
        self._prior, self._size, self._outlier_probability, self._rng = prior, size, outlier_probability, rng
        self._likelihoods: list[PoseLikelihood] = []
        self._drawn_from: list[PoseLikelihood] = []
        self._drawn: list[FloatArray] = []
        self._motions: list[OdometryIncrement] = []

    def __len__(self) -> int:
        return len(self._likelihoods)

    def add(
        self,
        likelihood: PoseLikelihood,
        motion: OdometryIncrement | None,
        drawn_from: PoseLikelihood | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Take in one more measurement.

        Parameters
        ----------
        likelihood
            Flattened for errors shared with the measurement before.
        motion
            Odometry since that one; None for the first.
        drawn_from
            What poses are proposed from: the likelihood itself when left out. Over a large region the flattened
            likelihood has most of its mass where hardly anything fits, and a sharper one makes the better proposal.

        Returns
        -------
        Particles (n, 3) at this measurement and their log weights (n,), not normalised.
        """
        self._likelihoods.append(likelihood)
        self._drawn_from.append(drawn_from or likelihood)
        self._drawn.append(self._drawn_from[-1].sample(self._size, self._rng))
        if motion is not None:
            self._motions.append(motion)
        paths = np.concatenate([self._carried(*proposal) for proposal in self._proposals()], axis=1)
        return paths[-1], self._log_weights(paths)

    def _shares(self) -> FloatArray:
        """Share of the paths proposed from the box and from each likelihood, (k + 2,)."""
        count = len(self._likelihoods)
        return np.array([_BOX_SHARE, *np.full(count, (1.0 - _BOX_SHARE) / count)])

    def _proposals(self) -> list[tuple[int, FloatArray]]:
        """Poses drawn at one measurement each: (its number, (n, 3))."""
        sizes = np.diff(np.rint(np.cumsum([0.0, *self._shares()]) * self._size).astype(int))
        drawn = [(0, self._prior.sample(int(sizes[0]), self._rng))]
        return drawn + [(number, poses[: sizes[number + 1]]) for number, poses in enumerate(self._drawn)]

    def _carried(self, number: int, poses: FloatArray) -> FloatArray:
        """Paths (k + 1, n, 3) through all measurements from poses (n, 3) at one of them, by odometry with new noise."""
        path = [poses]
        for motion in self._motions[number:]:
            path.append(se2.compose(path[-1], self._noisy(motion, len(poses))))
        for motion in reversed(self._motions[:number]):
            path.insert(0, se2.compose(path[0], se2.inverse(self._noisy(motion, len(poses)))))
        return np.array(path)

    def _noisy(self, motion: OdometryIncrement, n: int) -> FloatArray:
        """Deltas (n, 3)."""
        return motion.delta + self._rng.multivariate_normal(np.zeros(3), motion.covariance, n, method="eigh")

    def _log_weights(self, paths: FloatArray) -> FloatArray:
        """Target over proposals, (n,), of paths (k + 1, n, 3)."""
        box = self._prior.log_density(paths[0])
        proposals, target = [box], box.copy()
        for likelihood, drawn_from, poses in zip(self._likelihoods, self._drawn_from, paths, strict=True):
            proposals.append(drawn_from.draw_log_density(poses))
            target += likelihood.with_outliers(self._outlier_probability).log_density(poses)
        weights = target - logsumexp(np.array(proposals), axis=0, b=self._shares()[:, None])
        return np.maximum(weights, np.max(weights) - 700.0)
