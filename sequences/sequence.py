"""What a drive is to the rest of skyfix: a map, stamped scans, odometry and, for evaluation, ground truth.

Readers (`folder`, `demo`, `kitti`, `kitti_odometry`, `carla`; `registry` finds the one for a path) implement the
protocol; everything that runs over a drive (`localize`, `evaluate`) takes it and no more.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster

SCAN_COLUMNS = 4
"""x, y, z (metres, body frame: x forward, y left, z up) and reflectance (0..1)."""
_FARTHEST_M, _STRAYS = 10_000.0, 0.01  # no LiDAR sees so far: millimetres, or numbers of another type


class ScanError(SkyfixError):
    """One scan cannot be used. Tracking skips such a scan unless it is the first one."""


class Sequence(Protocol):
    """A drive through a known map.

    Attributes
    ----------
    name
        Short name, used for the run directory and the report.
    map
        The georeferenced map that the drive is localized in.
    stamps_ns
        (M,) int64 strictly increasing nanoseconds, one a scan.
    ground_z
        Height of the ground in the scan frame, metres (a sensor 1.73 m above the road has -1.73).
    scans_simulated
        True when the scans were ray-cast from the map, not measured. Every report says so.
    ground_truth
        Poses in the map frame covering the scans' span, or None. Used to evaluate and to draw a start, never to track.
    odometry_names
        Names that `odometry` takes.
    """

    @property
    def name(self) -> str: ...
    @property
    def map(self) -> MapRaster: ...
    @property
    def stamps_ns(self) -> NDArray[np.int64]: ...
    @property
    def ground_z(self) -> float: ...
    @property
    def scans_simulated(self) -> bool: ...
    @property
    def ground_truth(self) -> Trajectory | None: ...
    @property
    def odometry_names(self) -> tuple[str, ...]: ...

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of scan `index` in the body frame; `ScanError` when the scan cannot be used."""
        ...

    def odometry(self, name: str) -> Trajectory:
        """The named odometry in a frame of its own; `SkyfixError` listing the names there are when it is unknown."""
        ...


def checked_points(points: NDArray[np.float32], label: str) -> NDArray[np.float32]:
    """Return `points` when they are a usable scan, (N > 0, 4) float32 and finite; raise `ScanError` otherwise."""
    if points.ndim != 2 or points.shape[1] != SCAN_COLUMNS or points.dtype != np.float32:
        raise ScanError(f"{label}: expected (N, {SCAN_COLUMNS}) float32, got {points.shape} {points.dtype}")
    if len(points) == 0:
        raise ScanError(f"{label}: expected points, got none")
    bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
    if bad:
        raise ScanError(f"{label}: expected finite points, got {bad} of {len(points)} with NaN or infinity")
    farthest = np.abs(points[:, :3]).max(axis=1)
    if np.mean(farthest > _FARTHEST_M) > _STRAYS:
        raise ScanError(
            f"{label}: expected metres about the sensor, float32, got coordinates up to {farthest.max():.3g}"
        )
    return points


def origin_of(sequence: Sequence) -> tuple[float, float] | None:
    """Latitude and longitude, degrees, of the map frame's origin (`sequences.osm.local_projection`).

    Readers that know it have an attribute `origin_lat_lon` more than the protocol asks for; None for the others.
    """
    origin: tuple[float, float] | None = getattr(sequence, "origin_lat_lon", None)
    return origin


def odometry_is_emulated(name: str) -> bool:
    """Whether an odometry was made from the ground truth with drift added; the name says so by the format's
    convention."""
    return "emulated" in name.lower() or "simulated" in name.lower()
