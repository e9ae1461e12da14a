"""The demo's streets in drawn worlds, each with three maps: OpenStreetMap's, an aerial image's, carriageways alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from learned.map_raster import MapRaster
from sequences.demo import CITY, DemoSequence
from sequences.world_overhead import drivable_map, overhead_map
from sequences.world_style import WorldStyle

OPEN_STREET_MAP, AERIAL_IMAGE, CARRIAGEWAYS = "OpenStreetMap", "aerial image", "carriageways alone"
_STREAM = 3


class DrawnDrive(DemoSequence):
    """The demo's drive, number 0 in its own world and others in worlds drawn for the number.

    Parameters
    ----------
    number
        Of the world; the same number gives the same drive.
    map_offset_m
        Standard deviation of the maps' shift as a whole against the world, along each axis. None: the world's own.
    kind
        What `map` shows.
    """

    def __init__(self, number: int, map_offset_m: float | None = None, kind: str = OPEN_STREET_MAP) -> None:
        self._drawn = np.random.default_rng((number, _STREAM))
        style = CITY if number == 0 else WorldStyle.random(self._drawn)
        self._offset_m = style.map_offset_m if map_offset_m is None else map_offset_m
        super().__init__(number, replace(style, map_offset_m=self._offset_m))
        self._kind, self._maps = kind, dict[str, MapRaster]()

    @property
    def map(self) -> MapRaster:
        """The map of the drive's kind."""
        return self.maps[self._kind]

    @property
    def maps(self) -> dict[str, MapRaster]:
        """The same world's maps of all kinds."""
        if not self._maps:
            known = super().map
            drawn = {
                kind: draw(self.world, known.grid, self._offset_m, self._drawn)
                for kind, draw in ((AERIAL_IMAGE, overhead_map), (CARRIAGEWAYS, drivable_map))
            }
            self._maps = {OPEN_STREET_MAP: known, **drawn}
        return self._maps
