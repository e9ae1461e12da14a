"""From which starts single shots are taken: boxes about the true poses, each displaced at random within itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from learned.matcher import SearchRegion
from sequences.start import offset_in_box

_OFFSET_STREAM = 4


@dataclass(frozen=True, slots=True)
class ShotProtocol:
    """From which starts single shots are taken; together with the scans it decides what a table says.

    Attributes
    ----------
    half_extent_m, half_heading_deg
        Half sides of the start's box, metres and degrees; 180 leaves the heading open.
    max_frames
        At most so many scans of a sequence, spread evenly.
    seed
        Of the offsets.
    """

    half_extent_m: float = 20.0
    half_heading_deg: float = 10.0
    max_frames: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.half_extent_m) and self.half_extent_m > 0):
            raise SkyfixError(f"half extent: expected above 0 m, got {self.half_extent_m:g}")
        if not 0 < self.half_heading_deg <= 180:
            raise SkyfixError(f"half heading: expected above 0 and at most 180 degrees, got {self.half_heading_deg:g}")
        if self.max_frames < 1:
            raise SkyfixError(f"max frames: expected 1 or more, got {self.max_frames}")
        if self.seed < 0:
            raise SkyfixError(f"seed: expected 0 or more, got {self.seed}")

    def stated(self) -> dict[str, Any]:
        """For JSON: `seed`, `max_frames` and `start`, the box."""
        start = {"half_extent_m": self.half_extent_m, "half_heading_deg": self.half_heading_deg}
        return {"seed": self.seed, "max_frames": self.max_frames, "start": start}

    def searches(self, truths: FloatArray) -> list[SearchRegion]:
        """Boxes about true poses (N, 3), each displaced uniformly within itself."""
        rng = np.random.default_rng([self.seed, _OFFSET_STREAM])
        half_heading = math.radians(self.half_heading_deg)
        centres = truths + offset_in_box(self.half_extent_m, half_heading, rng, len(truths))
        return [SearchRegion(centre, self.half_extent_m, half_heading) for centre in centres]
