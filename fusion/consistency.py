"""Is the stated uncertainty the real one? NEES, NIS and coverage, and the temperature for errors correlated in time.

Source of NEES and NIS: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
section 5.4.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from fusion.arrays import FloatArray, checked
from fusion.errors import SkyfixError

MAX_TEMPERATURE = 1e3


def correlated_error_temperature(distance_m: float, correlation_length_m: float) -> float:
    """By how much to flatten a likelihood whose error the previous measurement shared.

    The network sees nearly the same scene `distance_m` later and repeats its error. If errors are a first-order
    autoregression with ``rho = exp(-distance / length)``, then n measurements are worth ``n (1 - rho) / (1 + rho)``
    independent ones, so each likelihood is to be raised to the power 1 / T with ``T = (1 + rho) / (1 - rho)``.
    The first measurement of a drive has no predecessor and counts in full. This is for filters of small gain, that
    average over far more than the length; for others it is too cautious, and `error_memory.ErrorMemory` is exact.

    Parameters
    ----------
    distance_m : float
        Distance driven since the previous measurement, >= 0.
    correlation_length_m : float
        Distance over which the correlation falls to 1/e; 0 for independent errors.

    Returns
    -------
    float
        T in [1, 1000]; at no distance the limit, infinity, is cut to 1000.

    Raises
    ------
    SkyfixError
        When an argument is negative or not finite.
    """
    for name, value in (("distance_m", distance_m), ("correlation_length_m", correlation_length_m)):
        if not (np.isfinite(value) and value >= 0.0):
            raise SkyfixError(f"{name}: expected >= 0, got {value}")
    if correlation_length_m == 0.0:
        return 1.0
    half = 0.5 * distance_m / correlation_length_m
    return float(1.0 / max(np.tanh(half), 1.0 / MAX_TEMPERATURE))  # (1 + rho) / (1 - rho) = coth(d / 2L)


def error_correlation(distance_m: float, correlation_length_m: float) -> float:
    """Correlation ``exp(-distance / length)`` of two measurements' errors; 0 for a length of 0.

    Raises
    ------
    SkyfixError
        When an argument is negative or not a number.
    """
    for name, value in (("distance_m", distance_m), ("correlation_length_m", correlation_length_m)):
        if not value >= 0.0:
            raise SkyfixError(f"{name}: expected >= 0, got {value}")
    return float(np.exp(-distance_m / correlation_length_m)) if correlation_length_m > 0.0 else 0.0


def nees(errors: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """Normalised estimation error squared, ``e^T P^-1 e`` (N,); its mean is D when the covariances are right.

    Parameters
    ----------
    errors : (N, D) array_like
        Estimate minus truth, angles wrapped, in the frame of the covariances.
    covariances : (N, D, D) array_like
        Positive definite.

    Raises
    ------
    SkyfixError
        When shapes disagree or a covariance is not positive definite.
    """
    errors = checked("errors", errors, ("N", "D"))
    count, dof = errors.shape
    covariances = checked("covariances", covariances, (count, dof, dof))
    try:
        root = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError as error:
        raise SkyfixError("covariances: expected positive definite, got one that is not") from error
    white = np.linalg.solve(root, errors[..., None])[..., 0]
    return (white**2).sum(axis=1)


def nis(innovations: ArrayLike, predicted: ArrayLike, measured: ArrayLike) -> FloatArray:
    """Normalised innovation squared, ``v^T (P + R)^-1 v`` (N,): NEES without ground truth.

    Parameters
    ----------
    innovations : (N, D) array_like
        Measurement minus prediction, angles wrapped; of a multimodal likelihood, its mode nearest to the prediction.
    predicted : (N, D, D) array_like
        Covariances P of the prediction, before the update.
    measured : (N, D, D) array_like
        Covariances R of the measurement, in the same frame.

    Raises
    ------
    SkyfixError
        When shapes disagree or a sum is not positive definite.
    """
    innovations = checked("innovations", innovations, ("N", "D"))
    count, dof = innovations.shape
    total = checked("predicted", predicted, (count, dof, dof)) + checked("measured", measured, (count, dof, dof))
    return nees(innovations, total)


def mean_nees_bounds(count: int, dof: int, level: float = 0.95, correlation: float = 0.0) -> tuple[float, float]:
    """Interval that the mean of `count` NEES (or NIS) values falls in with probability `level` when all is right.

    Divided by `dof`, these are the bounds of the average NEES per degree of freedom (ANEES).

    Parameters
    ----------
    count : int
        Number of values averaged.
    dof : int
        Dimensions of an error.
    level : float
        Probability, in (0, 1).
    correlation : float
        Of an error with the next one, in [0, 1); a filter's errors are correlated. Squares of a first-order
        autoregression have the correlation ``rho^2``, so the values are worth ``n (1 - rho^2) / (1 + rho^2)``.

    Raises
    ------
    SkyfixError
        When an argument is out of range.
    """
    if count < 1 or dof < 1:
        raise SkyfixError(f"NEES bounds: expected count >= 1 and dof >= 1, got {count} and {dof}")
    if not (0.0 < level < 1.0 and 0.0 <= correlation < 1.0):
        raise SkyfixError(f"NEES bounds: expected level in (0, 1), correlation in [0, 1), got {level}, {correlation}")
    worth = count * (1.0 - correlation**2) / (1.0 + correlation**2)
    low, high = chi2.ppf([0.5 - 0.5 * level, 0.5 + 0.5 * level], worth * dof) / worth
    return float(low), float(high)


def coverage(nees_values: ArrayLike, dof: int, level: float = 0.95) -> float:
    """Fraction of NEES values inside the `level` ellipsoid of `dof` dimensions; `level` when all is right.

    Raises
    ------
    SkyfixError
        When there are no values, or `level` is not in (0, 1).
    """
    values = checked("nees", nees_values, ("N",))
    if len(values) == 0 or not 0.0 < level < 1.0:
        raise SkyfixError(f"coverage: expected values and a level in (0, 1), got {len(values)} values, level {level}")
    return float((values <= chi2.ppf(level, dof)).mean())
