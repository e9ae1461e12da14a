"""Where a scan is looked for on the map: around what the filter predicts, as wide as the filter is unsure.

The truth never enters. The first search covers the start's whole box; a search is widened to that size again, and in
heading, after the filter has looked lost for a while.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.estimate import Estimate
from fusion.prior import UniformPrior
from learned.matcher import SearchRegion
from sequences.track_settings import TrackSettings

_LOST_HALF_HEADING_RAD = math.radians(45.0)
_HEADING_MARGIN_RAD = math.radians(1.0)


def first_search(prior: UniformPrior, settings: TrackSettings) -> SearchRegion:
    """The start's box and a margin."""
    return SearchRegion(
        centre=prior.mean,
        half_extent_m=prior.half_extent_m + settings.search_margin_m,
        half_heading_rad=min(prior.half_heading_rad + _HEADING_MARGIN_RAD, math.pi),
    )


def next_search(prediction: Estimate, prior: UniformPrior, settings: TrackSettings, lost: bool) -> SearchRegion:
    """The region about the filter's prediction.

    Parameters
    ----------
    prediction
        The filter's estimate, odometry up to this frame applied.
    prior
        The start; its box bounds the search from above where it is larger than the stated maximum.
    settings
        Bounds and the number of standard deviations.
    lost
        Whether to search as widely as allowed.
    """
    sigma = np.sqrt(np.diag(prediction.covariance))
    half_extent = settings.search_sigmas * float(sigma[:2].max())
    half_heading = settings.search_sigmas * float(sigma[2])
    least_m, least_rad = settings.search_min_half_extent_m, math.radians(settings.search_min_half_heading_deg)
    widest_m = max(settings.search_max_half_extent_m, prior.half_extent_m + settings.search_margin_m)
    if lost:
        least_m, least_rad = widest_m, max(least_rad, _LOST_HALF_HEADING_RAD)
    return SearchRegion(
        centre=prediction.pose,
        half_extent_m=min(max(half_extent, least_m), widest_m),
        half_heading_rad=min(max(half_heading, least_rad), math.pi),
    )
