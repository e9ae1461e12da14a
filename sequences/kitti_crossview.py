"""KITTI + aerial: scans of KITTI's raw data on satellite images, from the starts that HighlyAccurate lists.

    LIST.txt                                               a line a frame: DATE/DRIVE/NNNNNNNNNN.png sx sy theta
    KITTI/raw_data/DATE/calib_imu_to_velo.txt              see `sequences.kitti`
    KITTI/raw_data/DATE/DRIVE/oxts/data/NNNNNNNNNN.txt
    KITTI/raw_data/DATE/DRIVE/velodyne_points/data/NNNNNNNNNN.bin
    KITTI/satmap/DATE/DRIVE/NNNNNNNNNN.png                 north up, centred at the frame's GPS fix, zoom 18, scale 2

`skyfix evaluate KITTI/LIST.txt` opens one; the list lies in KITTI/. It is evaluated and not tracked: the frames of a
list are of many drives, in any order, and each has a map of its own.

The protocol (Shi and Li, "Beyond cross-view image retrieval: highly accurate vehicle localization using satellite
image", CVPR 2022, and the code released with it): the satellite image is turned so that the heading points east, moved
by the camera's place (1.08 m ahead of the GPS and 0.26 m to its right), moved again so that the camera appears
20 sx m ahead and 20 sy m to the left of the centre, turned by 10 theta degrees counter-clockwise about the centre, and
its middle 512 x 512 px are kept, 0.1958 m each. The middle is the start; so with the true camera pose (p, yaw) the
start is p - 20 (sx ahead + sy left), headed yaw - 10 theta degrees. Here all of that is one resampling of the original.
Maps are pictures without classes. The body frame is the Velodyne's, of which the start is as far off as the camera's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import MapRaster
from sequences.frame_set import EvaluationFrame
from sequences.kitti import read_imu_from_velo
from sequences.kitti_files import VELODYNE_GROUND_Z, numbers, planar, read_text
from sequences.oxts import map_from_imu, read_record
from sequences.point_file import read_points
from sequences.satellite import METRES_PER_PIXEL, read_satellite_image

CROP_PX = 512
HALF_EXTENT_M = 20.0
HALF_HEADING_DEG = 10.0
IMU_FROM_CAMERA = np.array([1.08, -0.26, 0.0])
_FOLDERS = ("raw_data", "satmap")


@dataclass(frozen=True, slots=True)
class ListedFrame:
    """A line of the list: folder DATE/DRIVE, name of the frame, and its start's offset in shares of the ranges."""

    drive: str
    frame: str
    ahead: float
    left: float
    turn: float


class KittiCrossview:
    """A list as a `sequences.frame_set.FrameSet`. The list is read when it is opened, frames when asked for.

    Parameters
    ----------
    path
        The list. `raw_data/` and `satmap/` lie beside it.

    Raises
    ------
    SkyfixError
        If the list cannot be read, a line is not as above, or a folder is missing.
    """

    ground_z = VELODYNE_GROUND_Z
    scans_simulated = False
    half_extent_m = HALF_EXTENT_M
    half_heading_deg = HALF_HEADING_DEG

    def __init__(self, path: Path | str) -> None:
        path = Path(path)
        self.name = path.stem
        self.frames = read_list(path)
        self._root = path.parent
        for folder in _FOLDERS:
            if not (self._root / folder).is_dir():
                raise SkyfixError(f"{self._root}: expected {folder}/ beside {path.name}, got none")

    def __len__(self) -> int:
        return len(self.frames)

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of frame `index`, Velodyne frame; `ScanError` when they cannot be used."""
        listed = self.frames[index]
        return read_points(self._raw(listed) / "velodyne_points" / "data" / f"{listed.frame}.bin")

    def frame(self, index: int) -> EvaluationFrame:
        """The protocol's crop of frame `index`, origin in its middle, and true pose and start of the Velodyne on it."""
        listed = self.frames[index]
        drive = self._raw(listed)
        imu = planar(map_from_imu(*_fix(drive / "oxts" / "data" / f"{listed.frame}.txt")))[0]
        camera = se2.compose(imu, IMU_FROM_CAMERA)
        start = start_of(camera, listed)
        camera_from_velo = se2.between(IMU_FROM_CAMERA, planar(read_imu_from_velo(drive.parent)))
        true_pose = se2.compose(se2.between(start, camera), camera_from_velo)
        return EvaluationFrame(turned_crop(self.aerial(index), start), true_pose, camera_from_velo)

    def aerial(self, index: int) -> MapRaster:
        """The whole satellite image of frame `index`, north up, origin at the frame's GPS fix."""
        listed = self.frames[index]
        return read_satellite_image(self._root / "satmap" / listed.drive / f"{listed.frame}.png")

    def _raw(self, listed: ListedFrame) -> Path:
        return self._root / "raw_data" / listed.drive


def read_list(path: Path) -> list[ListedFrame]:
    """Read a list with starts; `SkyfixError` when it is empty or a line is not `DATE/DRIVE/FRAME.png sx sy theta`."""
    frames = []
    for at, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        name, *fields = line.split()
        parts = Path(name).parts
        if len(parts) != 3 or not name.endswith(".png") or ".." in parts:
            raise SkyfixError(f"{path}: line {at}: expected DATE/DRIVE/FRAME.png sx sy theta, got {line.strip()!r}")
        ahead, left, turn = numbers(fields, 3, f"{path}: line {at}: sx sy theta")
        if max(abs(ahead), abs(left), abs(turn)) > 1.0:
            raise SkyfixError(f"{path}: line {at}: expected sx sy theta in [-1, 1], got {' '.join(fields)}")
        frames.append(ListedFrame(f"{parts[0]}/{parts[1]}", Path(name).stem, ahead, left, turn))
    if not frames:
        raise SkyfixError(f"{path}: expected lines DATE/DRIVE/FRAME.png sx sy theta, got none")
    return frames


def start_of(true_pose: FloatArray, listed: ListedFrame) -> FloatArray:
    """The listed start (3,) of a frame whose true pose (3,) is known."""
    offset = np.array([-HALF_EXTENT_M * listed.ahead, -HALF_EXTENT_M * listed.left, 0.0])
    start = se2.compose(true_pose, offset)
    start[2] = se2.wrap(start[2] - math.radians(HALF_HEADING_DEG * listed.turn))
    return start


def turned_crop(aerial: MapRaster, pose: FloatArray, size: int = CROP_PX) -> MapRaster:
    """The square crop about a pose (3,) with its heading to the east; the crop's frame is that of the pose."""
    half = 0.5 * size * METRES_PER_PIXEL
    grid = MapGrid(size, size, METRES_PER_PIXEL, -half, -half)
    rows, cols = np.mgrid[0:size, 0:size] + 0.5
    xy = se2.transform_points(pose, grid.xy_from_pixel(np.stack([rows, cols], axis=-1)))
    source = (aerial.grid.pixel_from_xy(xy) - 0.5).astype(np.float32)
    picture = cv2.remap(aerial.picture, source[..., 1], source[..., 0], cv2.INTER_LINEAR, borderValue=0)
    return MapRaster(grid, None, np.asarray(picture, dtype=np.uint8))


def _fix(file: Path) -> tuple[FloatArray, tuple[float, float]]:
    """A record (1, 30) and its own latitude and longitude, the origin of the frame's map."""
    record = read_record(file)
    return record, (float(record[0, 0]), float(record[0, 1]))
