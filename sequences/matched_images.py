"""What a matcher's network is shown on a drive: for the ranges of an 8-bit export."""

from __future__ import annotations

import math

import numpy as np

from fusion.errors import SkyfixError
from learned.bev import bev_counts
from learned.export import Images
from learned.matcher import SearchRegion
from learned.rotmatch import RotMatch
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.sequence import ScanError, Sequence

_HALF_EXTENT_M = 20.0
_HALF_HEADING_RAD = math.radians(10.0)


def matched_images(sequence: Sequence, matcher: RotMatch, frames: int) -> list[Images]:
    """Images of scans spread evenly over a drive and of the maps about their true poses.

    Raises
    ------
    SkyfixError
        If there is no ground truth, no scan can be used, or `frames` is not positive.
    """
    if frames < 1:
        raise SkyfixError(f"frames: expected >= 1, got {frames}")
    truth = sequence.ground_truth
    if truth is None:
        raise SkyfixError(f"{sequence.name}: expected ground truth to cut maps about, found none")
    first, last = truth.span_ns
    stamps = sequence.stamps_ns
    covered = np.flatnonzero((stamps >= first) & (stamps <= last))
    if len(covered) == 0:
        raise SkyfixError(f"{sequence.name}: expected ground truth that overlaps the scans in time, got none")
    found: list[Images] = []
    # The middles of equal parts of the drive: its very ends, where vehicles stand, say little.
    places = (np.arange(min(frames, len(covered))) + 0.5) * len(covered) / min(frames, len(covered))
    for index in covered[places.astype(int)]:
        try:
            points = sequence.scan(int(index))
        except ScanError:
            continue
        pose = truth.interpolate(stamps[[index]], STAMP_TOLERANCE_NS)[0]
        counts = bev_counts(points, sequence.ground_z, matcher.net.settings.bev)
        density, picture, _ = matcher.images(
            counts, sequence.map, SearchRegion(pose, _HALF_EXTENT_M, _HALF_HEADING_RAD)
        )
        found.append((density.numpy(), picture.numpy()))
    if not found:
        raise SkyfixError(f"{sequence.name}: expected a usable scan, got none in {len(places)}")
    return found
