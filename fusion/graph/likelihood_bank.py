"""All likelihoods of a drive side by side, so that one compiled pass answers for all of them."""

from collections.abc import Sequence
from copy import copy

import numba
import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.graph.patch import LikelihoodPatch, either
from fusion.graph.window_kernel import window_moments
from fusion.graph.windowed import Windowed, roots_of


class LikelihoodBank:
    """M likelihoods, each mixed with outliers: ``(1 - p) L + p u``, where p is by its own cause or by that of all.

    Parameters
    ----------
    patches : sequence of LikelihoodPatch
        Tempered. Their cells are read where they lie: a drive's are a hundred megabytes, and a window sees a few.
    outlier_probability : float
        Of all, in [0, 1).
    """

    def __init__(self, patches: Sequence[LikelihoodPatch], outlier_probability: float) -> None:
        self._patches = tuple(patches)  # keeps the cells alive
        tables = [(_address_of(patch.log_prob), *patch.log_prob.shape, patch.bin_count) for patch in patches]
        self._tables = np.array(tables, dtype=np.int64).reshape(-1, 5)
        self._tables[:, 4] = self._tables[:, 3] == self._tables[:, 4]
        self._places = _places_of(patches, outlier_probability)

    def __len__(self) -> int:
        return len(self._tables)

    def some(self, places: IntArray) -> "LikelihoodBank":
        """Those at some places (K,)."""
        same = copy(self)
        same._tables, same._places = self._tables[places], self._places[places]
        return same

    def windowed(self, centres: FloatArray, covariances: FloatArray) -> Windowed:
        """Moments under windows with centres (M, 3) and covariances (M, 3, 3), map frame."""
        count, roots = len(self), roots_of(covariances)
        found = Windowed(roots, np.empty(count), np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3)))
        window_moments(
            self._tables,
            self._places,
            np.ascontiguousarray(centres),
            roots,
            found.log_mass,
            found.means,
            found.spreads,
            found.flat,
        )
        return found

    def outlier_share(self, log_mass: FloatArray) -> FloatArray:
        """Probability (M,) that each is an outlier, given the evidence under its window."""
        return np.asarray(self._places[:, 7] * np.exp(np.minimum(self._places[:, 6] - log_mass, 700.0)))


def _places_of(patches: Sequence[LikelihoodPatch], outlier_probability: float) -> FloatArray:
    """(M, 8), see `fusion.graph.window_kernel.window_moments`."""
    grids = [(patch.grid.metres_per_pixel, patch.grid.x0, patch.grid.y0, patch.grid.rows) for patch in patches]
    metres, x0, y0, rows = np.array(grids, dtype=np.float64).reshape(-1, 4).T
    others = [(patch.first_bin, patch.bin_count, patch.floor, patch.log_uniform) for patch in patches]
    first_bin, bin_count, floor, log_uniform = np.array(others, dtype=np.float64).reshape(-1, 4).T
    outlier = either(outlier_probability, np.array([patch.outlier_probability for patch in patches], dtype=np.float64))
    radians, half = se2.TWO_PI / bin_count, 0.5 * metres
    return np.column_stack(
        [x0 + half, y0 + rows * metres - half, first_bin * radians, metres, radians, floor, log_uniform, outlier]
    )


@numba.njit(cache=True)
def _address_of(cells: NDArray[np.float32]) -> int:
    """Where an array lies in memory."""
    return int(cells.ctypes.data)
