"""Scans in ROS messages: `sensor_msgs/PointCloud2`, of ROS 1 and 2.

The message describes its own layout: named fields at offsets of a point's bytes, rows that may be padded, either byte
order. Points that are not finite (an organised cloud's missing returns) are left out.

Source: https://docs.ros.org/en/rolling/p/sensor_msgs/msg/PointCloud2.html
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sequences.point_file import REFLECTANCE, scan_of
from sequences.sequence import ScanError

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class PointField(Protocol):
    """One field of a point."""

    name: str
    offset: int
    datatype: int


class PointCloud2(Protocol):
    """What is read of the message."""

    height: int
    width: int
    fields: list[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]


def points_of_message(message: PointCloud2, label: str) -> NDArray[np.float32]:
    """Points (N, 4) float32 of a message, in the frame of its header, metres, reflectance in 0..1.

    Raises
    ------
    ScanError
        If the message lacks x, y or z, is shorter than it says, has a field outside a point, or no finite point.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ScanError(f"{label}: expected fields x, y, z, got {', '.join(fields) or 'none'}")
    reflectance = [name for name in REFLECTANCE if name in fields][:1]
    names = ["x", "y", "z", *reflectance]
    kinds = [order + _KINDS.get(fields[name].datatype, "?") for name in names]
    ends = [
        fields[name].offset + int(kind[-1]) if kind[-1].isdigit() else 0
        for name, kind in zip(names, kinds, strict=True)
    ]
    if not all(0 < end <= message.point_step for end in ends) or message.row_step < message.width * message.point_step:
        raise ScanError(f"{label}: expected fields of known types within {message.point_step} bytes, got others")
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if len(data) < message.height * message.row_step:
        raise ScanError(f"{label}: expected {message.height * message.row_step} bytes, got {len(data)}")
    rows = data[: message.height * message.row_step].reshape(message.height, message.row_step)
    layout = np.dtype(
        {
            "names": names,
            "formats": kinds,
            "offsets": [fields[name].offset for name in names],
            "itemsize": message.point_step,
        }
    )
    cells = np.ascontiguousarray(rows[:, : message.width * message.point_step]).view(layout).reshape(-1)
    return scan_of({name: cells[name] for name in names}, label)
