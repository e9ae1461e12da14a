"""Expectation propagation along a window that moves: the sites that have become stale are found anew.

A site depends on the cavity of its pose, what all else says of it. A new measurement changes the cavities near it, and
ever less those before, so only those that have changed since their site was found are looked at again, the most changed
first, and no more than a given number a round. A site that was looked at again and moves by a share of the way
(damping) is taken for found under a cavity that moved by the same share, so that what is left of a large change is not
forgotten.

Source: Minka, "Expectation propagation for approximate Bayesian inference", UAI 2001.
"""

import numpy as np

from fusion.arrays import FloatArray, IntArray
from fusion.graph.lag_window import LagWindow
from fusion.graph.measurements import Measurements
from fusion.graph.sites import Sites, deviations
from fusion.graph.windowed import Windowed

_DAMPING = 0.85
_STALE = 0.05  # change of a cavity, in its standard deviations and as a share of its covariance


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
    centres, widths = window.sites(places).cavities(window.poses[places], window.covariances[places])
    stale = _change(window.centres[places], window.widths[places], centres, widths)
    chosen = np.argsort(-stale, kind="stable")[:most]
    chosen = np.sort(chosen[stale[chosen] > _STALE])
    if len(chosen) == 0:
        return window, 0
    places, centres, widths = places[chosen], centres[chosen], widths[chosen]
    fresh = Sites(centres, *seen_at(window, places, centres, widths, outlier, clutter).factors())
    off = deviations(centres, window.centres[places])
    return window.with_sites(
        places,
        window.sites(places).mixed(fresh, _DAMPING),
        window.centres[places] + _DAMPING * off,
        (1.0 - _DAMPING) * window.widths[places] + _DAMPING * widths,
    ), len(chosen)


def _change(centres: FloatArray, widths: FloatArray, new_centres: FloatArray, new_widths: FloatArray) -> FloatArray:
    """How far cavities (M, 3), (M, 3, 3) have moved, in units of the new ones."""
    inverse = np.linalg.inv(np.linalg.cholesky(new_widths))
    off = np.einsum("mij,mj->mi", inverse, deviations(new_centres, centres))
    shape = inverse @ widths @ inverse.swapaxes(1, 2) - np.eye(3)
    return np.asarray(np.maximum(np.abs(off).max(axis=1), np.abs(shape).max(axis=(1, 2))))
