"""Whether probabilities and likelihoods are true: stated chances against outcomes, credible regions against truths.

The reliability diagram and its mean gap are those of Guo et al. (ICML 2017, equations 2 to 5); the level of the
smallest highest-density region that holds the truth is uniform on [0, 1] where the density is right (the
probability-integral transform of Hyndman's highest-density regions, The American Statistician 50, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion import se2
from fusion.arrays import checked
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume


@dataclass(frozen=True, slots=True)
class Reliability:
    """Stated against found chances in bins of equal width.

    Attributes
    ----------
    stated
        (bins,) mean stated chance; NaN in an empty bin.
    found
        (bins,) share that was right; NaN in an empty bin.
    count
        (bins,) how many.
    """

    stated: NDArray[np.float64]
    found: NDArray[np.float64]
    count: NDArray[np.int64]

    @property
    def expected_calibration_error(self) -> float:
        """Mean gap between stated and found, bins weighted by their counts."""
        used = self.count > 0
        gaps = np.abs(self.stated[used] - self.found[used])
        return float(np.average(gaps, weights=self.count[used]))


def reliability(chances: ArrayLike, correct: ArrayLike, bins: int = 10) -> Reliability:
    """Compare stated chances (N,) in [0, 1] with outcomes (N,) bool.

    Raises
    ------
    SkyfixError
        If there are none, their numbers differ, a chance is out of range or there is no bin.
    """
    stated, right = np.asarray(chances, dtype=np.float64), np.asarray(correct, dtype=np.bool_)
    if stated.ndim != 1 or len(stated) == 0 or stated.shape != right.shape:
        raise SkyfixError(f"reliability: expected as many chances as outcomes, got {stated.shape} and {right.shape}")
    if not ((stated >= 0.0) & (stated <= 1.0)).all():
        raise SkyfixError(f"reliability: expected chances in [0, 1], got {stated.min():g} to {stated.max():g}")
    if bins < 1:
        raise SkyfixError(f"reliability: expected at least one bin, got {bins}")
    index = np.minimum((stated * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    divisor = np.where(count > 0, count, np.nan)
    sums = (np.bincount(index, weights=values, minlength=bins) for values in (stated, right.astype(np.float64)))
    mean_stated, mean_found = (total / divisor for total in sums)
    return Reliability(mean_stated, mean_found, count)


def expected_calibration_error(chances: ArrayLike, correct: ArrayLike, bins: int = 10) -> float:
    """Mean gap between stated and found chances; see `reliability`."""
    return reliability(chances, correct, bins).expected_calibration_error


def highest_density_level(volume: LikelihoodVolume, pose: ArrayLike) -> float:
    """The mass of the smallest region that holds a pose: 0 at the density's peak, 1 where it has none.

    The volume is taken as constant in each cell, as `LikelihoodVolume.sample` does; cells as dense as the pose's own
    count half, so that the level of a true pose is uniform on [0, 1] when the volume is right. Outside the crop, or
    where nothing was evaluated, the level is 1.

    Parameters
    ----------
    volume
        The likelihood.
    pose
        (3,) x, y, yaw.
    """
    x, y, yaw = checked("pose", pose, (3,))
    if not volume.grid.contains(np.array([x, y])):
        return 1.0
    rows, cols, bin_count = volume.log_prob.shape
    row, col = (int(v) for v in np.floor(volume.grid.pixel_from_xy(np.array([x, y]))))
    yaw_bin = round(yaw / se2.TWO_PI * bin_count) % bin_count
    density = volume.log_prob[min(row, rows - 1), min(col, cols - 1), yaw_bin]
    if density <= volume.floor:
        return 1.0
    evaluated = volume.log_prob > volume.floor
    mass = np.exp(volume.log_prob.astype(np.float64)) * volume.cell_volume
    total = mass.sum(where=evaluated)
    denser = mass.sum(where=volume.log_prob > density)
    as_dense = mass.sum(where=volume.log_prob == density)
    return float(min((denser + 0.5 * as_dense) / total, 1.0))


def region_coverage(levels: ArrayLike, nominal: Sequence[float] = (0.5, 0.9)) -> dict[float, float]:
    """The share of truths within the highest-density regions of nominal masses, from their levels (N,).

    Calibrated likelihoods have coverages equal to the masses; smaller ones mean that they are too sure.
    """
    values = np.asarray(levels, dtype=np.float64)
    if values.ndim != 1 or len(values) == 0:
        raise SkyfixError(f"coverage: expected levels (N,), at least one, got {values.shape}")
    return {mass: float((values <= mass).mean()) for mass in nominal}
