"""A sequence of KITTI's odometry benchmark over a map in the folder format.

    sequences/NN/calib.txt                Tr: 12 numbers, camera 0 from the Velodyne
    sequences/NN/times.txt                seconds, one a scan
    sequences/NN/velodyne/NNNNNN.bin      float32 (x, y, z, reflectance)
    poses/NN.txt                          optional; 12 numbers a scan, camera 0 of the first scan from camera 0
    sequences/NN/map/map.json             not KITTI's: the map, see `sequences.map_source`
    sequences/NN/map_from_first.json      optional, not KITTI's: {"x": m, "y": m, "yaw_deg": degrees}, where on the map
                                          the Velodyne of the first scan is, since the poses do not say
    sequences/NN/odometry/NAME.tum        optional, not KITTI's: odometry of one's own

`skyfix track sequences/NN` opens one. The body frame is the Velodyne's. Ground truth needs both the poses and where the
first lies; without it a drive is tracked from a given start (`--start`). The poses are never used as odometry.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.emulated_odometry import emulate_odometry
from sequences.kitti_files import VELODYNE_GROUND_Z, inverse, planar, read_calibration, read_rows, rigid
from sequences.map_source import read_json, read_map, read_number
from sequences.odometry_files import OdometryFiles
from sequences.point_file import read_points
from sequences.trajectory_io import read_times

_PLACEMENT = "map_from_first.json"


class KittiOdometrySequence:
    """One sequence as a `sequences.sequence.Sequence`.

    Parameters
    ----------
    path
        The sequence's folder, sequences/NN.
    seed
        Seed of the emulated odometry.

    Raises
    ------
    SkyfixError
        If a file is missing or broken, or the numbers of scans, times and poses differ.
    """

    def __init__(self, path: Path | str, seed: int = 0) -> None:
        folder = Path(path).resolve()
        self.name = f"kitti_odometry_{folder.name}"
        self.ground_z = VELODYNE_GROUND_Z
        self.scans_simulated = False
        self.stamps_ns: NDArray[np.int64] = read_times(folder / "times.txt")
        self._scans = folder / "velodyne"
        found = sum(1 for _ in self._scans.glob("*.bin"))
        if found != len(self.stamps_ns):
            raise SkyfixError(
                f"{self._scans}: expected {len(self.stamps_ns)} scans, one a line of times.txt, got {found}"
            )
        self.map: MapRaster = read_map(folder / "map")
        truth = self._truth(folder)
        self.ground_truth: Trajectory | None = truth
        made = {} if truth is None else {"emulated": lambda: emulate_odometry(truth, seed)}
        self._odometry = OdometryFiles(folder, self.name, lambda: self.stamps_ns, made)
        self.odometry_names = self._odometry.names

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of scan `index`, Velodyne frame; `ScanError` when it cannot be used."""
        return read_points(self._scans / f"{index:06d}.bin")

    def odometry(self, name: str) -> Trajectory:
        """The named odometry; `SkyfixError` listing the names there are when it is unknown."""
        return self._odometry.read(name)

    def _truth(self, folder: Path) -> Trajectory | None:
        poses_file = folder.parent.parent / "poses" / f"{folder.name}.txt"
        if not poses_file.exists() or not (folder / _PLACEMENT).exists():
            return None
        placement = read_json(folder / _PLACEMENT)
        x, y, yaw_deg = (read_number(placement, key, _PLACEMENT) for key in ("x", "y", "yaw_deg"))
        rows = read_rows(poses_file, 12)
        if len(rows) != len(self.stamps_ns):
            raise SkyfixError(f"{poses_file}: expected {len(self.stamps_ns)} poses, one a scan, got {len(rows)}")
        camera_from_velo = _from_rows(read_calibration(folder / "calib.txt", "Tr")[0], f"{folder / 'calib.txt'}: Tr")
        first_from_camera = np.array([_from_rows(row, f"{poses_file}: line {at + 1}") for at, row in enumerate(rows)])
        velo = planar(inverse(camera_from_velo) @ first_from_camera @ camera_from_velo)
        map_from_first = np.array([x, y, math.radians(yaw_deg)])
        poses = se2.compose(map_from_first, se2.between(velo[:1], velo))
        return Trajectory(self.stamps_ns, poses, None, "map")


def is_kitti_odometry(path: Path) -> bool:
    """Whether a folder is laid out as a sequence of the odometry benchmark."""
    return (path / "velodyne").is_dir() and (path / "times.txt").exists()


def _from_rows(values: FloatArray, label: str) -> FloatArray:
    if values.size != 12:
        raise SkyfixError(f"{label}: expected 12 numbers, got {values.size}")
    rows = values.reshape(3, 4)
    return rigid(rows[:, :3].ravel(), rows[:, 3], label)
