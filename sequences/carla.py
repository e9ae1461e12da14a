"""AGL-Net's CARLA routes: LiDAR scans on a top-down photograph taken 1200 m above the vehicle at one of its frames.

    carla/TOWN/ROUTE/lidar/NNNN.npy           (frame, (N, 4) points) as a pickled object array; a plain (N, 4) array too
    carla/TOWN/ROUTE/measurements/NNNN.json   x, y (m, north and east), theta (rad, clockwise from north) of the vehicle
    carla/TOWN/ROUTE/topdown_rgb/NNNN.png     the photograph: up is the vehicle's heading at that frame, 20 degrees wide
    carla/TOWN/ROUTE/dump_gt.json             optional; {photograph: {scan: {uv_gt, theta_gt, ...}}}: which scans are on
                                              which photograph, the pixel of the LiDAR and theta = atan2(dv, du)
    carla/TOWN/ROUTE/odometry/NAME.tum        optional, not AGL-Net's: odometry of one's own

`skyfix track carla/TOWN/ROUTE` opens a route on the photograph that most scans are listed with, and
`skyfix track carla/TOWN/ROUTE/topdown_rgb/NNNN.png` on a given one. The map frame has its origin in the middle of the
photograph, y towards its top; 5000 px give 11.8 px/m on the ground. Poses are computed from the measurements and must
agree with dump_gt.json where there is one. The LiDAR sits at (1.3, 0, 2.5) m on the vehicle and is turned by -90
degrees, and CARLA's frames are left-handed: its x is to the vehicle's left and its y ahead. The body frame is at the
LiDAR, on the vehicle's axes. Unpickling runs code of the file's author, so it is done on request
only (`--allow-pickle`).
Source: the code released with Guan et al., "AGL-Net: aerial-ground cross-modal global localization with varying
scales", 2024, and CARLA's sensor reference.
"""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.emulated_odometry import emulate_odometry
from sequences.map_source import read_json, read_number
from sequences.odometry_files import OdometryFiles
from sequences.picture import read_photograph
from sequences.point_file import frame_number
from sequences.sequence import SCAN_COLUMNS, ScanError, checked_points

LIDAR_AHEAD_M, LIDAR_HEIGHT_M = 1.3, 2.5
CAMERA_HEIGHT_M, CAMERA_FOV_DEG = 1200.0, 20.0
FRAME_NS = 500_000_000
"""Two frames a second, as the autopilot that recorded the routes saves them; the files bear no times."""
_PIXELS_WITHIN, _RADIANS_WITHIN = 1.0, 0.01
_UNPICKLING_ERRORS = (OSError, ValueError, EOFError, pickle.UnpicklingError, AttributeError, ImportError, TypeError)


class CarlaRoute:
    """One route on one photograph as a `sequences.sequence.Sequence`.

    Parameters
    ----------
    path
        The route's folder, or a photograph in its `topdown_rgb/`.
    seed
        Seed of the emulated odometry.
    allow_pickle
        Unpickle scans. Say so only of files whose author you trust.

    Raises
    ------
    SkyfixError
        If a file is missing or broken, no scan is on the photograph, the scans are pickled and that is not allowed, or
        dump_gt.json disagrees with the measurements.
    """

    ground_z = -LIDAR_HEIGHT_M
    scans_simulated = False

    def __init__(self, path: Path | str, seed: int = 0, allow_pickle: bool = False) -> None:
        path = Path(path).resolve()
        route = path.parent.parent if path.suffix == ".png" else path
        self._allow_pickle = allow_pickle
        listed = read_json(route / "dump_gt.json") if (route / "dump_gt.json").exists() else None
        photograph = path.stem if path.suffix == ".png" else _photograph(route, listed)
        self.name = f"{route.parent.name}_{route.name}_{photograph}"
        self.map: MapRaster = _map(route / "topdown_rgb" / f"{photograph}.png")
        self._files, poses = self._on_the_map(route, photograph, listed)
        if not allow_pickle:
            _require_plain(self._files[0])
        self.stamps_ns = np.array([frame_number(file) for file in self._files], dtype=np.int64) * FRAME_NS
        truth = Trajectory(self.stamps_ns, poses, None, "map")
        self.ground_truth: Trajectory | None = truth
        self._odometry = OdometryFiles(
            route, self.name, lambda: self.stamps_ns, {"emulated": lambda: emulate_odometry(truth, seed)}
        )
        self.odometry_names = self._odometry.names

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of scan `index`: x ahead, y left, z up from the LiDAR, metres; intensity."""
        points = _read(self._files[index], self._allow_pickle)
        return checked_points(np.ascontiguousarray(points[:, [1, 0, 2, 3]]), f"scan {self._files[index].name}")

    def odometry(self, name: str) -> Trajectory:
        """The named odometry; `SkyfixError` listing the names there are when it is unknown."""
        return self._odometry.read(name)

    def _on_the_map(self, route: Path, photograph: str, listed: dict[str, Any] | None) -> tuple[list[Path], FloatArray]:
        """Scan files on the photograph and poses (N, 3) of the LiDAR there."""
        map_from_world = se2.compose(np.array([0.0, 0.0, 0.5 * math.pi]), se2.inverse(_vehicle(route, photograph)))
        entries = None if listed is None else listed.get(photograph)
        if listed is not None and not isinstance(entries, dict):
            raise SkyfixError(f"{route / 'dump_gt.json'}: expected scans on {photograph}, got {', '.join(listed)}")
        files = sorted((route / "lidar").glob("*.npy"), key=frame_number)
        if entries is not None:
            files = sorted((route / "lidar" / f"{name}.npy" for name in entries), key=frame_number)
        kept, poses = [], []
        for file in files:
            world_from_lidar = se2.compose(_vehicle(route, file.stem), np.array([LIDAR_AHEAD_M, 0.0, 0.0]))
            pose = se2.compose(map_from_world, world_from_lidar)
            if entries is not None:
                _require_agreement(pose, entries[file.stem], self.map.grid, f"{route / 'dump_gt.json'}: {file.stem}")
            if self.map.grid.contains(pose[:2]):
                kept.append(file)
                poses.append(pose)
        if not kept:
            raise SkyfixError(f"{route}: expected scans lidar/NNNN.npy on photograph {photograph}, got none")
        return kept, np.array(poses)


def is_carla_route(path: Path) -> bool:
    """Whether a path is a route, or a photograph of one."""
    route = path.parent.parent if path.suffix == ".png" and path.parent.name == "topdown_rgb" else path
    return (route / "lidar").is_dir() and (route / "measurements").is_dir()


def metres_per_pixel(size_px: int, height_m: float = CAMERA_HEIGHT_M) -> float:
    """Side of a pixel on a plane so far below the camera: 0.0846 m (11.8 px/m) on the ground for 5000 px."""
    return 2.0 * height_m * math.tan(0.5 * math.radians(CAMERA_FOV_DEG)) / size_px


def _map(path: Path) -> MapRaster:
    picture = read_photograph(path)
    size = picture.shape[0]
    if picture.shape[1] != size:
        raise SkyfixError(f"{path}: expected a square photograph, got {picture.shape[1]} x {size} px")
    scale = metres_per_pixel(size)
    return MapRaster(MapGrid(size, size, scale, -0.5 * size * scale, -0.5 * size * scale), None, picture)


def _photograph(route: Path, listed: dict[str, Any] | None) -> str:
    """The photograph that most scans are listed with, or the first there is."""
    if listed:
        return max(sorted(listed), key=lambda name: len(listed[name]) if isinstance(listed[name], dict) else 0)
    there_are = sorted((route / "topdown_rgb").glob("*.png"))
    if not there_are:
        raise SkyfixError(f"{route / 'topdown_rgb'}: expected a photograph NNNN.png, got none")
    return there_are[0].stem


def _vehicle(route: Path, frame: str) -> FloatArray:
    """Pose (3,) of the vehicle at a frame: x east, y north, yaw counter-clockwise from east."""
    file = route / "measurements" / f"{frame}.json"
    measured = read_json(file)
    north, east, theta = (read_number(measured, key, str(file)) for key in ("x", "y", "theta"))
    return np.array([east, north, 0.5 * math.pi - theta])


def _require_agreement(pose: FloatArray, entry: object, grid: MapGrid, label: str) -> None:
    """The LiDAR appears where the camera sees a thing of its height, a little further out than the ground below it."""
    values = [entry.get("uv_gt"), entry.get("theta_gt")] if isinstance(entry, dict) else [None, None]
    try:
        listed_uv, listed_theta = np.array(values[0], dtype=np.float64), float(np.array(values[1], dtype=np.float64))
    except (TypeError, ValueError):
        listed_uv, listed_theta = np.full(2, np.nan), math.nan
    scale = metres_per_pixel(grid.cols, CAMERA_HEIGHT_M - LIDAR_HEIGHT_M)
    uv = 0.5 * grid.cols + np.array([pose[0], -pose[1]]) / scale
    shape_is_right = listed_uv.shape == (2,) and np.isfinite([*listed_uv, listed_theta]).all()
    if not shape_is_right:
        raise SkyfixError(f"{label}: expected uv_gt, two numbers, and theta_gt, got {values[0]!r} and {values[1]!r}")
    off_px, off_rad = float(np.abs(listed_uv - uv).max()), abs(float(se2.wrap(listed_theta + pose[2])))
    if off_px > _PIXELS_WITHIN or off_rad > _RADIANS_WITHIN:
        raise SkyfixError(
            f"{label}: expected uv_gt {uv.round(1).tolist()} and theta_gt {-pose[2]:.3f} from the measurements, got "
            f"{listed_uv.round(1).tolist()} and {listed_theta:.3f}"
        )


def _require_plain(file: Path) -> None:
    """Refuse a pickled array by its header, which is read and not run."""
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            read_header = (
                np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            )
            is_pickled = read_header(stream)[2].hasobject
    except OSError as error:
        raise SkyfixError(f"{file}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SkyfixError(f"{file}: expected an .npy file, got: {' '.join(str(error).split())}") from error
    if is_pickled:
        raise SkyfixError(
            f"{file}: expected a plain array, got pickled objects, which run code when read: "
            "give --allow-pickle (allow_pickle=True) if you trust their author"
        )


def _read(file: Path, allow_pickle: bool) -> NDArray[np.float32]:
    try:
        content = np.load(file, allow_pickle=allow_pickle)
        points = content[1] if content.dtype == object else content
        points = np.asarray(points, dtype=np.float32)
    except (*_UNPICKLING_ERRORS, IndexError) as error:
        raise ScanError(f"scan {file.name}: cannot be read: {' '.join(str(error).split())}") from error
    if points.ndim != 2 or points.shape[1] != SCAN_COLUMNS:
        raise ScanError(f"scan {file.name}: expected (N, {SCAN_COLUMNS}) points, got {points.shape}")
    return points
