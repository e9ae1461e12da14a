"""How high the ground lies in a scan's frame, when nobody says: the height that most points near the vehicle have."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError

_NEAR_M = (3.0, 12.0)
_LOWEST_M, _HIGHEST_M, _CELL_M = -5.0, 1.0, 0.05
_LEAST_POINTS = 200


def estimate_ground_z(scans: Iterable[NDArray[np.float32]]) -> float:
    """Height of the ground in the frame of some scans (N, 4), metres: the median of their commonest heights.

    The lowest height with half as many points as the commonest one is taken, and the mean within 10 cm of it, so that a
    roof or a wall beside the vehicle does not stand for the road.

    Raises
    ------
    SkyfixError
        If no scan has a few hundred points 3 to 12 m away, between 5 m below the sensor and 1 m above.
    """
    found = []
    for points in scans:
        away = np.hypot(points[:, 0], points[:, 1])
        z = points[(away > _NEAR_M[0]) & (away < _NEAR_M[1]), 2].astype(np.float64)
        z = z[(z > _LOWEST_M) & (z < _HIGHEST_M)]
        if len(z) < _LEAST_POINTS:
            continue
        edges = np.arange(_LOWEST_M, _HIGHEST_M + _CELL_M, _CELL_M)
        counts = np.histogram(z, edges)[0]
        smooth = np.convolve(counts, np.ones(3), mode="same")
        lowest = int(np.argmax(smooth >= 0.5 * smooth.max()))
        peak = lowest + int(np.argmax(smooth[lowest : lowest + 5]))
        middle = edges[peak] + 0.5 * _CELL_M
        found.append(float(z[np.abs(z - middle) < 2 * _CELL_M].mean()))
    if not found:
        raise SkyfixError(
            f"ground: expected scans with at least {_LEAST_POINTS} points 3 to 12 m away to find its height in, "
            "got none; say where it is with --ground-z"
        )
    return float(np.median(found))
