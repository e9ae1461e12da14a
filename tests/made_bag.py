"""ROS bags written for tests: a few scans of a rotating sensor, wheel odometry, its mounting and a satellite fix."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

KINDS = ("ros1", "sqlite3", "mcap")
START_NS = 1_600_000_000_123_456_789
STEP_NS = 100_000_000
MOUNTED_AT = np.array([1.0, -0.2, 1.5])
MOUNTED_YAW = 0.1
_DTYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@dataclass
class MadeBag:
    """What a bag holds; tests change it before writing."""

    scans: list[NDArray[np.float32]] = field(default_factory=lambda: [scan(index) for index in range(4)])
    scan_stamps: list[int] = field(default_factory=lambda: [START_NS + STEP_NS * index for index in range(4)])
    scan_topics: tuple[str, ...] = ("/points",)
    odometry_topics: tuple[str, ...] = ("/wheels/odom",)
    linked: bool = True
    link_rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    odometry_x0: float = 0.0

    def write(self, path: Path, kind: str) -> Path:
        """Write it as ROS 1's one file or ROS 2's folder."""
        types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":  # not among the types that come with ROS 1 itself
            types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        make = types.types
        if kind == "ros1":
            writer: Any = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
        serialize = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
        with writer:

            def put(topic: str, kind_of: str, messages: list[tuple[int, Any]]) -> None:
                connection = writer.add_connection(topic, kind_of, typestore=types)
                for stamp, message in messages:
                    writer.write(connection, stamp, serialize(message, kind_of))

            def header(stamp: int, frame: str) -> Any:
                time = make["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
                more = {"seq": 0} if kind == "ros1" else {}
                return make["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

            point, turn = make["geometry_msgs/msg/Point"], make["geometry_msgs/msg/Quaternion"]
            with_covariance = make["geometry_msgs/msg/PoseWithCovariance"]
            vector, twist = make["geometry_msgs/msg/Vector3"], make["geometry_msgs/msg/Twist"]
            still = make["geometry_msgs/msg/TwistWithCovariance"](
                twist(vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0)), np.zeros(36)
            )
            fields = make["sensor_msgs/msg/PointField"]
            for topic in self.scan_topics:
                clouds = [
                    (stamp, cloud_message(points, make["sensor_msgs/msg/PointCloud2"], fields, header(stamp, "lidar")))
                    for stamp, points in zip(self.scan_stamps, self.scans, strict=True)
                ]
                put(topic, "sensor_msgs/msg/PointCloud2", clouds)
            for topic in self.odometry_topics:
                poses = []
                for index in range(9):
                    stamp = START_NS + index * STEP_NS // 2
                    quaternion = turn(*Rotation.from_euler("z", 0.02 * index).as_quat().tolist())
                    pose = make["geometry_msgs/msg/Pose"](point(self.odometry_x0 + 0.5 * index, 0.0, 0.3), quaternion)
                    odometry = make["nav_msgs/msg/Odometry"](
                        header(stamp, "odom"), "base_link", with_covariance(pose, np.zeros(36)), still
                    )
                    poses.append((stamp, odometry))
                put(topic, "nav_msgs/msg/Odometry", poses[::-1] + poses[:1])
            if self.linked:
                put(
                    "/tf_static",
                    "tf2_msgs/msg/TFMessage",
                    [(START_NS, make["tf2_msgs/msg/TFMessage"](self._links(make, header)))],
                )
            status = make["sensor_msgs/msg/NavSatStatus"]
            fixes = [
                (
                    START_NS,
                    make["sensor_msgs/msg/NavSatFix"](
                        header(START_NS, "gps"), status(state, 1), *at, 100.0, np.zeros(9), 0
                    ),
                )
                for state, at in ((-1, (0.0, 0.0)), (0, (49.01, 8.42)))
            ]
            put("/fix", "sensor_msgs/msg/NavSatFix", fixes)
        return path

    def _links(self, make: Any, header: Any) -> list[Any]:
        """base_link -> mast, and lidar -> mast the other way round."""
        vector, turn = make["geometry_msgs/msg/Vector3"], make["geometry_msgs/msg/Quaternion"]
        link, transform = make["geometry_msgs/msg/TransformStamped"], make["geometry_msgs/msg/Transform"]
        back = Rotation.from_euler("z", -MOUNTED_YAW)
        mast = transform(vector(*MOUNTED_AT.tolist()), turn(*self.link_rotation))
        turned = transform(vector(0.0, 0.0, 0.0), turn(*back.as_quat().tolist()))
        return [link(header(START_NS, "base_link"), "mast", mast), link(header(START_NS, "/lidar"), "mast", turned)]


def scan(index: int) -> NDArray[np.float32]:
    """A flat road 1.7 m below the sensor and a wall, one missing return among them."""
    rng = np.random.default_rng(index)
    road = np.column_stack([rng.uniform(-12, 12, (900, 2)), rng.normal(-1.7, 0.01, 900), rng.uniform(0, 255, 900)])
    wall = np.column_stack([np.full(300, 8.0), rng.uniform(-9, 9, 300), rng.uniform(-1.7, 4, 300), np.full(300, 10.0)])
    points = np.concatenate([road, wall]).astype(np.float32)
    points[7, :3] = np.nan
    return points


def cloud_message(
    points: NDArray[Any],
    cloud: Any,
    point_field: Any,
    header: Any,
    layout: dict[str, tuple[str, int]] | None = None,
    big_endian: bool = False,
    step: int = 22,
    padding: int = 5,
    height: int = 1,
) -> Any:
    """A PointCloud2 of (N, 4) points in a layout {field: (kind, offset)}, its rows padded."""
    layout = layout or {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8), "intensity": ("f4", 16), "ring": ("u2", 20)}
    order = ">" if big_endian else "<"
    dtype = np.dtype(
        {
            "names": list(layout),
            "formats": [order + kind for kind, _ in layout.values()],
            "offsets": [offset for _, offset in layout.values()],
            "itemsize": step,
        }
    )
    cells = np.zeros(len(points), dtype)
    for column, name in enumerate(("x", "y", "z", "intensity")):
        if name in layout:
            cells[name] = points[:, column]
    width = len(points) // height
    rows = np.zeros((height, width * step + padding), np.uint8)
    rows[:, : width * step] = cells.view(np.uint8).reshape(height, width * step)
    fields = [point_field(name, offset, _DTYPES[kind], 1) for name, (kind, offset) in layout.items()]
    return cloud(header, height, width, fields, big_endian, step, rows.shape[1], rows.reshape(-1), False)
