"""How far about the prediction a scan is looked for, and when a vehicle counts as lost and as found."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from fusion.errors import SkyfixError


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Settings of `sequences.search.SearchPlan`. Checked when made.

    Attributes
    ----------
    min_half_extent_m, max_half_extent_m
        Bounds of the searched square's half side about the filter's prediction.
    min_half_heading_deg
        Least half width of the searched headings.
    margin_m
        Added to the start box in the first search, so that a truth at its edge still has its surroundings.
    start_growth_m
        Until the start is settled a search covers its whole box, carried along, and what its unknown heading adds up to
        this.
    sigmas
        The search reaches this many standard deviations of the prediction.
    lost_threshold, patience
        A measurement agrees with the filter when it fits its prediction and leaves its lost score below the threshold.
        The search narrows after so many in a row that do, and widens after so many that do not.
    lost_patience
        A vehicle that so many wide searches have not found again is looked for on the whole map.
    relapse_m
        So is one that is lost again within this distance of having been found by a wide search.
    whole_map_every_m
        While it is looked for on the whole map, a scan is matched every so many metres (never more often than
        otherwise).
    winner_share
        It is found when one place holds this share of the posterior, twice in a row.

    Raises
    ------
    SkyfixError
        When a value is out of range.
    """

    min_half_extent_m: float = 12.0
    max_half_extent_m: float = 24.0
    min_half_heading_deg: float = 6.0
    margin_m: float = 2.0
    start_growth_m: float = 40.0
    sigmas: float = 3.5
    lost_threshold: float = 0.5
    patience: int = 3
    lost_patience: int = 3
    relapse_m: float = 50.0
    whole_map_every_m: float = 8.0
    winner_share: float = 0.9

    def __post_init__(self) -> None:
        for entry in fields(self):
            if not math.isfinite(getattr(self, entry.name)):
                raise SkyfixError(f"{entry.name}: expected a finite number, got {getattr(self, entry.name)}")
        extents = ("min_half_extent_m", "max_half_extent_m", "min_half_heading_deg")
        for name in (*extents, "sigmas", "patience", "lost_patience"):
            if getattr(self, name) <= 0:
                raise SkyfixError(f"{name}: expected more than 0, got {getattr(self, name):g}")
        for name in ("margin_m", "start_growth_m", "relapse_m", "whole_map_every_m"):
            if getattr(self, name) < 0:
                raise SkyfixError(f"{name}: expected 0 or more, got {getattr(self, name):g}")
        if self.max_half_extent_m < self.min_half_extent_m:
            raise SkyfixError(
                f"max_half_extent_m: expected at least min_half_extent_m, {self.min_half_extent_m:g}, "
                f"got {self.max_half_extent_m:g}"
            )
        if not 0.5 < self.winner_share < 1.0:
            raise SkyfixError(f"winner_share: expected above 0.5 and below 1, got {self.winner_share:g}")
