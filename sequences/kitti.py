"""A drive of KITTI's raw data: Velodyne scans and OXTS records over a map (the protocol KITTI + OSM, or any map).

    DATE/calib_imu_to_velo.txt                       R: and T:, the Velodyne from the inertial unit
    DATE/DRIVE/oxts/{timestamps.txt, data/*.txt}     see `sequences.oxts`
    DATE/DRIVE/velodyne_points/timestamps.txt        a date and time a scan
    DATE/DRIVE/velodyne_points/data/NNNNNNNNNN.bin   float32 (x, y, z, reflectance); numbers may be left out (some are)
    DATE/DRIVE/odometry/NAME.tum                     optional, not KITTI's: odometry of one's own, stamps in Unix time
    a map beside DRIVE, DATE or above, or satmap/    see `sequences.drive_map`

`skyfix track DATE/DRIVE` opens one. The body frame is the Velodyne's (x forward, y left, z up); the ground truth is the
OXTS pose through the calibration, brought to the local metric frame of the map. Where there is no other, odometry is
'oxts_gps_aided' (the unit's own velocities, which its GPS steadies) or 'emulated'. KITTI + OSM as OrienterNet and
AGL-Net evaluate it: map at 2 px/m, start within +-20 m and +-10 degrees (the defaults of `skyfix evaluate`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.drive_map import find_map
from sequences.emulated_odometry import emulate_odometry
from sequences.kitti_files import VELODYNE_GROUND_Z, inverse, planar, read_calibration, read_date_times, rigid
from sequences.odometry_files import OdometryFiles
from sequences.oxts import read_oxts
from sequences.point_file import frame_number, read_points

GPS_AIDED = "oxts_gps_aided"


class KittiDrive:
    """One drive as a `sequences.sequence.Sequence`. Text files are read when it is opened, scans when asked for.

    Parameters
    ----------
    path
        The drive's folder, DATE/DRIVE.
    seed
        Seed of the emulated odometry.

    Raises
    ------
    SkyfixError
        If a file is missing or broken, or no map is found.
    """

    def __init__(self, path: Path | str, seed: int = 0) -> None:
        drive = Path(path).resolve()
        self.name = drive.name
        self.ground_z = VELODYNE_GROUND_Z
        self.scans_simulated = False
        imu_from_velo = read_imu_from_velo(drive.parent)
        oxts = read_oxts(drive / "oxts")
        self._scan_files, self.stamps_ns = _scans(drive / "velodyne_points")
        root = drive.parent.parent.parent
        images = [root / "satmap" / drive.parent.name / drive.name / f"{name}.png" for name in oxts.names]
        found = find_map((drive, drive.parent, drive.parent.parent), oxts.values[:, :2], images)
        self.map: MapRaster = found.raster
        self.origin_lat_lon = found.origin_lat_lon
        poses = planar(oxts.map_from_imu(found.origin_lat_lon) @ imu_from_velo)
        truth = Trajectory(oxts.stamps_ns, poses, None, "map")
        self.ground_truth: Trajectory | None = truth
        offset = planar(imu_from_velo)

        def gps_aided() -> Trajectory:
            moved = se2.compose(oxts.dead_reckoned(), offset)
            return Trajectory(oxts.stamps_ns, se2.between(moved[:1], moved), None, GPS_AIDED)

        made = {GPS_AIDED: gps_aided, "emulated": lambda: emulate_odometry(truth, seed)}
        self._odometry = OdometryFiles(drive, self.name, lambda: self.stamps_ns, made)
        self.odometry_names = self._odometry.names

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of scan `index`, Velodyne frame; `ScanError` when it cannot be used."""
        return read_points(self._scan_files[index])

    def odometry(self, name: str) -> Trajectory:
        """The named odometry; `SkyfixError` listing the names there are when it is unknown."""
        return self._odometry.read(name)


def is_kitti_drive(path: Path) -> bool:
    """Whether a folder is laid out as a raw drive."""
    return (path / "oxts").is_dir() and (path / "velodyne_points").is_dir()


def read_imu_from_velo(date: Path) -> FloatArray:
    """The inertial unit from the Velodyne, (4, 4), of a day's `calib_imu_to_velo.txt`."""
    file = date / "calib_imu_to_velo.txt"
    rotation, translation = read_calibration(file, "R", "T")
    return inverse(rigid(rotation, translation, str(file)))


def _scans(folder: Path) -> tuple[list[Path], NDArray[np.int64]]:
    stamps = read_date_times(folder / "timestamps.txt")
    files = sorted((folder / "data").glob("*.bin"), key=frame_number)
    if not files:
        raise SkyfixError(f"{folder / 'data'}: expected scans NNNNNNNNNN.bin, got none")
    if frame_number(files[-1]) >= len(stamps):
        raise SkyfixError(f"{folder / 'timestamps.txt'}: expected a line for {files[-1].name}, got {len(stamps)} lines")
    return files, stamps[[frame_number(file) for file in files]]
