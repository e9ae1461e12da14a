"""Whether a run is to be believed, from what is known without ground truth.

A measurement that belongs to the track says so: it gives the prediction far more evidence than a pose drawn at random
from what was searched. With RotMatch the median is 3.6 to 5.2 nats on every drive that was tracked to 0.7 m or better;
with scans on the wrong axes, a start in the wrong unit, another city's map or one without buildings it is -0.1 to 2.5.
A weaker network may stay below that on drives that go well. Where measurements are flattened more, because they are
taken every metre or their errors last, each says less: docs/results.md has the figures. As a median it does not see a
failure in the last part of a drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.odometry_errors import OdometryCalibration
from sequences.run_result import FrameRow

LEAST_GAIN_NATS = 3.0
"""At the usual temperature or below; less in proportion above it."""
_USUAL_TEMPERATURE = 3.1  # a measurement every 4 m whose error lasts for 6 m
_FEWEST = 3  # measurements that can be judged by
_LOST = 0.5
_USUAL_LOG_SCALE, _USUAL_NOISE = 0.1, 5.0
_FEW, _MANY = 2, 10
_MOST_JUMPS, _MANY_JUMPS = 3, 0.05  # of the frames


@dataclass(frozen=True, slots=True)
class Trust:
    """What speaks for or against a run.

    Attributes
    ----------
    evidence_gain_nats
        Median over the measurements of ln of the evidence over that of a pose drawn at random from what was searched.
    lost_share
        Share of frames at which being lost was likelier than not.
    doubts
        Why not to believe the run, a sentence each; empty when nothing speaks against it.
    """

    evidence_gain_nats: float
    lost_share: float
    doubts: list[str]


def trust(
    rows: Sequence[FrameRow], calibration: OdometryCalibration, *, shows_buildings: bool = True, jumps: int = 0
) -> Trust:
    """Judge a run by its frames, the first of them measured, by its odometry and what was found of it, by its map."""
    gain = float(np.median([_gain_nats(row) for row in rows if row.log_evidence is not None]))
    temperature = float(np.median([row.temperature for row in rows if row.temperature is not None]))
    least = LEAST_GAIN_NATS * min(1.0, _USUAL_TEMPERATURE / temperature)
    measured = sum(row.measured for row in rows)
    lost = [row.lost_score > _LOST for row in rows]
    doubts: list[str] = []
    if gain < least and measured >= _FEWEST:
        doubts.append(
            f"the scans hardly agree with the map where the track is (evidence of {gain:.1f} nats over a random pose, "
            f"{least:.2g} or more is usual): is it the right map and start, are the scans' axes and units right "
            "(`skyfix check` looks)?"
        )
    if not shows_buildings:
        doubts.append("the map shows no buildings: matching has to guess how far walls stand from the carriageway")
    if jumps > max(_MOST_JUMPS, _MANY_JUMPS * len(rows)):
        doubts.append(f"the odometry jumps {jumps} times: is it in metres, its times in seconds?")
    if measured < _FEW and len(rows) >= _MANY:
        doubts.append(f"only {measured} of {len(rows)} scans were matched: does the odometry move, and in metres?")
    if any(lost):
        ending = ", at the end too" if lost[-1] else ""
        doubts.append(f"lost for {sum(lost)} of {len(lost)} frames{ending}: poses until it was found may be far off")
    noise = max(calibration.along_noise, calibration.across_noise, calibration.heading_noise)
    if abs(calibration.log_scale) > _USUAL_LOG_SCALE or noise > _USUAL_NOISE:
        doubts.append(
            f"odometry and map hardly fit together (distances {100 * math.expm1(calibration.log_scale):+.1f} %, "
            f"{noise:.1f} times the usual noise): a lost stretch, or an odometry of other units"
        )
    return Trust(gain, sum(lost) / len(lost), doubts)


def _gain_nats(row: FrameRow) -> float:
    """ln of the evidence over that of the mean pose of the region searched."""
    assert row.log_evidence is not None
    assert row.search_half_extent_m is not None
    assert row.search_half_heading_rad is not None
    headings = min(2.0 * row.search_half_heading_rad, 2.0 * math.pi)
    return row.log_evidence + math.log(4.0 * row.search_half_extent_m**2 * headings)
