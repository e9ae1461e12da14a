"""Satellite images of KITTI + aerial: zoom 18, scale 2 of a Web Mercator tile service, north up, centred at a fix."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from fusion.grid import MapGrid
from learned.map_raster import MapRaster
from sequences.picture import read_photograph

METRES_PER_PIXEL = 156543.03392 * math.cos(math.radians(49.015)) / 2**18 / 2
"""At the latitude that the protocol takes for all of KITTI: 0.1958 m."""


def read_satellite_image(path: Path) -> MapRaster:
    """A picture without classes, its origin in the middle; `SkyfixError` when it cannot be read."""
    picture = read_photograph(path)
    rows, cols = picture.shape[:2]
    corner = -0.5 * METRES_PER_PIXEL * np.array([cols, rows])
    return MapRaster(MapGrid(rows, cols, METRES_PER_PIXEL, float(corner[0]), float(corner[1])), None, picture)
