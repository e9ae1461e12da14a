"""Painting of metric shapes into rasters with sub-pixel accuracy: the only place where map metres meet OpenCV's
pixels.

OpenCV puts pixel centres at integers, the project at +0.5 (`fusion.grid`); the shift is taken out here. Coordinates
are passed in fixed point with `SHIFT` fractional bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid

SHIFT = 4
_SCALE = 1 << SHIFT
_LIMIT = 1 << 26

Raster = NDArray[Any]


def fixed_point(grid: MapGrid, xy: NDArray[np.float64]) -> NDArray[np.int32]:
    """Map-frame points (N, 2) as OpenCV (column, row) in fixed point, shape (N, 1, 2)."""
    origin, per_metre = _fixed_point_map(grid)
    return np.rint(xy.reshape(-1, 1, 2) * per_metre + origin).clip(-_LIMIT, _LIMIT).astype(np.int32)


@lru_cache(maxsize=64)
def _fixed_point_map(grid: MapGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where (0, 0) lies in fixed point (column, row), and fixed-point units per metre of x and y, both (2,)."""
    zero, one = ((grid.pixel_from_xy((value, value)) - 0.5)[::-1] * _SCALE for value in (0.0, 1.0))
    return zero, one - zero


def fill(raster: Raster, grid: MapGrid, rings: Sequence[NDArray[np.float64]], value: float) -> None:
    """Fill one polygon; further rings are holes (even-odd rule)."""
    cv2.fillPoly(raster, [fixed_point(grid, ring) for ring in rings], float(value), shift=SHIFT)


def stroke(raster: Raster, grid: MapGrid, xy: NDArray[np.float64], value: float, width_m: float = 0.0) -> None:
    """Draw a polyline (N, 2); width 0 is a line of one pixel.

    OpenCV's lines are two pixels wider than their thickness, but for thickness 1.
    """
    pixels = width_m / grid.metres_per_pixel
    thickness = 1 if pixels < 2.5 else max(2, round(pixels) - 2)
    cv2.polylines(raster, [fixed_point(grid, xy)], False, float(value), thickness=thickness, shift=SHIFT)


def disc(raster: Raster, grid: MapGrid, xy: NDArray[np.float64], radius_m: float, value: float) -> None:
    """Fill a circle about one point (2,); at least the pixel that it is in."""
    centre = fixed_point(grid, xy)[0, 0]
    radius = round(radius_m / grid.metres_per_pixel * _SCALE)
    cv2.circle(raster, (int(centre[0]), int(centre[1])), radius, float(value), thickness=-1, shift=SHIFT)


def box_corners(pose: NDArray[np.float64], length_m: float, width_m: float) -> NDArray[np.float64]:
    """Corners (4, 2) of a rectangle centred on `pose` (x, y, yaw), its length along yaw."""
    half = 0.5 * np.array([[length_m, width_m], [-length_m, width_m], [-length_m, -width_m], [length_m, -width_m]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + half @ np.array([[cos, sin], [-sin, cos]])
