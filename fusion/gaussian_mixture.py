"""GaussianMixture: a few weighted Gaussians over poses, the form in which modes travel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import FloatArray, checked, read_only
from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True, eq=False)
class GaussianMixture:
    """Weighted Gaussians over poses.

    Parameters
    ----------
    weights : (M,) float64
        Probability mass of each component, positive. The sum is at most 1: what is missing lies outside every
        component (clutter).
    means : (M, 3) float64
        ``[x, y, yaw]``, map frame.
    covariances : (M, 3, 3) float64
        On the axes of the map, positive definite.

    Raises
    ------
    SkyfixError
        When there is no component, shapes disagree, or a weight or covariance is not positive.
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray

    def __post_init__(self) -> None:
        weights = checked("mixture weights", self.weights, ("M",)).copy()
        if len(weights) == 0 or weights.min() <= 0.0 or weights.sum() > 1.0 + 1e-6:
            raise SkyfixError(f"mixture weights: expected positive with a sum <= 1, got {weights}")
        means = checked("mixture means", self.means, (len(weights), 3)).copy()
        means[:, 2] = se2.wrap(means[:, 2])
        covariances = checked("mixture covariances", self.covariances, (len(weights), 3, 3)).copy()
        if not np.allclose(covariances, covariances.swapaxes(1, 2), rtol=1e-6, atol=1e-12):
            raise SkyfixError("mixture covariances: expected symmetric matrices, got one that is not")
        if np.linalg.eigvalsh(covariances).min() <= 0.0:
            raise SkyfixError("mixture covariances: expected positive definite, got an eigenvalue <= 0")
        object.__setattr__(self, "weights", read_only(weights))
        object.__setattr__(self, "means", read_only(means))
        object.__setattr__(self, "covariances", read_only(covariances))

    def __len__(self) -> int:
        return len(self.weights)

    def component_log_density(self, poses: ArrayLike) -> FloatArray:
        """ln of weight times density of each component, (N, M), at poses (N, 3); yaw residuals are wrapped."""
        residual = checked("poses", poses, ("N", 3))[:, None, :] - self.means
        residual[..., 2] = se2.wrap(residual[..., 2])
        root = np.linalg.cholesky(self.covariances)
        white = np.einsum("mij,nmj->nmi", np.linalg.inv(root), residual)
        log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return np.log(self.weights) - 0.5 * ((white**2).sum(axis=-1) + log_det + 3.0 * np.log(se2.TWO_PI))

    def tempered(self, temperature: float) -> "GaussianMixture":
        """Flatten as a power 1 / temperature does where the components do not overlap, strongest component first.

        Every Gaussian keeps its place and gets `temperature` times its covariance; how much the components' peaks
        differ shrinks by the same power. The total weight stays.

        Tempering a density cell by cell and taking the moments afterwards is not the same: far from Gaussian, its
        wide skirts take over the mass and draw the means away from the peaks.

        Raises
        ------
        SkyfixError
            When the temperature is not positive.
        """
        if not (np.isfinite(temperature) and temperature > 0.0):
            raise SkyfixError(f"temperature: expected > 0, got {temperature}")
        half_log_det = 0.5 * np.linalg.slogdet(self.covariances)[1]
        log_peak = np.log(self.weights) - half_log_det
        log_weight = log_peak / temperature + half_log_det  # the new half_log_det differs by the same amount for all
        weights = np.exp(log_weight - logsumexp(log_weight)) * self.weights.sum()
        order = np.argsort(-weights, kind="stable")
        weights = np.maximum(weights[order], np.finfo(np.float64).tiny)
        return GaussianMixture(weights, self.means[order], temperature * self.covariances[order])

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) of the sum of the components at poses (N, 3)."""
        return np.asarray(logsumexp(self.component_log_density(poses), axis=1))
