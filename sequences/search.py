"""Where a scan is looked for on the map: widely until the start is settled, then about the filter's prediction, and
on the whole map when that has failed.

The truth never enters. A likelihood that was evaluated in a narrow search cannot say that nothing in it fits, and a
filter that began on the wrong street confirms itself there. So at first every search covers the start's whole box,
carried along by the odometry, in all of its headings. It narrows when several measurements in a row have agreed with
the filter, and widens when several have not. A wide search always finds something that fits best, so a vehicle that
it does not find again soon, or loses again soon, is looked for on the whole map, until one place has won.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum

import numpy as np

from fusion import se2
from fusion.arrays import FloatArray
from fusion.estimate import Estimate
from fusion.prior import UniformPrior
from learned.matcher import SearchRegion
from sequences.track_settings import TrackSettings

_AGREEMENT_NATS = 1.0  # by which the prediction explains a measurement better than a random pose of the search
_HEADING_MARGIN_RAD = math.radians(1.0)
_LOST_HALF_HEADING_RAD = math.radians(45.0)
_ABOUT_THE_START_RAD = math.radians(60.0)
_WINS = 2  # measurements in a row after which the same place leads


class Phase(Enum):
    """What the search is for."""

    START = "the start"
    TRACK = "the vehicle about the filter's prediction"
    LOST = "a lost vehicle"
    ANYWHERE = "the vehicle on the whole map"


class SearchPlan:
    """Decides on the region of each measurement.

    Parameters
    ----------
    prior
        The start's box.
    settings
        Bounds, margins and how many measurements in a row settle something.
    largest_half_extent_m
        No search about the start or the prediction is larger than this; see `learned.matcher.BoundedMatcher`.
    """

    def __init__(self, prior: UniformPrior, settings: TrackSettings, largest_half_extent_m: float = math.inf) -> None:
        self._prior, self._search, self._largest_m = prior, settings.search, largest_half_extent_m
        self._moved = np.zeros(3)  # odometry since the start, seen from the first body frame
        self._agreeing = self._disagreeing = 0
        self._lost_half_heading_rad = prior.half_heading_rad
        self._way_m, self._found_at_m = 0.0, -math.inf  # odometry's path; where a wide search last found the vehicle
        self._searched_widely = self._won = 0
        self.has_whole_map = True
        self.phase = Phase.ANYWHERE if settings.start_anywhere else Phase.START

    def without_whole_map(self) -> None:
        """Never look for the vehicle on the whole map: the matcher cannot."""
        self.has_whole_map = False
        if self.phase is Phase.ANYWHERE:
            self.phase, self._searched_widely = Phase.LOST, 0

    def move(self, delta: FloatArray) -> None:
        """Carry the start's box along by an odometry increment (3,), in the body frame before it."""
        self._moved = se2.compose(self._moved, delta)
        self._way_m += float(np.hypot(delta[0], delta[1]))

    def region(self, prediction: Estimate | None) -> SearchRegion:
        """The poses to score; `prediction` is the filter's, None before there is one."""
        if self.phase is Phase.START:
            start = self._start_carried_along()
            if prediction is None or start.half_extent_m <= self._widest_start_m:
                # A box that has outgrown the largest search is searched in part, which is still more than about a
                # filter that has not settled.
                return replace(start, half_extent_m=min(start.half_extent_m, self._largest_m))
            self.phase = Phase.LOST
        assert prediction is not None  # a filter exists after the first measurement
        sigma = self._search.sigmas * np.sqrt(np.diag(prediction.covariance))
        least_m = self._search.min_half_extent_m
        most_m = min(self._search.max_half_extent_m, self._largest_m)
        least_rad = math.radians(self._search.min_half_heading_deg)
        if self.phase is Phase.LOST:
            least_m, least_rad = most_m, max(least_rad, self._lost_half_heading_rad)
        return SearchRegion(
            centre=prediction.pose,
            half_extent_m=min(max(float(sigma[:2].max()), least_m), most_m),
            half_heading_rad=min(max(float(sigma[2]), least_rad), math.pi),
        )

    def record(self, search: SearchRegion, log_evidence: float, lost_score: float) -> bool:
        """Note how well the prediction explained a measurement; True when that has changed the phase.

        Parameters
        ----------
        search
            Where it was made.
        log_evidence
            ln density per m^2 rad that the measurement gave to the prediction.
        lost_score
            The filter's own, after it.
        """
        searched = (2.0 * search.half_extent_m) ** 2 * 2.0 * search.half_heading_rad
        nats = log_evidence + math.log(searched)  # over the density of a pose anywhere in the search
        is_lost = nats < 0.0 or lost_score > self._search.lost_threshold
        self._agreeing = self._agreeing + 1 if nats > _AGREEMENT_NATS and not is_lost else 0
        self._disagreeing = self._disagreeing + 1 if is_lost else 0
        before = self.phase
        if before is Phase.LOST:
            self._searched_widely += 1
        if self._agreeing >= self._search.patience:
            if before is Phase.LOST:
                self._found_at_m = self._way_m
            self._track()
        elif self.phase is Phase.TRACK and self._disagreeing >= self._search.patience:
            has_relapsed = self._way_m - self._found_at_m < self._search.relapse_m
            self.phase = Phase.ANYWHERE if has_relapsed and self.has_whole_map else Phase.LOST
            self._searched_widely = 0
        elif before is Phase.LOST and self._searched_widely >= self._search.lost_patience and self.has_whole_map:
            self.phase = Phase.ANYWHERE
        if self.phase is Phase.ANYWHERE:
            self._won = 0
        return self.phase is not before

    @property
    def follows_filter(self) -> bool:
        """Whether searches are about the filter's prediction."""
        return self.phase in (Phase.TRACK, Phase.LOST)

    def give_up(self) -> None:
        """Look for the vehicle on the whole map from now on: it is not where the filter has it."""
        self.phase, self._won = Phase.ANYWHERE, 0

    def record_places(self, share: float) -> bool:
        """Note the likeliest place's share of the posterior after a search of the whole map; True when it has won."""
        self._won = self._won + 1 if share >= self._search.winner_share else 0
        if self._won < _WINS:
            return False
        self._track()
        return True

    def _track(self) -> None:
        self.phase = Phase.TRACK
        self._agreeing = self._disagreeing = 0
        self._lost_half_heading_rad = _LOST_HALF_HEADING_RAD

    @property
    def _widest_start_m(self) -> float:
        return self._prior.half_extent_m + self._search.margin_m + self._search.start_growth_m

    def _start_carried_along(self) -> SearchRegion:
        """The start's box and a margin, moved by the odometry and grown by what its headings leave open."""
        way_m = float(np.hypot(*self._moved[:2]))
        half_heading = self._prior.half_heading_rad
        if half_heading <= _ABOUT_THE_START_RAD:
            centre = se2.compose(self._prior.mean, self._moved)
            growth = 2.0 * way_m * math.sin(0.5 * half_heading)
        else:  # a disc about the start is smaller than one about where the odometry points
            centre = self._prior.mean + [0.0, 0.0, self._moved[2]]
            growth = way_m
        return SearchRegion(
            centre=centre,
            half_extent_m=self._prior.half_extent_m + self._search.margin_m + growth,
            half_heading_rad=min(half_heading + _HEADING_MARGIN_RAD, math.pi),
        )
