"""Single frames to evaluate on: scans that each have a map, a true pose and a listed start of their own.

Published protocols of single-shot localization are such lists: fixed starts make the numbers of different methods
comparable. They are no drives, so they can be evaluated and not tracked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray
from learned.map_raster import MapRaster


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationFrame:
    """What one scan is to be found on, and from where.

    Attributes
    ----------
    map
        A map whose +x is the heading of the start, so that a square search about it is the protocol's box.
    true_pose, start
        (3,) in the frame of that map.
    """

    map: MapRaster
    true_pose: FloatArray
    start: FloatArray


@runtime_checkable
class FrameSet(Protocol):
    """Scans with an `EvaluationFrame` each.

    Attributes
    ----------
    name, ground_z, scans_simulated
        As for a `sequences.sequence.Sequence`.
    half_extent_m, half_heading_deg
        Of the box that the listed starts were drawn from: the truth lies in it, on the axes of the true pose.
    """

    @property
    def name(self) -> str: ...
    @property
    def ground_z(self) -> float: ...
    @property
    def scans_simulated(self) -> bool: ...
    @property
    def half_extent_m(self) -> float: ...
    @property
    def half_heading_deg(self) -> float: ...

    def __len__(self) -> int: ...

    def scan(self, index: int) -> NDArray[np.float32]:
        """Points (N, 4) float32 of frame `index` in the body frame; `ScanError` when the scan cannot be used."""
        ...

    def frame(self, index: int) -> EvaluationFrame:
        """Map, truth and start of frame `index`; `SkyfixError` when one cannot be read."""
        ...


def covering_half_extent_m(half_extent_m: float, half_heading_deg: float) -> float:
    """Half side of the square on the start's axes that holds the box on the axes of the true pose."""
    turn = min(math.radians(half_heading_deg), math.pi / 4)
    return half_extent_m * (math.cos(turn) + math.sin(turn))
