"""What is known of the first pose before any measurement: a box of positions and headings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fusion import se2
from fusion.arrays import BoolArray, FloatArray, checked, read_only
from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True, eq=False)
class UniformPrior:
    """Uniform over ``centre +- half extents``, the box on the axes of the map.

    Parameters
    ----------
    centre : (3,) float64
        ``[x, y, yaw]``, map frame.
    half_extent_m : float
        Half side of the square of positions.
    half_heading_rad : float
        Half width of the interval of headings, at most pi; pi says that the heading is unknown.

    Raises
    ------
    SkyfixError
        When an extent is not positive, the heading's exceeds pi, or a value is not finite.
    """

    centre: FloatArray
    half_extent_m: float
    half_heading_rad: float

    def __post_init__(self) -> None:
        centre = checked("prior centre", self.centre, (3,)).copy()
        centre[2] = se2.wrap(centre[2])
        object.__setattr__(self, "centre", read_only(centre))
        if not (np.isfinite(self.half_extent_m) and self.half_extent_m > 0.0):
            raise SkyfixError(f"prior: expected half_extent_m > 0, got {self.half_extent_m}")
        if not 0.0 < self.half_heading_rad <= np.pi:
            raise SkyfixError(f"prior: expected half_heading_rad in (0, pi], got {self.half_heading_rad}")

    @property
    def mean(self) -> FloatArray:
        """Mean pose (3,): the centre."""
        return self.centre.copy()

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the box: a third of each half side squared."""
        half = np.array([self.half_extent_m, self.half_extent_m, self.half_heading_rad])
        return np.diag(half**2 / 3.0)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw `n` poses (n, 3)."""
        half = np.array([self.half_extent_m, self.half_extent_m, self.half_heading_rad])
        poses = self.centre + rng.uniform(-half, half, size=(n, 3))
        poses[:, 2] = se2.wrap(poses[:, 2])
        return poses

    def contains(self, poses: ArrayLike) -> BoolArray:
        """Whether poses (..., 3) lie in the box, edges included."""
        poses = checked("poses", poses, (..., 3))
        in_square = (np.abs(poses[..., :2] - self.centre[:2]) <= self.half_extent_m).all(axis=-1)
        return in_square & (np.abs(se2.wrap(poses[..., 2] - self.centre[2])) <= self.half_heading_rad)

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (...) per m^2 rad of poses (..., 3): the same all over the box, minus infinity outside."""
        volume = (2.0 * self.half_extent_m) ** 2 * 2.0 * self.half_heading_rad
        return np.where(self.contains(poses), -np.log(volume), -np.inf)
