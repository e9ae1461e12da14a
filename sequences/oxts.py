"""KITTI's OXTS records (GPS and inertial unit) as poses in the local metric frame of a map.

    oxts/data/NNNNNNNNNN.txt    one line of 30 numbers: latitude, longitude (degrees), altitude (m), roll, pitch, yaw
                                (rad; yaw 0 = east, counter-clockwise), velocities north, east, forward, left, up (m/s),
                                accelerations, rates about x, y, z and forward, left, up (rad/s), accuracies, modes
    oxts/timestamps.txt         a date and time for every number

The local frame is that of `sequences.osm.local_projection`: transverse Mercator about an origin with scale 1, x east,
y north. Its y axis points to the north of the grid, which away from the origin's meridian is not true north: yaws are
turned by the meridian convergence, tan(gamma) = tan(longitude - origin's) sin(latitude) (Snyder, "Map projections: a
working manual", USGS 1395, eq. 8-12 on a sphere).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from sequences.kitti_files import read_date_times, read_rows
from sequences.osm import local_projection
from sequences.point_file import frame_number

COLUMNS = 30
_FORWARD, _LEFT, _RATE_UP = 8, 9, 22


@dataclass(frozen=True, slots=True, eq=False)
class OxtsRecords:
    """Records of one drive.

    Attributes
    ----------
    stamps_ns
        (N,) int64.
    values
        (N, 30), as in the files.
    names
        Of the files, without their ending.
    """

    stamps_ns: NDArray[np.int64]
    values: FloatArray
    names: tuple[str, ...]

    def map_from_imu(self, origin_lat_lon: tuple[float, float]) -> FloatArray:
        """Poses (N, 4, 4) of the inertial unit (x forward, y left, z up) in the local frame about an origin."""
        return map_from_imu(self.values, origin_lat_lon)

    def dead_reckoned(self) -> FloatArray:
        """Poses (N, 3) of the inertial unit from its own forward and left velocities and its rate of turn alone, in
        the frame of the first. The unit steadies its velocities with GPS, so this drifts less than wheels would."""
        seconds = np.diff(self.stamps_ns) * 1e-9
        twists = self.values[:, [_FORWARD, _LEFT, _RATE_UP]]
        steps = se2.exp(0.5 * (twists[:-1] + twists[1:]) * seconds[:, None])
        poses = np.zeros((len(self.values), 3))
        for index, step in enumerate(steps):
            poses[index + 1] = se2.compose(poses[index], step)
        return poses


def read_oxts(folder: Path) -> OxtsRecords:
    """Read `oxts/` of a drive.

    Raises
    ------
    SkyfixError
        If a file is missing or broken, or there are more records than stamps.
    """
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        raise SkyfixError(f"{folder / 'data'}: expected oxts records NNNNNNNNNN.txt, got none")
    stamps = read_date_times(folder / "timestamps.txt")
    indices = [frame_number(file) for file in files]
    if max(indices) >= len(stamps):
        raise SkyfixError(
            f"{folder / 'timestamps.txt'}: expected a line for each of {max(indices) + 1} records, got {len(stamps)}"
        )
    return OxtsRecords(
        stamps[indices], np.concatenate([read_record(file) for file in files]), tuple(file.stem for file in files)
    )


def read_record(file: Path) -> FloatArray:
    """One record (1, 30)."""
    record = read_rows(file, COLUMNS)
    if len(record) != 1 or abs(record[0, 0]) > 90.0 or abs(record[0, 1]) > 180.0:
        raise SkyfixError(
            f"{file}: expected one record that begins with latitude and longitude, got {len(record)} "
            f"lines, {record[0, 0]:g}, {record[0, 1]:g}"
        )
    return record


def map_from_imu(records: FloatArray, origin_lat_lon: tuple[float, float]) -> FloatArray:
    """Poses (N, 4, 4) of OXTS records (N, 30) in the local frame about an origin; z is relative to the first."""
    lat, lon, altitude, roll, pitch, yaw = records[:, :6].T
    x, y = local_projection(origin_lat_lon).transform(lon, lat)
    yaw = yaw + np.arctan(np.tan(np.radians(lon - origin_lat_lon[1])) * np.sin(np.radians(lat)))
    poses = np.zeros((len(records), 4, 4))
    poses[:, :3, :3] = _about(yaw, 0, 1) @ _about(pitch, 2, 0) @ _about(roll, 1, 2)
    poses[:, :3, 3] = np.stack([x, y, altitude - altitude[0]], axis=-1)
    poses[:, 3, 3] = 1.0
    return poses


def _about(angle: FloatArray, first: int, second: int) -> FloatArray:
    """Rotations (N, 3, 3) that turn one axis towards a second."""
    turn = np.tile(np.eye(3), (len(angle), 1, 1))
    turn[:, first, first] = turn[:, second, second] = np.cos(angle)
    turn[:, second, first] = np.sin(angle)
    turn[:, first, second] = -np.sin(angle)
    return turn
