"""Windowed: the moments of measurements times Gaussian windows, one window a measurement."""

from dataclasses import dataclass

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.graph.covariances import raised
from fusion.graph.inverses import inverses

_LEAST_VARIANCE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Windowed:
    """Moments of ``p_m(x) N(x; c_m, W_m)``, normalised, for M measurements.

    Coordinates u are those in which the window is the unit Gaussian, ``x = c + root u``: no unit of length or angle
    enters what is done with them.

    Parameters
    ----------
    roots : (M, 3, 3) float64
        Of the windows' covariances W.
    log_mass : (M,) float64
        ln of the mass, the evidence that the window gives to the measurement.
    means, spreads : (M, 3), (M, 3, 3) float64
        Mean and covariance of u.
    flat : (M, 3) float64
        Variances of u that a measurement saying nothing would have: 1 but for numerics.
    """

    roots: FloatArray
    log_mass: FloatArray
    means: FloatArray
    spreads: FloatArray
    flat: FloatArray

    def factors(self) -> tuple[FloatArray, FloatArray]:
        """Gaussians in place of the measurements, by precision (M, 3, 3) and information vector (M, 3) about c.

        Window times Gaussian has the mean and, where that is narrower than the window, the covariance of window times
        measurement. Where the measurement is wider than any Gaussian (two modes in the window), the precision is 0
        along that direction: it is positive semidefinite by construction.
        """
        within = inverses(raised(self.spreads, _LEAST_VARIANCE))
        precision = raised(within - _diagonal(1.0 / self.flat), 0.0)
        information = np.einsum("mij,mj->mi", precision, self.means) + self.means / self.flat
        inverse = inverses(self.roots)
        across = inverse.swapaxes(1, 2)
        return across @ precision @ inverse, np.einsum("mij,mj->mi", across, information)


def _diagonal(values: FloatArray) -> FloatArray:
    return values[:, :, None] * np.eye(3)


def roots_of(covariances: FloatArray) -> FloatArray:
    """Lower triangular roots (M, 3, 3) of covariances.

    Raises
    ------
    SkyfixError
        When one is not positive definite.
    """
    try:
        return np.asarray(np.linalg.cholesky(covariances), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise SkyfixError("windows: expected positive definite covariances, got one that is not") from error
