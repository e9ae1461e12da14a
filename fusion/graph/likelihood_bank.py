"""All likelihoods of a drive in one array, so that one compiled pass answers for all of them."""

from collections.abc import Sequence

import numpy as np

from fusion.arrays import FloatArray
from fusion.graph.patch import LikelihoodPatch
from fusion.graph.window_kernel import window_moments
from fusion.graph.windowed import Windowed, roots_of


class LikelihoodBank:
    """M likelihoods, each mixed with outliers: ``(1 - p) L + p u``.

    Parameters
    ----------
    patches : sequence of LikelihoodPatch
        Tempered.
    outlier_probability : float
        p, in [0, 1).
    """

    def __init__(self, patches: Sequence[LikelihoodPatch], outlier_probability: float) -> None:
        self._outlier = outlier_probability
        sizes = np.array([patch.log_prob.size for patch in patches], dtype=np.int64)
        self._table = np.concatenate([np.empty(0, np.float32), *(patch.log_prob.ravel() for patch in patches)])
        self._begins = np.cumsum(sizes) - sizes
        shapes = [(*patch.log_prob.shape, int(patch.wraps)) for patch in patches]
        self._shapes = np.array(shapes, dtype=np.int64).reshape(-1, 4)
        self._firsts = np.array([patch.first_centre for patch in patches]).reshape(-1, 3)
        cells = [(patch.grid.metres_per_pixel, 2.0 * np.pi / patch.bin_count) for patch in patches]
        self._cells = np.array(cells).reshape(-1, 2)
        self._floors = np.array([patch.floor for patch in patches], dtype=np.float64)
        self._log_uniforms = np.array([patch.log_uniform for patch in patches], dtype=np.float64)

    def __len__(self) -> int:
        return len(self._begins)

    def windowed(self, centres: FloatArray, covariances: FloatArray) -> Windowed:
        """Moments under windows with centres (M, 3) and covariances (M, 3, 3), map frame."""
        count, roots = len(self), roots_of(covariances)
        found = Windowed(roots, np.empty(count), np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3)))
        window_moments(
            self._table,
            self._begins,
            self._shapes,
            self._firsts,
            self._cells,
            self._floors,
            self._log_uniforms,
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
        return np.asarray(self._outlier * np.exp(np.minimum(self._log_uniforms - log_mass, 700.0)))
