"""Where the cells of a whole-map search lie: coarse ones over all of the map, each some odd number of the vote's."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.coarse_vote import padded_size

MOST_CELLS = 100_000_000
"""Of the coarse level: 400 MB."""


@dataclass(frozen=True, slots=True)
class MapSearchSettings:
    """How finely.

    Attributes
    ----------
    cell_m, heading_deg
        Wanted size of a coarse cell; an odd number of the vote's cells is taken.
    places
        At most so many of the best coarse cells are looked at closely, with their neighbours on all sides.
    range_nats
        Cells this far below the best are not looked at closely.
    contrast_cell_m, contrast_heading_deg, contrast_places
        Wanted size of a cell where only the contrast is asked for, and how many places are then looked at closely:
        coarser, as it is asked for often.
    """

    cell_m: float = 3.0
    heading_deg: float = 5.0
    places: int = 16
    range_nats: float = 12.0
    contrast_cell_m: float = 5.0
    contrast_heading_deg: float = 9.0
    contrast_places: int = 24

    def __post_init__(self) -> None:
        if not all(getattr(self, entry.name) > 0 for entry in fields(self)):
            raise SkyfixError(f"map search: expected positive settings, got {self}")


@dataclass(frozen=True, slots=True)
class MapLattice:
    """Where the cells of a whole-map search lie, and the window of map features that it needs.

    Attributes
    ----------
    coarse
        The coarse cells; they cover the map.
    window
        Of the features, `feature_m` a cell.
    side, turn
        The vote's cells and yaw bins in a coarse one, both odd.
    template, padded
        Cells of the scan's features on a side; made a multiple of 2 `side`.
    """

    coarse: MapGrid
    window: MapGrid
    side: int
    turn: int
    template: int
    padded: int

    @classmethod
    def over(
        cls,
        grid: MapGrid,
        feature_m: float,
        template: int,
        yaw_bins: int,
        multiple_of: int,
        settings: MapSearchSettings,
    ) -> MapLattice:
        """Lay cells over the map `grid`; the window's sides are multiples of so many features."""
        side = odd_near(settings.cell_m / feature_m)
        turn = bins_together(yaw_bins, settings.heading_deg)
        padded = padded_size(template, side)
        if grid.area_m2 * yaw_bins / turn > MOST_CELLS * (side * feature_m) ** 2:
            expected = f"at most {MOST_CELLS * (side * feature_m) ** 2 * turn / yaw_bins * 1e-6:.0f} km^2"
            raise SkyfixError(f"whole-map search: expected a map of {expected}, got {grid.area_m2 * 1e-6:.0f} km^2")
        cell = side * feature_m
        rows, cols = (math.ceil(extent / cell) + 1 for extent in (grid.height_m, grid.width_m))
        height, width = (multiple_of * math.ceil((padded + side * (count + 1)) / multiple_of) for count in (rows, cols))
        # The first coarse cell that is used is the second: its neighbours' fine cells lie in the window as well.
        inset = (padded / 2 + side / 2) * feature_m
        x0 = grid.x0 - inset - 0.5 * (cols * cell - grid.width_m)
        top = grid.y0 + grid.height_m + inset + 0.5 * (rows * cell - grid.height_m)
        x0 = grid.x0 + round((x0 - grid.x0) / grid.metres_per_pixel) * grid.metres_per_pixel
        top = grid.y0 + round((top - grid.y0) / grid.metres_per_pixel) * grid.metres_per_pixel
        window = MapGrid(height, width, feature_m, x0, top - height * feature_m)
        coarse = MapGrid(rows, cols, cell, x0 + inset, top - inset - rows * cell)
        return cls(coarse, window, side, turn, template, padded)

    @property
    def first(self) -> int:
        """Where the template of the first fine cell begins in the window, along rows and columns alike."""
        return self.side + (self.padded - self.template) // 2 - self.side // 2


def odd_near(number: float) -> int:
    """The odd number nearest to a positive one."""
    return max(2 * math.floor(number / 2) + 1, 1)


def bins_together(yaw_bins: int, heading_deg: float) -> int:
    """The odd divisor of a number of yaw bins that makes coarse bins nearest to so many degrees."""
    odd = [number for number in range(1, yaw_bins + 1, 2) if yaw_bins % number == 0]
    return min(odd, key=lambda number: abs(math.log(number * 360.0 / yaw_bins / heading_deg)))
