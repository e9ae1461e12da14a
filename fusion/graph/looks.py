"""Which measurements a round of expectation propagation looks at again.

The factor that stands for a measurement depends on the cavity under which it was found: for a Gaussian not at all, for
others a little. At every look but the first, what the last factor forecasts under the new cavity is held against what
is found there: an error e, after a move d of the cavity. A move d' since then makes an error of about ``e d' / d``, and
moves shrink from round to round. Where that is next to nothing, the factor stays as it is.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001 (factors may be found anew in any
order).
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, IntArray
from fusion.graph.chain_algebra import OPTIONS, invert, wrap
from fusion.graph.measurements import Measurements
from fusion.graph.sites import Sites, no_sites
from fusion.graph.windowed import Windowed

_DAMPING = 0.85  # share of the way that a factor goes to the one that is found anew
_TOLERANCE = 1e-3
_FARTHEST = 0.5
_UNKNOWN = 1e9


class Looks:
    """M measurements, the factors that stand for them, and when they were last looked at.

    Moves of cavities and errors of forecasts are in standard deviations, those of covariances in shares of them.

    Parameters
    ----------
    measurements : Measurements
        What is looked at.
    centres : (M, 3) float64
        Where the poses start.

    Attributes
    ----------
    sites : Sites
        The factors at present; without effect before the first look.
    chosen : (M,) int64
        See `Measurements.windowed`.
    """

    def __init__(self, measurements: Measurements, centres: FloatArray) -> None:
        count = len(measurements)
        self.sites = no_sites(centres)
        self.chosen: IntArray = np.zeros(count, dtype=np.int64)
        self._measurements, self._looks = measurements, 0
        self._centres, self._windows = centres.copy(), np.tile(np.eye(3), (count, 1, 1))  # at the last looks
        self._roots, self._log_mass = self._windows.copy(), np.zeros(count)
        self._errors, self._slopes = np.full(count, _UNKNOWN), np.full(count, _UNKNOWN)

    def renew(self, centres: FloatArray, windows: FloatArray) -> None:
        """Find the factors anew that cavities (M, 3) and (M, 3, 3) are expected to change."""
        moves = np.empty(len(centres))
        _measure_moves(self._centres, self._roots, centres, windows, moves)
        left = (1.0 - _DAMPING) * self._errors + self._slopes * moves
        places = np.flatnonzero(~((left <= _TOLERANCE) & (moves <= _FARTHEST)))  # NaN too, which the step refuses
        if len(places) == 0:
            return
        centres, windows = np.ascontiguousarray(centres[places]), np.ascontiguousarray(windows[places])
        found = self._look(places, centres, windows)
        before = self.sites.at(places)
        if self._looks > 1:
            about = before.about(centres)
            errors = np.empty(len(places))
            _measure_errors(found.roots, found.means, found.spreads, about.precision, about.information, errors)
            self._errors[places] = errors
            self._slopes[places] = errors / np.maximum(moves[places], 1.0 / _UNKNOWN)
        fresh = Sites(centres, *found.factors())
        self.sites = self.sites.with_others(places, before.mixed(fresh, _DAMPING if self._looks > 1 else 1.0))

    def look(self, centres: FloatArray, windows: FloatArray) -> None:
        """Look at all measurements under these cavities, the factors as they are."""
        self._look(np.arange(len(centres)), centres, windows)

    def log_evidence(self) -> float:
        """ln of the measurements' masses over those of the factors, under the cavities of the last looks.

        Measurement times cavity and factor times cavity have the same moments, so that a cavity's move changes the
        ratio to second order only.
        """
        return float((self._log_mass - self.sites.log_integrals(self._centres, self._windows)).sum())

    def _look(self, places: IntArray, centres: FloatArray, windows: FloatArray) -> Windowed:
        found, self.chosen[places] = self._measurements.some(places).windowed(centres, windows)
        self._centres[places], self._windows[places], self._roots[places] = centres, windows, found.roots
        self._log_mass[places] = found.log_mass
        self._looks += 1
        return found


@numba.njit(**OPTIONS)
def _measure_moves(
    before: NDArray[np.float64],
    roots: NDArray[np.float64],
    centres: NDArray[np.float64],
    windows: NDArray[np.float64],
    moves: NDArray[np.float64],
) -> None:
    """How far Gaussians are from those with centres `before` and roots, the more of mean and covariance."""
    inverse, off = np.empty((3, 3)), np.empty(3)
    for m in range(len(centres)):
        invert(roots[m], inverse)
        for i in range(3):
            off[i] = centres[m, i] - before[m, i]
        off[2] = wrap(off[2])
        square, shape = 0.0, 0.0
        for i in range(3):
            moved = inverse[i, 0] * off[0] + inverse[i, 1] * off[1] + inverse[i, 2] * off[2]
            square += moved * moved
            for j in range(3):
                share = 0.0
                for a in range(3):
                    for b in range(3):
                        share += inverse[i, a] * windows[m, a, b] * inverse[j, b]
                shape = max(shape, abs(share - (1.0 if i == j else 0.0)))
        moves[m] = max(np.sqrt(square), shape)


@numba.njit(**OPTIONS)
def _measure_errors(
    roots: NDArray[np.float64],
    means: NDArray[np.float64],
    spreads: NDArray[np.float64],
    precisions: NDArray[np.float64],
    informations: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> None:
    """How far the moments that factors forecast are from those that were found, the more of mean and covariance.

    With the factor's precision A and information b in whitened coordinates it forecasts ``(1 + A)^-1 b`` and
    ``(1 + A)^-1``.
    """
    total, spread, off = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for m in range(len(roots)):
        root = roots[m]
        for i in range(3):
            off[i] = 0.0
            for a in range(3):
                off[i] -= root[a, i] * informations[m, a]
            for j in range(3):
                total[i, j] = 1.0 if i == j else 0.0
                for a in range(3):
                    for b in range(3):
                        total[i, j] += root[a, i] * precisions[m, a, b] * root[b, j]
                off[i] += total[i, j] * means[m, j]
        invert(total, spread)
        square, shape = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                square += off[i] * spread[i, j] * off[j]
                share = total[i, 0] * spreads[m, 0, j] + total[i, 1] * spreads[m, 1, j] + total[i, 2] * spreads[m, 2, j]
                shape = max(shape, abs(share - (1.0 if i == j else 0.0)))
        errors[m] = max(np.sqrt(max(square, 0.0)), shape)
