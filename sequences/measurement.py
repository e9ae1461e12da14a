"""One scan matched with the map, and what is kept of it: tens of megabytes become a few kilobytes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion import se2
from fusion.arrays import Float32Array, FloatArray
from fusion.estimate import Estimate
from fusion.graph.patch import LikelihoodPatch, Neighbourhood, patch_of
from fusion.likelihood import LikelihoodVolume
from fusion.two_level import TwoLevelLikelihood
from learned.matcher import SearchRegion

_NEIGHBOURS = np.array([-1, 0, 1])
_PATCH_SIGMAS, _PATCH_MARGIN_M, _PATCH_MARGIN_RAD = 4.0, 6.0, np.deg2rad(6.0)


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
        As the matcher gave it: a volume about a prediction, or two levels over a whole map.
    temperature
        By which the filter and the smoother flatten it, for errors shared with the measurement before.
    """

    points: Float32Array
    search: SearchRegion
    likelihood: LikelihoodVolume | TwoLevelLikelihood
    temperature: float

    def patch(self, estimate: Estimate) -> LikelihoodPatch:
        """The likelihood around the filter's estimate, flattened by the temperature, for the smoother."""
        sigma = _PATCH_SIGMAS * np.sqrt(np.diag(estimate.covariance))
        half_extent_m = _PATCH_MARGIN_M + float(sigma[:2].max())
        half_heading_rad = min(_PATCH_MARGIN_RAD + float(sigma[2]), np.pi)
        around = Neighbourhood(estimate.pose, half_extent_m, half_heading_rad)
        return patch_of(self.likelihood.tempered(self.temperature), around)

    def best_pose(self) -> FloatArray:
        """The matcher's own answer, see `best_pose`; over a whole map, the mean of the heaviest mode."""
        if isinstance(self.likelihood, TwoLevelLikelihood):
            return self.likelihood.modes(1).means[0]
        return best_pose(self.likelihood)

    def heat(self) -> Float32Array:
        """(rows, cols) ln density, the highest over the headings, on the cells of the likelihood's grid."""
        if isinstance(self.likelihood, TwoLevelLikelihood):
            return self.likelihood.coarse.max(axis=2)
        return self.likelihood.log_prob.max(axis=2)


def best_pose(volume: LikelihoodVolume) -> FloatArray:
    """The best pose (3,) of a likelihood: the highest cell, refined below the cell by the mean over its neighbours."""
    rows, cols, bins = volume.log_prob.shape
    row, col, yaw_bin = np.unravel_index(int(np.argmax(volume.log_prob)), volume.log_prob.shape)
    near_rows = np.clip(row + _NEIGHBOURS, 0, rows - 1)
    near_cols = np.clip(col + _NEIGHBOURS, 0, cols - 1)
    near_bins = yaw_bin + _NEIGHBOURS
    mass = np.exp(volume.log_prob[np.ix_(near_rows, near_cols, near_bins % bins)] - volume.log_prob.max())
    grid_rows, grid_cols, grid_bins = np.meshgrid(near_rows + 0.5, near_cols + 0.5, near_bins, indexing="ij")
    centre = [float(np.average(values, weights=mass)) for values in (grid_rows, grid_cols, grid_bins)]
    return np.array([*volume.grid.xy_from_pixel(centre[:2]), se2.wrap(centre[2] * se2.TWO_PI / bins)])
