"""One scan matched with the map, and what is kept of it: a volume is tens of megabytes, its modes are a few numbers."""

from __future__ import annotations

from dataclasses import dataclass

from fusion.arrays import Float32Array, FloatArray
from fusion.likelihood import LikelihoodVolume
from fusion.modes import GaussianMixture
from learned.matcher import SearchRegion


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """A likelihood and where it comes from.

    Attributes
    ----------
    points
        (N, 4) float32, the scan in the body frame.
    search
        The poses that were scored.
    likelihood
        As the matcher gave it.
    temperature
        By which the filter and the smoother flatten it.
    """

    points: Float32Array
    search: SearchRegion
    likelihood: LikelihoodVolume
    temperature: float

    def modes(self, k: int) -> GaussianMixture:
        """The at most `k` strongest modes of the flattened likelihood, for the smoother."""
        return self.likelihood.tempered(self.temperature).modes(k)

    def best_pose(self) -> FloatArray:
        """The matcher's own answer (3,): the mean of the mass around its strongest mode, an argmax refined below the
        cell."""
        return self.likelihood.modes(1).means[0].copy()
