"""Measurements that are a few Gaussians and clutter: their windowed moments in closed form.

Each has hypotheses h with weight w_h, mean m_h and covariance S_h, and a null hypothesis with the outlier probability
p and the clutter density. Under a window ``N(c, W)`` they have the evidence

    (1 - p) w_h N(m_h; c, S_h + W)    and    p clutter.

With the rest of a graph as the window (the cavity), this judges a mode by where everything else puts the pose. Judging
it at the estimate itself would reject every mode that the estimate is not yet drawn to.

Source: Olson, Agarwal, "Inference on networks of mixtures for robust robot mapping", RSS 2012 (null
hypothesis); sums in place of their maxima.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray, IntArray
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.windowed import Windowed, roots_of

_LOG_TWO_PI = float(np.log(se2.TWO_PI))


class MixtureBank:
    """M mixtures, padded to the same number K of components.

    Parameters
    ----------
    mixtures : sequence of GaussianMixture
        Tempered.
    outlier_probability : float or (M,) float64
        p, in [0, 1).
    clutter_log_density : float
        ln density per m^2 rad of a measurement that says nothing.
    """

    def __init__(
        self, mixtures: Sequence[GaussianMixture], outlier_probability: float | FloatArray, clutter_log_density: float
    ) -> None:
        count, most = len(mixtures), max((len(mixture) for mixture in mixtures), default=1)
        self._log_weights = np.full((count, most), -np.inf)
        self._means, self._covariances = np.zeros((count, most, 3)), np.tile(np.eye(3), (count, most, 1, 1))
        for row, mixture in enumerate(mixtures):
            size = len(mixture)
            self._log_weights[row, :size] = np.log(mixture.weights)
            self._means[row, :size], self._covariances[row, :size] = mixture.means, mixture.covariances
        outlier = np.broadcast_to(outlier_probability, count)
        self._log_weights += np.log1p(-outlier)[:, None]
        with np.errstate(divide="ignore"):
            self._log_null = np.log(outlier) + clutter_log_density

    def __len__(self) -> int:
        return len(self._log_weights)

    def some(self, places: IntArray) -> "MixtureBank":
        """Those at some places (K,)."""
        same = copy(self)
        same._log_weights, same._means = self._log_weights[places], self._means[places]
        same._covariances, same._log_null = self._covariances[places], self._log_null[places]
        return same

    def windowed(self, centres: FloatArray, covariances: FloatArray) -> tuple[Windowed, IntArray]:
        """Moments under windows (M, 3) and (M, 3, 3), and the best component of each, -1 for clutter."""
        roots = roots_of(covariances)
        inverse = np.linalg.inv(roots)[:, None]
        off = self._means - centres[:, None]
        off[..., 2] = se2.wrap(off[..., 2])
        off = np.einsum("mkij,mkj->mki", np.broadcast_to(inverse, self._covariances.shape), off)
        measured = inverse @ self._covariances @ inverse.swapaxes(-1, -2)
        total = measured + np.eye(3)
        means = np.linalg.solve(total, off[..., None])[..., 0]
        spreads = np.linalg.solve(total, measured)
        log_det = np.linalg.slogdet(total)[1] + 2.0 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)[:, None]
        log_evidence = self._log_weights - 0.5 * (np.einsum("mki,mki->mk", off, means) + log_det + 3.0 * _LOG_TWO_PI)
        log_evidence = np.column_stack([log_evidence, self._log_null])
        top = log_evidence.max(axis=1)
        log_mass = top + np.log(np.exp(log_evidence - top[:, None]).sum(axis=1))
        share = np.exp(log_evidence - log_mass[:, None])
        mean = np.einsum("mk,mki->mi", share[:, :-1], means)
        outer = means[..., :, None] * means[..., None, :]
        spread = np.einsum("mk,mkij->mij", share[:, :-1], spreads + outer) + share[:, -1, None, None] * np.eye(3)
        spread = 0.5 * (spread + spread.swapaxes(1, 2)) - mean[:, :, None] * mean[:, None, :]
        best = np.argmax(log_evidence, axis=1)
        chosen = np.where(best == log_evidence.shape[1] - 1, -1, best)
        return Windowed(roots, log_mass, mean, spread, np.ones((len(self), 3))), chosen
