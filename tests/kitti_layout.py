"""KITTI's layouts on disk with a known path and planted landmarks; places come from geodesics, not from a projection.

The vehicle goes round a circle, so that it heads into every quadrant. Landmarks are points of the earth; what a scan
sees of them follows from the distance and the azimuth between two latitudes and longitudes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray
from PIL import Image

GEOD = pyproj.Geod(ellps="WGS84")
CENTRE = (49.015, 8.43)
"""Latitude and longitude of the circle's centre."""
MAP_ORIGIN = (49.009, 8.39)
"""Some 3 km off, where true north and the grid's differ by 0.03 degrees at the circle."""
RADIUS_M = 30.0
FRAMES = 12
VELO_FROM_IMU_YAW = np.deg2rad(4.0)
VELO_FROM_IMU_T = np.array([-0.81, 0.32, -0.80])
DATE, DRIVE = "2011_09_26", "2011_09_26_drive_0013_sync"
LANDMARKS_POLAR = ((15.0, 12.0), (80.0, 9.0), (140.0, 50.0), (215.0, 17.0), (300.0, 55.0))
"""Azimuth (degrees) and distance (metres) of landmarks from the circle's centre."""


@dataclass(frozen=True)
class Frame:
    """Where the inertial unit truly is: latitude, longitude, azimuth of its heading (degrees)."""

    lat: float
    lon: float
    azimuth: float


def away(lat_lon: tuple[float, float], azimuth: float, metres: float) -> tuple[float, float]:
    """Latitude and longitude of the place in a direction."""
    lon, lat, _ = GEOD.fwd(lat_lon[1], lat_lon[0], azimuth, metres)
    return lat, lon


LANDMARKS = tuple(away(CENTRE, azimuth, metres) for azimuth, metres in LANDMARKS_POLAR)


def frames() -> list[Frame]:
    """Counter-clockwise, by 30 degrees a frame: headings of every quadrant."""
    bearings = [95.0 - 30.0 * index for index in range(FRAMES)]
    return [Frame(*away(CENTRE, bearing, RADIUS_M), bearing - 90.0) for bearing in bearings]


def map_xy(lat_lon: tuple[float, float], origin: tuple[float, float]) -> NDArray[np.float64]:
    """Metres east and north, by azimuth and distance; good to a millimetre over a few kilometres."""
    azimuth, _, metres = GEOD.inv(origin[1], origin[0], lat_lon[1], lat_lon[0])
    return metres * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])


def seen_from(frame: Frame, lat_lon: tuple[float, float]) -> NDArray[np.float64]:
    """A place on the ground in the Velodyne's frame (3,), 0.93 m under the inertial unit."""
    azimuth, _, metres = GEOD.inv(frame.lon, frame.lat, lat_lon[1], lat_lon[0])
    right_of_heading = np.radians(azimuth - frame.azimuth)
    imu = np.array([metres * np.cos(right_of_heading), -metres * np.sin(right_of_heading), -0.93])
    cos, sin = np.cos(VELO_FROM_IMU_YAW), np.sin(VELO_FROM_IMU_YAW)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ imu + VELO_FROM_IMU_T


def scan_of(frame: Frame, index: int) -> NDArray[np.float32]:
    """The landmarks in turn, (N, 4) float32; the reflectance says which frame it is, as for `made_drive`."""
    points = np.array([[*seen_from(frame, landmark), index / 1000.0] for landmark in LANDMARKS])
    return points.astype(np.float32)


def write_raw(root: Path) -> Path:
    """Write raw_data/DATE/DRIVE, no map; gives the drive's folder."""
    drive = root / "raw_data" / DATE / DRIVE
    for folder in ("oxts", "velodyne_points", "image_02"):
        (drive / folder / "data").mkdir(parents=True)
    begin = datetime(2011, 9, 26, 13, 2, 25, 964000, tzinfo=UTC)
    text = [f"{begin + timedelta(seconds=index):%Y-%m-%d %H:%M:%S.%f}389\n" for index in range(FRAMES)]
    speed, rate = RADIUS_M * np.radians(30.0), np.radians(30.0)
    for folder in ("oxts", "velodyne_points"):
        (drive / folder / "timestamps.txt").write_text("".join(text))
    for index, frame in enumerate(frames()):
        yaw = float(np.radians(90.0 - frame.azimuth))
        record = [frame.lat, frame.lon, 112.8, 0.0, 0.0, (yaw + np.pi) % (2 * np.pi) - np.pi] + [0.0] * 24
        record[8], record[22] = speed, rate
        line = " ".join(f"{value:.14g}" for value in record)
        (drive / "oxts" / "data" / f"{index:010d}.txt").write_text(line + "\n")
        scan_of(frame, index).tofile(drive / "velodyne_points" / "data" / f"{index:010d}.bin")
    cos, sin = np.cos(VELO_FROM_IMU_YAW), np.sin(VELO_FROM_IMU_YAW)
    rotation = " ".join(f"{value:.9e}" for value in (cos, -sin, 0, sin, cos, 0, 0, 0, 1))
    shift = " ".join(f"{value:.9e}" for value in VELO_FROM_IMU_T)
    calibration = f"calib_time: 25-May-2012 16:47:16\nR: {rotation}\nT: {shift}\n"
    (drive.parent / "calib_imu_to_velo.txt").write_text(calibration)
    return drive


def write_folder_map(folder: Path, origin: tuple[float, float] | None = MAP_ORIGIN) -> None:
    """Write map/map.json with a building of 2 x 2 m at every landmark."""
    (folder / "map").mkdir()
    corner = np.floor(map_xy(CENTRE, MAP_ORIGIN) - 100.0)
    indices = np.zeros((400, 400), dtype=np.uint8)
    for landmark in LANDMARKS:
        col, up = np.rint((map_xy(landmark, MAP_ORIGIN) - corner) / 0.5).astype(int)
        indices[400 - up - 2 : 400 - up + 2, col - 2 : col + 2] = 1
    Image.fromarray(indices).save(folder / "map" / "semantic.png")
    description = {
        "metres_per_pixel": 0.5,
        "rows": 400,
        "cols": 400,
        "x0": corner[0],
        "y0": corner[1],
        "layers": [{"name": "semantic", "file": "semantic.png", "classes": ["grass", "building"]}],
        "origin_lat_lon_alt": None if origin is None else [*origin, 0.0],
    }
    (folder / "map" / "map.json").write_text(json.dumps(description))


def write_osm(path: Path) -> None:
    """Write an extract with a square building of 3 x 3 m at every landmark."""
    nodes, ways = [], []
    for number, landmark in enumerate(LANDMARKS):
        corners = [away(landmark, azimuth, 1.5 * 2**0.5) for azimuth in (45.0, 135.0, 225.0, 315.0)]
        ids = [10 * number + at + 1 for at in range(4)]
        nodes += [
            f'<node id="{i}" version="1" lat="{lat:.9f}" lon="{lon:.9f}"/>'
            for i, (lat, lon) in zip(ids, corners, strict=True)
        ]
        refs = "".join(f'<nd ref="{i}"/>' for i in (*ids, ids[0]))
        ways.append(f'<way id="{number + 1}" version="1">{refs}<tag k="building" v="yes"/></way>')
    path.write_text('<osm version="0.6">' + "".join(nodes) + "".join(ways) + "</osm>")


def write_odometry_sequence(root: Path) -> Path:
    """Write the odometry benchmark's layout of the same circle, its camera looking along the Velodyne's x axis."""
    folder = root / "sequences" / "00"
    (folder / "velodyne").mkdir(parents=True)
    (root / "poses").mkdir()
    camera_from_velo = np.array([[0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
    (folder / "calib.txt").write_text("P0: 1 0 0 0\nTr: " + " ".join(map(str, camera_from_velo[:3].ravel())) + "\n")
    (folder / "times.txt").write_text("".join(f"{index:.6e}\n" for index in range(FRAMES)))
    path = frames()
    lines = []
    for index, frame in enumerate(path):
        velo = odometry_truth(index)
        cos, sin = np.cos(velo[2]), np.sin(velo[2])
        world = np.array([[cos, -sin, 0, velo[0]], [sin, cos, 0, velo[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        if index == 0:
            first = world
        pose = camera_from_velo @ np.linalg.inv(first) @ world @ np.linalg.inv(camera_from_velo)
        lines.append(" ".join(f"{value:.12e}" for value in pose[:3].ravel()))
        scan_of(frame, index).tofile(folder / "velodyne" / f"{index:06d}.bin")
    (root / "poses" / "00.txt").write_text("\n".join(lines) + "\n")
    x, y, yaw = odometry_truth(0)
    placement = {"x": x, "y": y, "yaw_deg": float(np.degrees(yaw))}
    (folder / "map_from_first.json").write_text(json.dumps(placement))
    write_folder_map(folder)
    return folder


def odometry_truth(index: int) -> NDArray[np.float64]:
    """Pose (3,) of the Velodyne on the map of `write_folder_map`: what puts two landmarks where they are."""
    frame = frames()[index]
    seen = np.array([seen_from(frame, landmark)[:2] for landmark in LANDMARKS])
    known = np.array([map_xy(landmark, MAP_ORIGIN) for landmark in LANDMARKS])
    apart_seen, apart_known = complex(*(seen[4] - seen[0])), complex(*(known[4] - known[0]))
    turn = apart_known / apart_seen
    turn /= abs(turn)
    at = complex(*known[0]) - turn * complex(*seen[0])
    return np.array([at.real, at.imag, np.angle(turn)])
