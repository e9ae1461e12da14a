"""How much of a filter's error is still that of its last measurement, and by how much to flatten the next one for it.

A network repeats its error over the next metres. Let measurement errors have the variance R and be correlated from one
to the next by rho, and a filter with gain K take a measurement for one of variance T R. Its claim and the true variance
of its error follow

    claimed   (1 - K)^2 P + K^2 T R
    true      (1 - K)^2 P + K^2 R + 2 (1 - K) K rho s R        s' = (1 - K) rho s + K

where P is the variance of the prediction, K = P / (P + T R), and s R the covariance of the filter's error with the last
measurement's. They agree for ``T = 1 / (1 - 2 rho s R / P)``, whatever the steps before: regular or not, at the start
or later. In the steady state that is ``(1 + a rho) / (1 - a rho)`` with a = 1 - K, the share of the prediction that a
measurement leaves; a filter of small gain, which averages over far more than the errors' length, has a = 1 and the
well-known ``(1 + rho) / (1 - rho)`` (`consistency.correlated_error_temperature`). Taken for every filter, that one is
too cautious: one that forgets by itself, because the odometry drifts, is no longer harmed by an error that it has
forgotten.

R / P is read off what the last measurements did to the filter's covariance, averaged over directions, and scaled by
the volume of the covariance since. So any filter and any likelihood will do, and no Gaussian is asked for.

A smoother looks ahead as far as back, and more of its errors are shared: `smoothing_temperature`.

Source: the covariance of a linear filter with a wrong gain, e.g. Gelb, "Applied Optimal Estimation", 1974, 7.2, with a
first-order autoregression for the measurement errors.
"""

from dataclasses import dataclass
from math import exp, log, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from fusion.arrays import FloatArray, checked
from fusion.consistency import MAX_TEMPERATURE
from fusion.errors import SkyfixError
from fusion.likelihood import checked_temperature

_NEWEST = 0.2  # weight of the last measurement in the average of ln R, when it has changed much
_TELLING_GAIN = 0.02  # a smaller one says little of R
_LEAST_GAIN, _GREATEST_GAIN = 1e-3, 0.999
_MOST_OF_BOUND = 3.0  # T at most, in units of (1 + rho) / (1 - rho): more is next to nothing, or noise in R / P
_GREATEST_LOG = 50.0


@dataclass(frozen=True, slots=True)
class ErrorMemory:
    """What there is to know; as it is made, nothing has been measured yet.

    Parameters
    ----------
    shared : float
        s: covariance of the filter's error with the last measurement's, over R.
    log_variance : float or None
        ln R, in the units of the D-th root of the determinant of the filter's covariance; None before the first
        measurement.
    """

    shared: float = 0.0
    log_variance: float | None = None

    def temperature(self, correlation: float, before: ArrayLike) -> float:
        """By how much to flatten a measurement whose error has this correlation with that of the last one.

        Parameters
        ----------
        correlation : float
            rho in [0, 1]; ``exp(-distance / length)`` for one that falls off with the distance driven.
        before : (D, D) array_like
            The filter's covariance before the measurement.

        Returns
        -------
        float
            T in [1, 1000].

        Raises
        ------
        SkyfixError
            When the correlation is out of range or the covariance not positive definite.
        """
        if not 0.0 <= correlation <= 1.0:
            raise SkyfixError(f"correlation: expected in [0, 1], got {correlation}")
        if self.log_variance is None or correlation == 0.0:
            return 1.0
        ratio = exp(min(self.log_variance - _log_size(_root(before)), _GREATEST_LOG))
        least = (1.0 - correlation) / (1.0 + correlation) / _MOST_OF_BOUND
        return 1.0 / max(1.0 - 2.0 * correlation * self.shared * ratio, least, 1.0 / MAX_TEMPERATURE)

    def after(self, correlation: float, temperature: float, before: ArrayLike, after: ArrayLike) -> "ErrorMemory":
        """What is known after a measurement.

        Parameters
        ----------
        correlation, temperature : float
            Of the measurement: rho, and T as it was used.
        before, after : (D, D) array_like
            The filter's covariances before and after it.

        Raises
        ------
        SkyfixError
            When shapes disagree, `before` is not positive definite, or the temperature not positive.
        """
        root = _root(before)
        covariance = checked("covariance after", after, root.shape)
        left = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, covariance).T))
        gain = float(np.clip(1.0 - left.mean(), _LEAST_GAIN, _GREATEST_GAIN))
        log_variance = log((1.0 - gain) / (gain * checked_temperature(temperature))) + _log_size(root)
        if self.log_variance is not None:
            weight = _NEWEST * gain / (gain + _TELLING_GAIN)
            log_variance = self.log_variance + weight * (log_variance - self.log_variance)
        return ErrorMemory((1.0 - gain) * correlation * self.shared + gain, log_variance)


def smoothing_temperature(correlation: float, temperature: float) -> float:
    """By how much to flatten a measurement for a smoother, when a filter of the same odometry flattens it by so much.

    In the steady state the weights of a filter's measurements fall off as a^n into the past, a smoother's as a^|n| to
    both sides. It claims its true variance if

        T_s = sum_nm a^|n| a^|m| rho^|n - m| / sum_n a^2|n| = (1 + b) / (1 - b) + 2 c b / (1 - b)^2

    with b = a rho and c = (1 - a^2) / (1 + a^2), where a is that of its own gain: ``(1 - a)^2 / a`` is the drift over
    T_s R, and a filter's (1 + b) / (1 - b) tells the drift over R. Between T and (1 + rho) / (1 - rho), or T itself
    when that is more.

    Parameters
    ----------
    correlation : float
        rho in [0, 1] of the measurement's error with that of the last one.
    temperature : float
        What `ErrorMemory.temperature` says, at least 1.

    Raises
    ------
    SkyfixError
        When the correlation or the temperature is out of range.
    """
    if not 0.0 <= correlation <= 1.0:
        raise SkyfixError(f"correlation: expected in [0, 1], got {correlation}")
    if not temperature >= 1.0:
        raise SkyfixError(f"temperature: expected at least 1, got {temperature}")
    largest = (1.0 + correlation) / max(1.0 - correlation, 1.0 / MAX_TEMPERATURE)
    if temperature == 1.0 or temperature >= largest:
        return temperature
    left = (temperature - 1.0) / (temperature + 1.0) / correlation
    drift = temperature * (1.0 - left) ** 2 / left

    def too_warm(candidate: float) -> float:
        per_noise = drift / candidate
        a = 1.0 - 0.5 * (sqrt(per_noise * (per_noise + 4.0)) - per_noise)
        b, c = a * correlation, (1.0 - a * a) / (1.0 + a * a)
        return candidate - (1.0 + b) / (1.0 - b) - 2.0 * c * b / (1.0 - b) ** 2

    return float(brentq(too_warm, temperature, largest)) if too_warm(largest) > 0.0 else largest


def _root(covariance: ArrayLike) -> FloatArray:
    try:
        return np.asarray(np.linalg.cholesky(checked("covariance before", covariance, ("D", "D"))), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise SkyfixError("covariance before: expected square and positive definite, got one that is not") from error


def _log_size(root: FloatArray) -> float:
    """ln of the D-th root of the determinant of ``root root^T``."""
    return 2.0 * float(np.log(np.diag(root)).mean())
