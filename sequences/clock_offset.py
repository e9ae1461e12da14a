"""How far an odometry's clock is off the scans': found from the drive itself.

Odometry and scans come from different pipelines, and a tenth of a second between their stamps is a degree of heading in
every turn. The drive knows: with the right offset, odometry and map agree best. The offset is the one that makes the
smoothed drive most probable (in the spirit of Furgale, Rehder and Siegwart, "Unified temporal and spatial calibration
for multi-sensor systems", IROS 2013), and it is believed only when the improvement is significant.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion import se2
from fusion.factor_graph import SmootherResult
from fusion.trajectory import Trajectory

STEP_S = 0.1
LARGEST_S = 0.4
SIGNIFICANT = 0.5 * 4.0**2
"""Least drop of the cost, half a chi-square: four standard deviations."""


def shifted(odometry: Trajectory, offset_s: float) -> Trajectory:
    """The odometry with stamps moved by an offset, carried on at both ends as it last moved."""
    step_ns = int(LARGEST_S * 1e9) + 1
    first, last = odometry.span_ns
    ends = odometry.interpolate(np.array([first, min(first + step_ns, last), max(last - step_ns, first), last]))
    before = se2.compose(ends[0], se2.inverse(se2.between(ends[0], ends[1])))
    after = se2.compose(ends[3], se2.between(ends[2], ends[3]))
    stamps = np.concatenate([[first - step_ns], odometry.stamp_ns, [last + step_ns]]) + round(offset_s * 1e9)
    poses = np.concatenate([before[None], odometry.poses, after[None]])
    return Trajectory(stamps, poses, None, odometry.frame_id)


def with_best_offset(smoothing: Callable[[float], SmootherResult]) -> tuple[SmootherResult, float]:
    """Smooth with the offset that makes the drive most probable.

    Parameters
    ----------
    smoothing
        Smooths the drive with the odometry moved by an offset in seconds.

    Returns
    -------
    The smoothed drive and the offset in seconds: the minimum, refined by a parabola through three costs a step apart,
    or 0 when nothing within +-0.4 s is significantly better.
    """
    done: dict[int, SmootherResult] = {}

    def cost(step: int) -> float:
        if step not in done:
            done[step] = smoothing(step * STEP_S)
        return done[step].cost

    best = min((-1, 0, 1), key=cost)
    limit = round(LARGEST_S / STEP_S) - 1
    while abs(best) < limit and best != 0 and cost(best + int(np.sign(best))) < cost(best):
        best += int(np.sign(best))
    below, here, above = cost(best - 1), cost(best), cost(best + 1)
    bend = below - 2.0 * here + above
    offset = STEP_S * (best + (0.5 * (below - above) / bend if bend > 0.0 else 0.0))
    refined = smoothing(offset)
    if not done[0].cost - refined.cost > SIGNIFICANT:
        return done[0], 0.0
    return refined, offset
