"""A ROS bag as a drive's folder, all but its map: scans in the body's frame, every odometry, the ground's height."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from sequences.ground_height import estimate_ground_z
from sequences.point_file import read_points
from sequences.rosbag import ODOMETRY, SCANS, Bag, BagOdometry
from sequences.sequence import ScanError
from sequences.trajectory_io import format_seconds, write_tum

_GROUND_SCANS = 20
_PARTIAL = "bag.part"


@dataclass(frozen=True, slots=True)
class BagRequest:
    """What to take from a bag.

    Attributes
    ----------
    scans, odometry
        Topics. None: the only one of scans, every one of odometry.
    every
        Keep every so many scans.
    frame
        Frame to bring the scans to. None: the body of the first odometry where the bag says how the sensor is mounted
        on it, else the sensor's own.
    ground_z
        Height of the ground in that frame, metres. None: estimated from the scans.
    """

    scans: str | None = None
    odometry: tuple[str, ...] | None = None
    every: int = 1
    frame: str | None = None
    ground_z: float | None = None


@dataclass(frozen=True, slots=True)
class BagContent:
    """What was written.

    Attributes
    ----------
    scans, skipped
        Number of scans, and of messages that could not be used.
    frame
        That the scans are in.
    mounted
        False where the scans had to be left in the sensor's frame though the odometry is of another.
    odometry
        Name -> length, metres.
    ground_z
        Metres.
    first_fix
        Latitude and longitude, degrees, or None.
    """

    scans: int
    skipped: int
    frame: str
    mounted: bool
    odometry: dict[str, float]
    ground_z: float
    first_fix: tuple[float, float] | None


def write_bag_folder(
    bag: Bag, target: Path, request: BagRequest, progress: Callable[[int], None] = lambda scans: None
) -> BagContent:
    """Write `scans/`, `odometry/` and `sensor.json` into a folder, which may have a map already; all or nothing.

    Raises
    ------
    SkyfixError
        If the folder has scans or odometry or cannot be written, a topic is missing, or no scan can be used.
    """
    if request.every < 1:
        raise SkyfixError(f"every: expected at least 1, got {request.every}")
    taken = [name for name in ("scans", "odometry", "sensor.json") if (target / name).exists()]
    if taken:
        raise SkyfixError(f"{target}: expected a new folder, or one with a map alone, got one with {', '.join(taken)}")
    topic = bag.the_topic(request.scans, "scans", SCANS)
    wanted = tuple(bag.of_type(*ODOMETRY)) if request.odometry is None else request.odometry
    found = {_file_name(name): bag.odometry(bag.the_topic(name, "odometry", *ODOMETRY)) for name in wanted}
    partial, is_new = target / _PARTIAL, not target.exists()
    shutil.rmtree(partial, ignore_errors=True)
    try:
        (partial / "scans").mkdir(parents=True)
        (partial / "odometry").mkdir()
        content = _write(bag, topic, found, partial, request, progress)
        for name in ("scans", "odometry", "sensor.json"):
            (partial / name).rename(target / name)
    except OSError as error:
        raise SkyfixError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if is_new and target.is_dir() and not any(target.iterdir()):
            target.rmdir()
    return content


def _write(
    bag: Bag,
    topic: str,
    odometry: dict[str, BagOdometry],
    folder: Path,
    request: BagRequest,
    progress: Callable[[int], None],
) -> BagContent:
    body = next((entry.body for entry in odometry.values() if entry.body), "")
    stamps: list[int] = []
    skipped, frame, mounted, mounting = 0, "", True, None
    for number, scan in enumerate(bag.scans(topic)):
        if number % request.every:
            continue
        if isinstance(scan, ScanError) or (stamps and scan.stamp_ns <= stamps[-1]):
            skipped += 1
            continue
        if not stamps:
            frame, mounting, mounted = _frame(bag, request.frame, body, scan.frame)
        points = scan.points if mounting is None else _moved(scan.points, mounting)
        points.astype("<f4").tofile(folder / "scans" / f"{len(stamps):06d}.bin")
        stamps.append(scan.stamp_ns)
        progress(len(stamps))
    if not stamps:
        raise SkyfixError(f"{topic}: expected scans that can be used, got {skipped} that cannot")
    times = "".join(f"{format_seconds(stamp)}\n" for stamp in stamps)
    (folder / "scans" / "times.txt").write_text(times, encoding="ascii")
    for name, entry in odometry.items():
        write_tum(folder / "odometry" / f"{name}.tum", entry.trajectory)
    ground_z = request.ground_z
    if ground_z is None:
        some = np.unique(np.linspace(0, len(stamps) - 1, _GROUND_SCANS).round().astype(int))
        ground_z = round(estimate_ground_z(read_points(folder / "scans" / f"{index:06d}.bin") for index in some), 3)
    sensor = {"ground_z": ground_z, "scans_simulated": False}
    (folder / "sensor.json").write_text(json.dumps(sensor) + "\n", encoding="utf-8")
    lengths = {name: entry.trajectory.length_m for name, entry in odometry.items()}
    return BagContent(len(stamps), skipped, frame, mounted, lengths, ground_z, bag.first_fix())


def _frame(bag: Bag, wanted: str | None, body: str, sensor: str) -> tuple[str, FloatArray | None, bool]:
    """The frame of the scans that are written, what brings them there, and whether it is the one they should be in."""
    into = wanted or body
    if not into or into.lstrip("/") == sensor.lstrip("/"):
        return sensor, None, True
    mounting = bag.mounting(into, sensor)
    if mounting is None and wanted is not None:
        raise SkyfixError(f"frame: expected one that /tf_static connects with the scans' {sensor}, got {wanted}")
    return (sensor, None, False) if mounting is None else (into, mounting, True)


def _moved(points: NDArray[np.float32], body_from_sensor: FloatArray) -> NDArray[np.float32]:
    """Points (N, 4) in another frame, the reflectance kept."""
    xyz = points[:, :3].astype(np.float64) @ body_from_sensor[:3, :3].T + body_from_sensor[:3, 3]
    return np.column_stack([xyz, points[:, 3]]).astype(np.float32)


def _file_name(topic: str) -> str:
    return topic.strip("/").replace("/", "_")
