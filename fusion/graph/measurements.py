"""Measurements: what was seen along a drive, whole likelihoods and Gaussian mixtures alike."""

from collections.abc import Sequence
from copy import copy

import numpy as np

from fusion.arrays import FloatArray, IntArray
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.likelihood_bank import LikelihoodBank
from fusion.graph.mixture_bank import MixtureBank
from fusion.graph.patch import LikelihoodPatch, either, patch_of, without_outliers
from fusion.graph.windowed import Windowed
from fusion.likelihood import PoseLikelihood

Measurement = GaussianMixture | LikelihoodPatch | PoseLikelihood
"""Tempered for errors correlated in time; the outlier probability of an outlier mixture counts beside that of all."""

REJECTED = -1
NOT_MEASURED = -2


class Measurements:
    """The measurements of a graph's nodes; M nodes have one.

    Parameters
    ----------
    measurements : sequence of N Measurement or None
        One a node.
    outlier_probability : float
        Chance that any of them says nothing, in [0, 1).
    clutter_log_density : float
        ln density of such a measurement per m^2 rad where it does not tell itself (mixtures).
    """

    def __init__(
        self, measurements: Sequence[Measurement | None], outlier_probability: float, clutter_log_density: float
    ) -> None:
        mixtures: dict[int, GaussianMixture] = {}
        own: list[float] = []  # outlier probabilities of the mixtures
        patches: dict[int, LikelihoodPatch] = {}
        for node, measurement in enumerate(measurements):
            if measurement is None:
                continue
            if isinstance(measurement, GaussianMixture):
                mixtures[node] = measurement
                own.append(0.0)
                continue
            if isinstance(measurement, LikelihoodPatch):
                patches[node] = measurement
                continue
            inner, probability = without_outliers(measurement)
            if isinstance(inner, GaussianLikelihood):
                mixtures[node] = inner.modes(1)
                own.append(probability)
            else:
                patches[node] = patch_of(measurement)
        self.nodes: IntArray = np.array([*mixtures, *patches], dtype=np.int64)
        self._mixtures = MixtureBank(
            list(mixtures.values()), either(outlier_probability, np.array(own)), clutter_log_density
        )
        self._bank = LikelihoodBank(list(patches.values()), outlier_probability)

    def __len__(self) -> int:
        return len(self.nodes)

    def renumbered(self, nodes: IntArray) -> "Measurements":
        """The same measurements on other nodes (M,)."""
        same = copy(self)
        same.nodes = nodes
        return same

    def some(self, places: IntArray) -> "Measurements":
        """Those at some places (K,) among the M, rising."""
        if len(places) == len(self):
            return self
        split = int(np.searchsorted(places, len(self._mixtures)))
        same = copy(self)
        same.nodes = self.nodes[places]
        same._mixtures = self._mixtures.some(places[:split])
        same._bank = self._bank.some(places[split:] - len(self._mixtures))
        return same

    def windowed(self, centres: FloatArray, covariances: FloatArray) -> tuple[Windowed, IntArray]:
        """Moments under windows (M, 3) and (M, 3, 3); and for each (M,) the component that explains it best.

        That is 0 for a whole likelihood, and REJECTED where an outlier explains better.
        """
        split = len(self._mixtures)
        if split == len(self):
            return self._mixtures.windowed(centres, covariances)
        whole = self._bank.windowed(centres[split:], covariances[split:])
        told = np.where(self._bank.outlier_share(whole.log_mass) > 0.5, REJECTED, 0)
        if split == 0:
            return whole, told
        mixed, best = self._mixtures.windowed(centres[:split], covariances[:split])
        names = ("roots", "log_mass", "means", "spreads", "flat")
        return Windowed(*(np.concatenate([getattr(mixed, name), getattr(whole, name)]) for name in names)), np.append(
            best, told
        )
