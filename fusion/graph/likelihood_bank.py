"""All likelihoods of a drive side by side, so that one compiled pass answers for all of them."""

from collections.abc import Sequence

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.graph.patch import LikelihoodPatch
from fusion.graph.window_kernel import window_moments
from fusion.graph.windowed import Windowed, roots_of


class LikelihoodBank:
    """M likelihoods, each mixed with outliers: ``(1 - p) L + p u``.

    Parameters
    ----------
    patches : sequence of LikelihoodPatch
        Tempered. Their cells are read where they lie: a drive's are a hundred megabytes, and a window sees a few.
    outlier_probability : float
        p, in [0, 1).
    """

    def __init__(self, patches: Sequence[LikelihoodPatch], outlier_probability: float) -> None:
        self._patches = tuple(patches)  # keeps the cells alive
        self._outlier = outlier_probability
        tables = [
            (patch.log_prob.__array_interface__["data"][0], *patch.log_prob.shape, patch.wraps) for patch in patches
        ]
        self._tables = np.array(tables, dtype=np.int64).reshape(-1, 5)
        places = [
            (
                *patch.first_centre,
                patch.grid.metres_per_pixel,
                se2.TWO_PI / patch.bin_count,
                patch.floor,
                patch.log_uniform,
            )
            for patch in patches
        ]
        self._places = np.array(places).reshape(-1, 7)

    def __len__(self) -> int:
        return len(self._patches)

    def windowed(self, centres: FloatArray, covariances: FloatArray) -> Windowed:
        """Moments under windows with centres (M, 3) and covariances (M, 3, 3), map frame."""
        count, roots = len(self), roots_of(covariances)
        found = Windowed(roots, np.empty(count), np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3)))
        window_moments(
            self._tables,
            self._places,
            self._outlier,
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
        return np.asarray(self._outlier * np.exp(np.minimum(self._places[:, 6] - log_mass, 700.0)))
