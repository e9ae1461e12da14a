"""Bird's-eye views of LiDAR scans: point counts a cell and height band, above a locally estimated ground.

The image has the map's convention with the vehicle at its centre: body x along +columns, body y against rows, so that
a vehicle of heading zero needs no rotation to lie on the map. Heights are measured above a ground surface that may
slope: on real roads a plane through the sensor's foot turns a hill into a wall. The band between 0.3 m and 1 m
(parked cars, kerbs, grass) is left out, because it is on no map and is what simulations get wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError

Float32Array = NDArray[np.float32]

BANDS_M: tuple[tuple[float, float], ...] = ((-0.3, 0.3), (1.0, 2.0), (2.0, 3.5), (3.5, 12.0))
"""Height bands above the ground, metres: ground, body height, above cars, facades."""
GROUND, BODY, HIGH, FACADE = range(len(BANDS_M))
GroundModel = Literal["surface", "plane"]
"""What heights are above: a ground estimated from the scan, which may slope, or the plane through the sensor's foot."""

_GROUND_CELL_M = 1.0
_GROUND_SLOPE = 0.15
_UNKNOWN_Z = np.float32(1e3)


@dataclass(frozen=True, slots=True)
class BevSettings:
    """Extent and resolution of a bird's-eye view, a square of `size` pixels about the vehicle, and its ground."""

    half_extent_m: float = 40.0
    metres_per_pixel: float = 0.5
    ground: GroundModel = "surface"

    def __post_init__(self) -> None:
        if self.ground not in get_args(GroundModel):
            expected = " or ".join(get_args(GroundModel))
            raise SkyfixError(f"bird's-eye view: expected a ground of {expected}, got {self.ground!r}")
        if not 0.0 < self.metres_per_pixel <= self.half_extent_m < math.inf:
            raise SkyfixError(
                f"bird's-eye view: expected a half_extent_m of at least a pixel, got {self.half_extent_m} m with "
                f"{self.metres_per_pixel} m a pixel"
            )

    @property
    def size(self) -> int:
        """Number of rows and of columns; even, the vehicle stands on the corner of the four middle pixels."""
        return 2 * round(self.half_extent_m / self.metres_per_pixel)


def check_scan(points: NDArray[np.floating]) -> None:
    """Raise SkyfixError unless a scan is (N, >= 3), not empty and finite."""
    if points.ndim != 2 or points.shape[1] < 3:
        raise SkyfixError(f"scan: expected (N, 4) float32, got {points.shape} {points.dtype}")
    if len(points) == 0:
        raise SkyfixError("scan: expected at least one point, got none")
    if not np.isfinite(points[:, :3]).all():
        bad = int((~np.isfinite(points[:, :3]).all(axis=1)).sum())
        raise SkyfixError(f"scan: expected finite coordinates, got {bad} of {len(points)} points with NaN or infinity")


def ground_surface(points: NDArray[np.floating], ground_z: float, half_extent_m: float) -> Float32Array:
    """Estimate the height of the ground in the scan's frame on a grid of 1 m cells.

    The lowest return of each cell, made consistent with a largest slope: the lower envelope of cones of 15 % put on
    every cell. Cells without returns (behind walls, on roofs) get what their neighbours allow. Returns far below the
    expected ground (reflections) are ignored.

    Parameters
    ----------
    points
        (N, >= 3) metres, x forward, y left, z up.
    ground_z
        Height of the ground under the vehicle in the scan's frame, metres.
    half_extent_m
        The grid covers +-half_extent_m about the vehicle.

    Returns
    -------
    (n, n) float32 heights, row 0 to the left of the vehicle (largest y).
    """
    size = 2 * math.ceil(half_extent_m / _GROUND_CELL_M)
    rows, cols, inside = _cells(points, size, _GROUND_CELL_M)
    z = points[inside, 2]
    plausible = z > ground_z - 0.6 - 0.12 * np.hypot(points[inside, 0], points[inside, 1])
    lowest = np.full(size * size, _UNKNOWN_Z, dtype=np.float32)
    np.minimum.at(lowest, (rows * size + cols)[plausible], z[plausible].astype(np.float32))
    surface = lowest.reshape(size, size)
    middle = slice(size // 2 - 2, size // 2 + 2)
    surface[middle, middle] = np.minimum(surface[middle, middle], np.float32(ground_z))
    return np.asarray(
        cv2.GaussianBlur(_cone_envelope(surface, _GROUND_SLOPE * _GROUND_CELL_M), (0, 0), 1.0), np.float32
    )


def _cone_envelope(surface: Float32Array, rise_per_cell: float) -> Float32Array:
    """Return the largest surface below the given one whose slope is bounded (grey erosion by a cone, by relaxation)."""
    size = surface.shape[0]
    for _ in range(2 * size):
        padded = np.pad(surface, 1, constant_values=_UNKNOWN_Z)
        lower = surface
        for row in range(3):
            for col in range(3):
                rise = np.float32(rise_per_cell * math.hypot(row - 1, col - 1))
                lower = np.minimum(lower, padded[row : row + size, col : col + size] + rise)
        if np.array_equal(lower, surface):
            break
        surface = lower
    return surface


def _cells(
    points: NDArray[np.floating], size: int, cell_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Rows and columns of the points inside a vehicle-centred square of `size` cells, and which points those are."""
    half = size * cell_m / 2
    cols = np.floor((points[:, 0] + half) / cell_m).astype(np.intp)
    rows = np.floor((half - points[:, 1]) / cell_m).astype(np.intp)
    inside = (cols >= 0) & (cols < size) & (rows >= 0) & (rows < size)
    return rows[inside], cols[inside], inside


def bev_counts(points: NDArray[np.floating], ground_z: float, settings: BevSettings) -> Float32Array:
    """Count the returns of each cell in each height band.

    Parameters
    ----------
    points
        (N, >= 3) metres in the body frame, x forward, y left, z up.
    ground_z
        Height of the ground under the vehicle in the scan's frame, metres.
    settings
        Extent and resolution.

    Returns
    -------
    (len(BANDS_M), size, size) float32 counts, row 0 to the left of the vehicle, columns along its nose.

    Raises
    ------
    SkyfixError
        If the scan is empty, not finite or of a wrong shape, or `ground_z` is not finite.
    """
    check_scan(points)
    if not math.isfinite(ground_z):
        raise SkyfixError(f"ground_z: expected a finite height in metres, got {ground_z}")
    height = points[:, 2] - ground_z
    if settings.ground == "surface":
        surface = ground_surface(points, ground_z, settings.half_extent_m)
        ground_rows, ground_cols, on_surface = _cells(points, surface.shape[0], _GROUND_CELL_M)
        points = points[on_surface]
        height = points[:, 2] - surface[ground_rows, ground_cols]
    size = settings.size
    counts = np.zeros((len(BANDS_M), size * size), dtype=np.float32)
    rows, cols, inside = _cells(points, size, settings.metres_per_pixel)
    cell, height = rows * size + cols, height[inside]
    for band, (low, high) in enumerate(BANDS_M):
        counts[band] = np.bincount(cell[(height >= low) & (height < high)], minlength=size * size)
    return counts.reshape(len(BANDS_M), size, size)


def log_density(counts: Float32Array) -> Float32Array:
    """Compress counts to [0, 1]: min(ln(1 + n) / 3, 1), what a network sees."""
    return np.minimum(np.log1p(counts) / np.float32(3.0), np.float32(1.0))
