"""From a likelihood on a grid to a few Gaussians: what a factor graph can use of it.

A mode is a local maximum that is the highest within a separation radius. Its weight, mean and covariance are the
moments of the probability mass around it: of the cells that are nearer to it than to another mode, within a window of
three standard deviations (found by growing the window until it holds). The moments are those of the histogram, the
spread inside a cell (width^2 / 12) included, which keeps every covariance positive definite.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.special import logsumexp

from fusion import se2
from fusion.arrays import BoolArray, Float32Array, FloatArray, IntArray, checked, read_only
from fusion.errors import SkyfixError

if TYPE_CHECKING:
    from fusion.likelihood import LikelihoodVolume

_RANGE_NATS = 12.0  # cells this far below the peak hold no mass worth counting
_WINDOW_SIGMAS = 3.0
_WINDOW_ROUNDS = 6


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
        weights = checked("mixture weights", self.weights, ("M",))
        if len(weights) == 0 or weights.min() <= 0.0 or weights.sum() > 1.0 + 1e-6:
            raise SkyfixError(f"mixture weights: expected positive with a sum <= 1, got {weights}")
        means = checked("mixture means", self.means, (len(weights), 3)).copy()
        means[:, 2] = se2.wrap(means[:, 2])
        covariances = checked("mixture covariances", self.covariances, (len(weights), 3, 3))
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

    def log_density(self, poses: ArrayLike) -> FloatArray:
        """ln density (N,) of the sum of the components at poses (N, 3)."""
        return np.asarray(logsumexp(self.component_log_density(poses), axis=1))


def circular_run(mask: BoolArray) -> IntArray:
    """Indices of the shortest circular run that covers every True of `mask` (K,), in running order."""
    size = len(mask)
    hits = np.flatnonzero(mask)
    gaps = np.diff(np.append(hits, hits[0] + size))
    last = int(np.argmax(gaps))
    start = int(hits[(last + 1) % len(hits)])
    return (start + np.arange(size - int(gaps[last]) + 1)) % size


def _cells_worth_counting(volume: "LikelihoodVolume", threshold: float) -> tuple[Float32Array, IntArray, IntArray]:
    """The box of cells above the threshold: log densities (r, c, b), its corner (row, col), its yaw bins (b,)."""
    bins = circular_run(volume.bin_peaks > threshold)
    values = volume.log_prob if len(bins) == volume.log_prob.shape[2] else volume.log_prob[:, :, bins]
    if len(bins) == volume.log_prob.shape[2]:
        bins = np.arange(len(bins))
    plan = values.max(axis=2) > threshold
    rows, cols = np.flatnonzero(plan.any(axis=1)), np.flatnonzero(plan.any(axis=0))
    box = values[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    return box, np.array([rows[0], cols[0]]), bins


def _separate(candidates: FloatArray, k: int, radii: FloatArray) -> FloatArray:
    """Greedy non-maximum suppression: the first `k` of the candidates (N, 3), best first, apart by `radii` (3,)."""
    kept: list[FloatArray] = []
    while len(candidates) and len(kept) < k:
        best = candidates[0]
        kept.append(best)
        candidates = candidates[_squared_distance(candidates, best[None], radii)[:, 0] > 1.0]
    return np.array(kept)


def _squared_distance(poses: FloatArray, peaks: FloatArray, radii: FloatArray) -> FloatArray:
    """Squared distances (N, M), in units of the separation radii, position or heading, whichever is larger."""
    position = ((poses[:, None, :2] - peaks[:, :2]) ** 2).sum(axis=-1) / radii[0] ** 2
    heading = (se2.wrap(poses[:, None, 2] - peaks[:, 2]) / radii[2]) ** 2
    return np.maximum(position, heading)


def _moments(
    poses: FloatArray, mass: FloatArray, peak: FloatArray, radii: FloatArray, cell: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Weight, mean and covariance of the mass within three standard deviations of the mean, starting at `radii`."""
    residual = poses - peak
    residual[:, 2] = se2.wrap(residual[:, 2])
    centre, half = np.zeros(3), radii.copy()
    for _ in range(_WINDOW_ROUNDS):
        inside = (np.abs(residual - centre) <= half).all(axis=1)
        here, share = residual[inside], mass[inside]
        weight = float(share.sum())
        centre = share @ here / weight
        deviation = here - centre
        covariance = (deviation * share[:, None]).T @ deviation / weight + np.diag(cell**2 / 12.0)
        grown = np.maximum(radii, _WINDOW_SIGMAS * np.sqrt(np.diag(covariance)))
        if (grown <= 1.02 * half).all():
            break
        half = grown
    mean = peak + centre
    mean[2] = se2.wrap(mean[2])
    return weight, mean, covariance


def find_modes(
    volume: "LikelihoodVolume", k: int, separation_m: float = 3.0, separation_rad: float = np.deg2rad(10.0)
) -> GaussianMixture:
    """The `k` highest modes of a likelihood, as Gaussians; fewer when there are fewer.

    Parameters
    ----------
    volume : LikelihoodVolume
        Tempered beforehand when its errors are correlated in time.
    k : int
        Most modes to return, at least 1.
    separation_m, separation_rad : float
        Two modes differ by more than this in position or in heading.

    Returns
    -------
    GaussianMixture
        Sorted by falling weight; the weights are shares of the whole likelihood's mass.

    Raises
    ------
    SkyfixError
        When `k` is not positive.
    """
    if k < 1:
        raise SkyfixError(f"modes: expected k >= 1, got {k}")
    grid, bin_count = volume.grid, volume.log_prob.shape[2]
    cell = np.array([grid.metres_per_pixel, grid.metres_per_pixel, se2.TWO_PI / bin_count])
    radii = np.maximum([separation_m, separation_m, separation_rad], cell)
    threshold = max(float(volume.bin_peaks.max()) - _RANGE_NATS, volume.floor)
    values, corner, bins = _cells_worth_counting(volume, threshold)

    def poses_at(indices: tuple[IntArray, ...]) -> FloatArray:
        row_col = np.stack(indices[:2], axis=-1) + corner + 0.5
        return np.column_stack([grid.xy_from_pixel(row_col), se2.wrap(bins[indices[2]] * cell[2])])

    edges = ("constant", "constant", "wrap" if len(bins) == bin_count else "constant")
    highest = ndimage.maximum_filter(values, size=3, mode=edges, cval=-np.inf)
    maxima = np.nonzero((values == highest) & (values > threshold))
    order = np.argsort(-values[maxima], kind="stable")
    peaks = _separate(poses_at(maxima)[order], k, radii)

    cells = np.nonzero(values > threshold)
    poses = poses_at(cells)
    mass = np.exp(values[cells].astype(np.float64)) * cell.prod()
    nearest = np.argmin(_squared_distance(poses, peaks, radii), axis=1)
    parts = [_moments(poses[nearest == i], mass[nearest == i], peak, radii, cell) for i, peak in enumerate(peaks)]
    weights = np.array([part[0] for part in parts])
    ranked = np.argsort(-weights, kind="stable")
    weights = weights / max(1.0, weights.sum())  # the sum may exceed 1 by rounding
    return GaussianMixture(
        weights[ranked], np.array([part[1] for part in parts])[ranked], np.array([part[2] for part in parts])[ranked]
    )
