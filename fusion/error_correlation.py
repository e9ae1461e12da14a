"""How long errors repeat: correlation over distance from the residuals of a validation drive, and its length.

A network sees nearly the same scene a few metres on and repeats its error; a filter that takes the measurements for
independent becomes too sure. With rho(d) ~ exp(-d / L) known, `consistency.correlated_error_temperature` says how much
to flatten each likelihood.

False modes would hide it: one error of 20 m outweighs hundreds of 0.5 m. Each component's errors are therefore replaced
by their normal scores, the quantiles of a standard normal at their ranks (van der Waerden), after frames farther from
the median than so many robust standard deviations have been set apart. For Gaussian errors that is as good as the
ordinary autocorrelation. L is fitted by least squares to the correlations in bins of distance, weighted by the number
of pairs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.special import ndtri
from scipy.stats import rankdata

from fusion.arrays import BoolArray, FloatArray, IntArray, checked
from fusion.consistency import correlated_error_temperature
from fusion.errors import SkyfixError

_MAD_TO_SIGMA = 1.4826
_LEAST_FRAMES = 20
_LEAST_PAIRS = 20  # in a bin


@dataclass(frozen=True, slots=True, eq=False)
class ErrorCorrelation:
    """Correlation of errors by the distance between two measurements.

    Parameters
    ----------
    distance_m : (B,) float64
        Mean distance of the pairs in each bin that holds enough of them, rising.
    correlation : (B,) float64
        Of the errors of a pair, mean over the components.
    pairs : (B,) int64
        Number of pairs in each bin.
    length_m : float
        L of exp(-d / L); 0 where no correlation was found.
    set_apart : float
        Share of the frames that were taken for false modes.
    """

    distance_m: FloatArray
    correlation: FloatArray
    pairs: IntArray
    length_m: float
    set_apart: float

    def temperature(self, distance_m: float) -> float:
        """By how much to flatten likelihoods that are so far apart."""
        return correlated_error_temperature(distance_m, self.length_m)


def estimate_error_correlation(
    errors: ArrayLike,
    travelled_m: ArrayLike,
    *,
    max_distance_m: float,
    bins: int = 20,
    drives: ArrayLike | None = None,
    outlier_sigmas: float = 5.0,
) -> ErrorCorrelation:
    """Estimate how errors are correlated over distance.

    Parameters
    ----------
    errors : (N, D) array_like
        Estimate minus truth of single measurements, angles wrapped, on axes along which errors repeat: the vehicle's.
        Any units; whitened by the stated covariances or not.
    travelled_m : (N,) array_like
        Distance driven up to each measurement, not falling within a drive.
    max_distance_m : float
        Pairs farther apart are not looked at; several times the length expected.
    bins : int
        Bins of equal width up to there.
    drives : (N,) integers, optional
        Which drive each measurement belongs to; pairs are made within a drive. All in one when left out.
    outlier_sigmas : float
        Frames with a component farther from its median than this many robust standard deviations are set apart.

    Raises
    ------
    SkyfixError
        When shapes disagree, distances fall, or there are fewer than 20 frames or no bin with 20 pairs.
    """
    errors = checked("errors", errors, ("N", "D"))
    travelled = checked("travelled", travelled_m, (len(errors),))
    labels = np.zeros(len(errors), dtype=np.int64) if drives is None else np.asarray(drives)
    if labels.shape != (len(errors),):
        raise SkyfixError(f"drives: expected ({len(errors)},), got {labels.shape}")
    if not (np.isfinite(max_distance_m) and max_distance_m > 0.0):
        raise SkyfixError(f"max_distance_m: expected > 0, got {max_distance_m}")
    if bins < 1:
        raise SkyfixError(f"bins: expected >= 1, got {bins}")
    if not outlier_sigmas > 0.0:
        raise SkyfixError(f"outlier_sigmas: expected > 0, got {outlier_sigmas}")
    kept = _ordinary(errors, outlier_sigmas)
    if kept.sum() < _LEAST_FRAMES:
        raise SkyfixError(f"errors: expected at least {_LEAST_FRAMES} frames, got {int(kept.sum())}")
    scores = ndtri((rankdata(errors[kept], axis=0) - 0.5) / kept.sum())
    products, distances = _pairs(scores, travelled[kept], labels[kept], max_distance_m)
    of_bin = np.minimum((distances / max_distance_m * bins).astype(np.int64), bins - 1)
    count = np.bincount(of_bin, minlength=bins)
    enough = count >= _LEAST_PAIRS
    if not enough.any():
        raise SkyfixError(f"errors: expected a bin with {_LEAST_PAIRS} pairs, got at most {int(count.max(initial=0))}")
    variance = float((scores**2).mean())
    correlation = np.bincount(of_bin, products, bins)[enough] / count[enough] / variance
    distance = np.bincount(of_bin, distances, bins)[enough] / count[enough]
    length = fit_correlation_length(distance, correlation, count[enough])
    return ErrorCorrelation(distance, correlation, count[enough], length, 1.0 - float(kept.mean()))


def fit_correlation_length(distance_m: ArrayLike, correlation: ArrayLike, weights: ArrayLike) -> float:
    """L of the exp(-d / L) nearest to correlations (B,) at distances (B,); 0 when none at all is nearer.

    Raises
    ------
    SkyfixError
        When shapes disagree or no weight is positive.
    """
    distance = checked("distances", distance_m, ("B",))
    rho = checked("correlations", correlation, (len(distance),))
    share = checked("weights", weights, (len(distance),))
    if not (share.min(initial=0.0) >= 0.0 and share.sum() > 0.0):
        raise SkyfixError("weights: expected non-negative with a positive sum, got others")
    positive = distance[distance > 0.0]
    if len(positive) == 0:
        raise SkyfixError("distances: expected some > 0, got none")

    def misfit(log_length: float) -> float:
        return float(share @ (np.exp(-distance / np.exp(log_length)) - rho) ** 2)

    lower, upper = np.log(1e-2 * positive.min()), np.log(1e2 * positive.max())
    start = np.linspace(lower, upper, 60)
    best = int(np.argmin([misfit(value) for value in start]))
    around = (start[max(best - 1, 0)], start[min(best + 1, len(start) - 1)])
    found = float(minimize_scalar(misfit, bounds=around, method="bounded").x)
    return float(np.exp(found)) if misfit(found) < misfit(lower) else 0.0


def _ordinary(errors: FloatArray, sigmas: float) -> BoolArray:
    """Which frames (N,) are within so many robust standard deviations of the median in every component."""
    off = np.abs(errors - np.median(errors, axis=0))
    return np.asarray((off <= sigmas * _MAD_TO_SIGMA * np.median(off, axis=0)).all(axis=1))


def _pairs(
    scores: FloatArray, travelled: FloatArray, drives: FloatArray | IntArray, reach: float
) -> tuple[FloatArray, FloatArray]:
    """Mean product of the scores (P,) and distance (P,) of all pairs of one drive within reach of each other."""
    products, distances = [], []
    for drive in np.unique(drives):
        of = np.flatnonzero(drives == drive)
        along, score = travelled[of], scores[of]
        if (np.diff(along) < 0.0).any():
            raise SkyfixError("travelled: expected distances that do not fall within a drive, got a step back")
        for gap in range(1, len(of)):
            apart = along[gap:] - along[:-gap]
            near = apart <= reach
            if not near.any():
                break
            products.append((score[gap:] * score[:-gap]).mean(axis=1)[near])
            distances.append(apart[near])
    if not products:
        return np.empty(0), np.empty(0)
    return np.concatenate(products), np.concatenate(distances)
