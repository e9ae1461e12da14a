"""Expectation propagation along a window that moves: the sites that have become stale are found anew.

A site depends on the cavity of its pose, what all else says of it. A new measurement changes the cavities near it, and
ever less those before, so only those that have changed since their site was found are looked at again, the most changed
first, and no more than a given number a round. A site that was looked at again and moves by a share of the way
(damping) is taken for found under a cavity that moved by the same share, so that what is left of a large change is not
forgotten.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray, IntArray
from fusion.graph.chain_algebra import OPTIONS, invert, product, wrap
from fusion.graph.lag_window import LagWindow
from fusion.graph.measurements import Measurements
from fusion.graph.sites import Sites, deviations
from fusion.graph.windowed import Windowed

_DAMPING = 0.85
_LEAST_DETERMINANT = 1e-9
_STALE = 0.1  # change of a cavity, in its standard deviations and as a share of its covariance


def seen_at(
    window: LagWindow, places: IntArray, centres: FloatArray, widths: FloatArray, outlier: float, clutter: float
) -> Windowed:
    """Moments of the measurements at places (M,) under cavities (M, 3) and (M, 3, 3), in the order of the places."""
    measurements = Measurements([window.measurements[k] for k in places.tolist()], outlier, clutter)
    order = measurements.nodes
    found, _ = measurements.windowed(centres[order], widths[order])
    back = np.argsort(order)
    names = ("roots", "log_mass", "means", "spreads", "flat")
    return Windowed(*(getattr(found, name)[back] for name in names))


def refreshed(window: LagWindow, most: int, outlier: float, clutter: float) -> tuple[LagWindow, int]:
    """A window with at most `most` stale sites found anew, and how many they were."""
    places = window.measured
    stale = np.empty(len(places))
    _staleness(
        places,
        window.poses,
        window.covariances,
        window.references,
        window.precisions,
        window.informations,
        window.centres,
        window.widths,
        stale,
    )
    chosen = np.argsort(-stale, kind="stable")[:most]
    chosen = np.sort(chosen[stale[chosen] > _STALE])
    if len(chosen) == 0:
        return window, 0
    places = places[chosen]
    centres, widths = window.sites(places).cavities(window.poses[places], window.covariances[places])
    fresh = Sites(centres, *seen_at(window, places, centres, widths, outlier, clutter).factors())
    off = deviations(centres, window.centres[places])
    return window.with_sites(
        places,
        window.sites(places).mixed(fresh, _DAMPING),
        window.centres[places] + _DAMPING * off,
        (1.0 - _DAMPING) * window.widths[places] + _DAMPING * widths,
    ), len(chosen)


@numba.njit(**OPTIONS)
def _staleness(
    places: NDArray[np.int64],
    poses: NDArray[np.float64],
    covariances: NDArray[np.float64],
    references: NDArray[np.float64],
    precisions: NDArray[np.float64],
    informations: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    stale: NDArray[np.float64],
) -> None:
    """How far the cavities at places have moved, in units of themselves; infinity where that cannot be told cheaply."""
    rest, shrunk, cavity, inverse = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    vector, off = np.empty(3), np.empty(3)
    for m in range(len(places)):
        k = places[m]
        product(covariances[k], precisions[k], rest)
        for i in range(3):
            for j in range(3):
                rest[i, j] = (1.0 if i == j else 0.0) - rest[i, j]
        if not np.linalg.det(rest) > _LEAST_DETERMINANT:
            stale[m] = np.inf
            continue
        invert(rest, shrunk)
        product(shrunk, covariances[k], cavity)
        invert(cavity, inverse)
        for i in range(3):
            off[i] = references[k, i] - poses[k, i]
        off[2] = wrap(off[2])
        for i in range(3):
            vector[i] = informations[k, i]
            for j in range(3):
                vector[i] += precisions[k, i, j] * off[j]
        for i in range(3):
            off[i] = poses[k, i] - centres[k, i]
            for j in range(3):
                off[i] -= cavity[i, j] * vector[j]
        off[2] = wrap(off[2])
        moved, shape = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                moved += off[i] * inverse[i, j] * off[j]
                scale = np.sqrt(abs(cavity[i, i] * cavity[j, j]))
                shape = max(shape, abs(cavity[i, j] - widths[k, i, j]) / scale)
        stale[m] = max(np.sqrt(max(moved, 0.0)), shape)
