"""ROS bags: scans and odometry of a recording, of ROS 1 (.bag) or ROS 2 (a folder of .db3 or .mcap files).

    sensor_msgs/PointCloud2      scans, see `sequences.point_cloud2`
    nav_msgs/Odometry            odometry: the body `child_frame_id` in a frame of its own
    geometry_msgs/PoseStamped    odometry too
    tf2_msgs/TFMessage           /tf_static: where the sensor is mounted on that body
    sensor_msgs/NavSatFix        the first one says where on earth it was, for `skyfix map --origin`

Stamps are those of the headers, not of the recording. A bag has no map: `skyfix bag` writes the rest of a drive's
folder, and `skyfix map` adds its map. Messages are read by the package rosbags (the extra `ros`); no ROS is needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.kitti_files import inverse
from sequences.odometry_axes import planar
from sequences.point_cloud2 import points_of_message
from sequences.sequence import ScanError

SCANS = "sensor_msgs/msg/PointCloud2"
ODOMETRY = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_FIX = "sensor_msgs/msg/NavSatFix"
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class BagScan:
    """A scan of a bag: its stamp, the name of its frame, and points (N, 4) in that."""

    stamp_ns: int
    frame: str
    points: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class BagOdometry:
    """An odometry of a bag.

    Attributes
    ----------
    trajectory
        In a frame of its own.
    body
        Name of the frame that moves, or an empty text where the message does not say.
    """

    trajectory: Trajectory
    body: str


class Bag:
    """An open bag; see `open_bag`.

    Attributes
    ----------
    topics
        Message type of each topic.
    """

    def __init__(self, path: Path, reader: Any) -> None:
        self._path, self._reader = path, reader
        self.topics: dict[str, str] = {topic: info.msgtype or "" for topic, info in sorted(reader.topics.items())}

    def of_type(self, *types: str) -> list[str]:
        """Topics of some message types."""
        return [topic for topic, found in self.topics.items() if found in types]

    def the_topic(self, wanted: str | None, what: str, *types: str) -> str:
        """The topic that is wanted, or the only one of some types.

        Raises
        ------
        SkyfixError
            If there is none, several to choose from, or the wanted one is of another type.
        """
        there = self.of_type(*types)
        if wanted is None and len(there) == 1:
            return there[0]
        if wanted in there:
            return str(wanted)
        options = ", ".join(there) or "none"
        got = "no choice" if wanted is None else f"{wanted} ({self.topics.get(wanted, 'not in the bag')})"
        raise SkyfixError(f"{self._path}: expected one of its topics of {what}, {options}; got {got}")

    def scans(self, topic: str) -> Iterator[BagScan | ScanError]:
        """Every scan, or why it cannot be used."""
        for number, message in enumerate(self._messages(topic)):
            try:
                points = points_of_message(message, f"{self._path.name} {topic} message {number}")
            except ScanError as error:
                yield error
                continue
            yield BagScan(_stamp_ns(message), str(message.header.frame_id), points)

    def odometry(self, topic: str) -> BagOdometry:
        """All poses of a topic, in the order of their stamps, each stamp once."""
        stamps, positions, rotations, body = [], [], [], ""
        for message in self._messages(topic):
            pose = message.pose.pose if hasattr(message, "child_frame_id") else message.pose
            body = str(getattr(message, "child_frame_id", ""))
            stamps.append(_stamp_ns(message))
            positions.append(_xyz(pose.position))
            rotations.append(_xyzw(pose.orientation))
        stamps_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        if len(first) < 2:
            raise SkyfixError(f"{self._path} {topic}: expected at least two poses, got {len(first)}")
        at, turned = np.array(positions)[first], np.array(rotations)[first]
        good = np.isfinite(at).all(axis=1) & np.isfinite(turned).all(axis=1) & turned.any(axis=1)
        if not good.all():
            raise SkyfixError(
                f"{self._path} {topic}: expected finite poses with a rotation, got {(~good).sum()} others"
            )
        poses = planar(at, Rotation.from_quat(turned), topic)
        return BagOdometry(Trajectory(stamps_ns, poses, None, topic), body)

    def mounting(self, body: str, sensor: str) -> FloatArray | None:
        """The sensor in the body's frame, (4, 4), by the static transforms; None where they do not connect the two."""
        edges: dict[str, list[tuple[str, FloatArray]]] = {}
        for topic in self.of_type(*_TRANSFORMS):
            if not topic.endswith("tf_static"):
                continue
            for message in self._messages(topic):
                for link in message.transforms:
                    parent, child = _name(link.header.frame_id), _name(link.child_frame_id)
                    parent_from_child = _matrix(link.transform, f"{self._path} {topic}: {parent} to {child}")
                    edges.setdefault(parent, []).append((child, parent_from_child))
                    edges.setdefault(child, []).append((parent, inverse(parent_from_child)))
        known = {_name(body): np.eye(4)}
        waiting = [_name(body)]
        while waiting:
            frame = waiting.pop()
            for other, frame_from_other in edges.get(frame, []):
                if other not in known:
                    known[other] = known[frame] @ frame_from_other
                    waiting.append(other)
        return known.get(_name(sensor))

    def first_fix(self) -> tuple[float, float] | None:
        """Latitude and longitude, degrees, of the first satellite fix."""
        for topic in self.of_type(_FIX):
            for message in self._messages(topic):
                if message.status.status >= 0 and np.isfinite([message.latitude, message.longitude]).all():
                    return float(message.latitude), float(message.longitude)
        return None

    def _messages(self, topic: str) -> Iterator[Any]:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        stored = self._reader.messages(connections=connections)
        while True:
            try:
                connection, _, raw = next(stored)
                message = self._reader.deserialize(raw, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:  # the package raises many kinds at a broken file
                raise SkyfixError(f"{self._path} {topic}: cannot be read: {error or type(error).__name__}") from error
            yield message


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading.

    Raises
    ------
    SkyfixError
        If the package rosbags is not installed, there is no bag, or it cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise SkyfixError(
            f"{path}: reading ROS bags takes the package rosbags (pip install 'skyfix[ros]'): {error}"
        ) from error
    if not path.exists():
        raise SkyfixError(f"{path}: expected a ROS bag (a .bag file or a folder with metadata.yaml), got nothing")
    # The default types are for bags that do not carry their own, as ROS 2's before Iron.
    with ExitStack() as stack:
        try:
            reader = stack.enter_context(AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
        except Exception as error:  # the package raises many kinds at a broken file
            raise SkyfixError(f"{path}: cannot be read as a ROS bag: {error or type(error).__name__}") from error
        yield Bag(path, reader)


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _xyzw(quaternion: Any) -> list[float]:
    return [quaternion.x, quaternion.y, quaternion.z, quaternion.w]


def _matrix(transform: Any, label: str) -> FloatArray:
    """(4, 4) of a transform; `SkyfixError` when it is none."""
    rotation, translation = _xyzw(transform.rotation), _xyz(transform.translation)
    if not np.isfinite([*rotation, *translation]).all() or not np.any(rotation):
        raise SkyfixError(f"{label}: expected a finite transform with a rotation, got {translation}, {rotation}")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(rotation).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def _name(frame: str) -> str:
    """ROS 1 has some with a slash before them."""
    return frame.lstrip("/")
