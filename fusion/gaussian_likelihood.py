"""A single Gaussian as a likelihood: networks that regress a pose, a GNSS fix, a closed form to test against."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import FloatArray, checked, keep_plain
from fusion.errors import SkyfixError
from fusion.gaussian_mixture import GaussianMixture
from fusion.grid import MapGrid
from fusion.likelihood import DEFAULT_FLOOR, LikelihoodVolume, OutlierMixture, checked_temperature


@dataclass(frozen=True, slots=True, eq=False)
class GaussianLikelihood:
    """``N(pose; mean, covariance)``, never below the floor.

    Parameters
    ----------
    mean : (3,) float64
        ``[x, y, yaw]``, map frame.
    covariance : (3, 3) float64
        On the axes of the map, positive definite.
    grid : MapGrid
        The region in which the measurement could have come out: what an outlier is uniform over.
    floor : float
        Least ln density per m^2 rad.

    Raises
    ------
    SkyfixError
        When a value is not finite or the covariance is not positive definite.
    """

    mean: FloatArray
    covariance: FloatArray
    grid: MapGrid
    floor: float = DEFAULT_FLOOR

    def __post_init__(self) -> None:
        keep_plain(self, ["floor"])
        mixture = self.modes(1)  # checks both
        if not np.isfinite(self.floor):
            raise SkyfixError(f"likelihood: expected a finite floor, got {self.floor}")
        object.__setattr__(self, "mean", mixture.means[0])
        object.__setattr__(self, "covariance", mixture.covariances[0])

    @property
    def searched_volume(self) -> float:
        """The grid times all headings, m^2 rad."""
        return self.grid.area_m2 * se2.TWO_PI

    def to_volume(self, yaw_bins: int = 180) -> LikelihoodVolume:
        """The density at the cells of the grid and so many headings, normalised there."""
        x, y = self.grid.centres()
        yaw = np.arange(yaw_bins) * (se2.TWO_PI / yaw_bins)
        mesh = np.stack([axis.ravel() for axis in np.meshgrid(x, y, yaw)], axis=1)
        return LikelihoodVolume.from_scores(self.log_density(mesh).reshape(len(y), len(x), yaw_bins), self.grid)

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) at poses (N, 3), yaw residuals wrapped."""
        return np.maximum(self.modes(1).log_density(poses), self.floor)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw poses (n, 3)."""
        poses = rng.multivariate_normal(self.mean, self.covariance, size=n, method="cholesky")
        poses[:, 2] = se2.wrap(poses[:, 2])
        return poses

    def draw_log_density(self, poses: ArrayLike) -> FloatArray:
        """The Gaussian's own ln density (N,) at poses (N, 3), without a floor."""
        return self.modes(1).log_density(poses)

    def modes(self, k: int) -> GaussianMixture:
        """The Gaussian itself."""
        if k < 1:
            raise SkyfixError(f"modes: expected k >= 1, got {k}")
        covariance = checked("likelihood covariance", self.covariance, (3, 3))
        return GaussianMixture(np.ones(1), checked("likelihood mean", self.mean, (3,))[None], covariance[None])

    def tempered(self, temperature: float) -> "GaussianLikelihood":
        """The Gaussian with `temperature` times the covariance."""
        covariance = self.covariance * checked_temperature(temperature)
        return GaussianLikelihood(self.mean, covariance, self.grid, self.floor)

    def with_outliers(self, probability: float) -> OutlierMixture:
        """Allow for a measurement that says nothing: mix in the uniform density over the crop."""
        return OutlierMixture(self, probability)
