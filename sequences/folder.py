"""The folder format: the sequence on disk that every reader can be converted to, and that `skyfix track DIR` opens.

    DIR/map.json, DIR/*.png     see `map_source`
    DIR/ground_truth.tum        optional; map frame; may be denser than the scans
    DIR/odometry/NAME.tum       drifting trajectories in a frame of their own; or .txt or .csv, see `odometry_formats`
    DIR/scans/NNNNNN.bin        float32 (x, y, z, reflectance), KITTI velodyne layout; or all of them .npy, .pcd or
                                .ply, see `point_file`; NNNNNN counts the lines of times.txt
    DIR/scans/times.txt         seconds, one a scan
    DIR/sensor.json             ground_z, the height of the ground in the scan frame (metres); scans_simulated: true
                                where the scans in the folder were ray-cast (absent: they were measured)

Without `scans/` they are ray-cast from the map at the ground-truth poses, one a pose, and `scans_simulated` says so. A
simulated scan depends on the map, the seed and its own index only, so any of them can be had alone and again.
"""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.lidar import LidarModel, simulate_scan
from sequences.map_source import read_json, read_map, read_number, read_origin, write_map
from sequences.odometry_files import OdometryFiles
from sequences.point_file import READERS, read_points
from sequences.sequence import ScanError, Sequence, origin_of
from sequences.trajectory_io import format_seconds, read_times, read_tum, write_tum
from sequences.world_model import World
from sequences.world_raster import world_from_raster


class FolderSequence:
    """A sequence in the folder format. Files are checked when it is opened; scans and odometry are read when asked for.

    Parameters
    ----------
    path
        The folder.
    seed
        Seed of the simulated scans; without effect when there are real ones.

    Raises
    ------
    SkyfixError
        If the folder or its map is missing or unreadable, stamps do not increase, the scans do not match `times.txt`,
        the sensor's ground height is absent, or there are neither scans nor a ground truth to simulate them at.
    """

    def __init__(self, path: Path | str, seed: int = 0) -> None:
        self._path = Path(path)
        self._seed = seed
        if not self._path.is_dir():
            raise SkyfixError(f"{self._path}: expected a sequence folder (map.json, odometry/, scans/), got none")
        self.name = self._path.resolve().name
        self.map: MapRaster = read_map(self._path)
        self.origin_lat_lon = read_origin(self._path)
        truth_file = self._path / "ground_truth.tum"
        self.ground_truth: Trajectory | None = read_tum(truth_file) if truth_file.exists() else None
        self._odometry = OdometryFiles(self._path, self.name, lambda: self.stamps_ns)
        self.odometry_names: tuple[str, ...] = self._odometry.names
        self._lidar = LidarModel()
        self._has_scans = (self._path / "scans").is_dir()
        if self._has_scans:
            self._suffix = self._scan_suffix()
            sensor = read_json(self._path / "sensor.json")
            self.stamps_ns = self._recorded_stamps()
            self.ground_z = read_number(sensor, "ground_z", "sensor.json")
            self.scans_simulated = sensor.get("scans_simulated") is True
        else:
            self.stamps_ns = self._simulated_stamps()
            self.ground_z = -self._lidar.mount_height_m
            self.scans_simulated = True

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of scan `index`: body frame, metres, reflectance in 0..1.

        Raises
        ------
        ScanError
            If the file is unreadable or of wrong length, holds no points, or one that is not finite.
        """
        if not self._has_scans:
            return self._simulated_scan(index)
        return read_points(self._scan_file(index))

    def odometry(self, name: str) -> Trajectory:
        """Read the named odometry; `SkyfixError` listing the names there are when it is unknown."""
        return self._odometry.read(name)

    def _scan_suffix(self) -> str:
        """What the scans' files end in."""
        scans = self._path / "scans"
        found = [suffix for suffix in READERS if next(scans.glob(f"*{suffix}"), None) is not None]
        if len(found) > 1:
            raise SkyfixError(f"scans: expected files of one format, got {' and '.join(found)}")
        return found[0] if found else next(iter(READERS))

    def _scan_file(self, index: int) -> Path:
        return self._path / "scans" / f"{index:06d}{self._suffix}"

    def _recorded_stamps(self) -> NDArray[np.int64]:
        stamps = read_times(self._path / "scans" / "times.txt")
        found = sum(1 for _ in (self._path / "scans").glob(f"*{self._suffix}"))
        missing = [index for index in range(len(stamps)) if not self._scan_file(index).exists()]
        if missing:
            raise SkyfixError(
                f"scans: expected {len(stamps)} files, one a line of times.txt, but {self._scan_file(missing[0]).name} "
                f"is missing ({len(missing)} in all)"
            )
        if found > len(stamps):
            raise SkyfixError(f"scans: expected {len(stamps)} files, one a line of times.txt, got {found}")
        return stamps

    def _simulated_stamps(self) -> NDArray[np.int64]:
        if self.ground_truth is None:
            raise SkyfixError(f"{self.name}: expected scans/, or ground_truth.tum to simulate scans at, found neither")
        if self.map.classes is None:
            raise SkyfixError(f"{self.name}: expected scans/: scans cannot be simulated from an aerial photograph")
        return self.ground_truth.stamp_ns

    @cached_property
    def _world(self) -> World:
        return world_from_raster(self.map, self._seed)

    def _simulated_scan(self, index: int) -> NDArray[np.float32]:
        assert self.ground_truth is not None  # _simulated_stamps saw to it
        pose = self.ground_truth.poses[index]
        if not self.map.grid.contains(pose[:2]):
            raise ScanError(f"scan {index}: cannot be simulated at ({pose[0]:.1f}, {pose[1]:.1f}), outside the map")
        return simulate_scan(self._world, pose, self._lidar, np.random.default_rng([self._seed, index]))


def write_folder(path: Path, sequence: Sequence) -> None:
    """Write any sequence in the folder format, simulated scans included (`sensor.json` then says that they are).

    Raises
    ------
    SkyfixError
        If `path` exists and is not empty.
    ScanError
        If a scan of the sequence cannot be used.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise SkyfixError(f"{path}: expected a new or empty folder")
    (path / "odometry").mkdir(parents=True)
    write_map(path, sequence.map, origin_of(sequence))
    if sequence.ground_truth is not None:
        write_tum(path / "ground_truth.tum", sequence.ground_truth)
    for name in sequence.odometry_names:
        write_tum(path / "odometry" / f"{name}.tum", sequence.odometry(name))
    sensor = {"ground_z": sequence.ground_z, "scans_simulated": sequence.scans_simulated}
    (path / "sensor.json").write_text(json.dumps(sensor) + "\n", encoding="utf-8")
    (path / "scans").mkdir()
    for index in range(len(sequence.stamps_ns)):
        sequence.scan(index).astype("<f4").tofile(path / "scans" / f"{index:06d}.bin")
    times = "".join(f"{format_seconds(stamp)}\n" for stamp in sequence.stamps_ns.tolist())
    (path / "scans" / "times.txt").write_text(times, encoding="ascii")
