"""KeptSites: measurements by the keys of their poses, each with the Gaussian factor that stands for it at present.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.arrays import FloatArray
from fusion.graph.lag_window import KeptMeasurement
from fusion.graph.measurements import Measurements
from fusion.graph.sites import Sites, deviations

_DAMPING = 0.85
_STALE = 0.1  # change of a cavity, in its standard deviations and as a share of its covariance


@dataclass(frozen=True, slots=True, eq=False)
class KeptSite:
    """A measurement, its one site, and the cavity (3,), (3, 3) under which that was found."""

    measurement: KeptMeasurement
    site: Sites
    centre: FloatArray
    width: FloatArray

    def factor(self, key: int) -> gtsam.NonlinearFactor:
        """The site as a factor that GTSAM re-linearises by itself."""
        [precision], [information] = self.site.on_body_axes()
        at = gtsam.Values()
        at.insert(key, gtsam.Pose2(*self.site.reference[0]))
        return gtsam.LinearContainerFactor(gtsam.HessianFactor(key, precision, information, 0.0), at)


class KeptSites:
    """Sites by keys.

    Parameters
    ----------
    outlier_probability, clutter_log_density : float
        As in `Measurements`.
    """

    def __init__(self, outlier_probability: float, clutter_log_density: float) -> None:
        self._outliers = outlier_probability, clutter_log_density
        self._kept: dict[int, KeptSite] = {}

    def __contains__(self, key: int) -> bool:
        return key in self._kept

    def among(self, keys: Iterable[int]) -> list[int]:
        """Those of some keys that have a measurement, in their order."""
        return [key for key in keys if key in self._kept]

    def update(self, sites: Mapping[int, KeptSite]) -> None:
        """Take sites, new or in place of what they were."""
        self._kept.update(sites)

    def first(self, measurement: KeptMeasurement, centre: FloatArray, width: FloatArray) -> tuple[KeptSite, float]:
        """The site of a new measurement under the prediction (3,), (3, 3), and its ln evidence."""
        sites, log_masses = self._found([measurement], centre[None], width[None])
        return KeptSite(measurement, sites, centre, width), float(log_masses[0])

    def stale(self, keys: Sequence[int], poses: FloatArray, covariances: FloatArray) -> dict[int, KeptSite]:
        """New sites for those of some measurements whose cavities have moved since theirs were found.

        Parameters
        ----------
        keys : sequence of M int
            That have measurements.
        poses, covariances : (M, 3), (M, 3, 3) float64
            Marginals at present, on the axes of the map.
        """
        ones = [self._kept[key] for key in keys]
        sites = _together([one.site for one in ones])
        centres, widths = sites.cavities(poses, covariances)
        before = np.array([one.centre for one in ones]), np.array([one.width for one in ones])
        off = deviations(centres, before[0])
        moved = np.sqrt(np.einsum("mi,mij,mj->m", off, np.linalg.inv(widths), off))
        sigma = np.sqrt(np.diagonal(widths, axis1=1, axis2=2))
        reshaped = np.abs((widths - before[1]) / (sigma[:, :, None] * sigma[:, None, :])).max(axis=(1, 2))
        chosen = np.flatnonzero(np.maximum(moved, reshaped) > _STALE)
        if len(chosen) == 0:
            return {}
        fresh, _ = self._found([ones[k].measurement for k in chosen], centres[chosen], widths[chosen])
        mixed = sites.at(chosen).mixed(fresh, _DAMPING)
        return {
            keys[k]: KeptSite(
                ones[k].measurement,
                mixed.at(np.array([m])),
                before[0][k] + _DAMPING * off[k],
                (1.0 - _DAMPING) * before[1][k] + _DAMPING * widths[k],
            )
            for m, k in enumerate(chosen.tolist())
        }

    def _found(
        self, measurements: list[KeptMeasurement], centres: FloatArray, widths: FloatArray
    ) -> tuple[Sites, FloatArray]:
        """Sites under cavities (M, 3) and (M, 3, 3), and the ln of the measurements' means under these (M,)."""
        seen = Measurements(measurements, *self._outliers)
        order = seen.nodes
        found, _ = seen.windowed(centres[order], widths[order])
        back = np.argsort(order)
        return Sites(centres[order], *found.factors()).at(back), found.log_mass[back]


def _together(sites: Sequence[Sites]) -> Sites:
    names = ("reference", "precision", "information")
    return Sites(*(np.concatenate([getattr(part, name) for part in sites]) for name in names))
