"""How a drive starts: the box that its first pose lies in, and what that box is worth as an answer."""

from __future__ import annotations

import math

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory
from sequences.anywhere import map_box
from sequences.drive import Drive
from sequences.sequence import Sequence
from sequences.track_settings import TrackSettings

_START_STREAM, _PRIOR_STREAM = 0, 2


def start_prior(drive: Drive, settings: TrackSettings) -> UniformPrior:
    """The box that the first pose lies in.

    Its centre is the given start; without one, the true first pose plus an offset drawn uniformly from the box, so
    that the truth is uniform in it. The square about the whole map when nothing is known.

    Raises
    ------
    SkyfixError
        If the start is outside the map, or there is neither a start nor ground truth to draw one from.
    """
    if settings.start_anywhere:
        return map_box(drive.sequence.map.grid)
    half = (settings.half_extent_m, settings.half_heading_rad)
    if settings.start is not None:
        x, y, yaw_deg = settings.start
        _require_inside(drive.sequence, np.array([x, y]), "start")
        return UniformPrior(np.array([x, y, math.radians(yaw_deg)]), *half)
    if drive.truth is None:
        raise SkyfixError(f"{drive.sequence.name}: has no ground truth to draw a start from: give --start X Y YAW_DEG")
    first = drive.truth.poses[0]
    _require_inside(drive.sequence, first[:2], "true start")
    rng = np.random.default_rng([settings.seed, _START_STREAM])
    return UniformPrior(first + offset_in_box(*half, rng, 1)[0], *half)


def prior_answers(truth: Trajectory, settings: TrackSettings, prior: UniformPrior | None = None) -> Trajectory:
    """What the prior's mean scores as an answer for every frame.

    A box of the start's size is laid around every true pose at a seeded random offset, the way the first frame's is,
    and its centre is the answer: what a single-shot method gets that returns the centre of its initial search,
    whatever it sees. With a start anywhere on the map, `prior`, there is one such box for all of them.
    """
    if settings.start_anywhere and prior is not None:
        return Trajectory(truth.stamp_ns, np.tile(prior.mean, (len(truth), 1)), None, truth.frame_id)
    rng = np.random.default_rng([settings.seed, _PRIOR_STREAM])
    offsets = offset_in_box(settings.half_extent_m, settings.half_heading_rad, rng, len(truth))
    return Trajectory(truth.stamp_ns, truth.poses + offsets, None, truth.frame_id)


def offset_in_box(half_extent_m: float, half_heading_rad: float, rng: np.random.Generator, n: int) -> FloatArray:
    """Offsets (n, 3) uniform over a box on the axes of the map, metres and radians."""
    half = np.array([half_extent_m, half_extent_m, half_heading_rad])
    return rng.uniform(-half, half, size=(n, 3))


def _require_inside(sequence: Sequence, xy: FloatArray, label: str) -> None:
    grid = sequence.map.grid
    if not grid.contains(xy):
        x1, y1 = grid.x0 + grid.width_m, grid.y0 + grid.height_m
        raise SkyfixError(
            f"{label}: expected inside the map, x {grid.x0:g} .. {x1:g} m, y {grid.y0:g} .. {y1:g} m, "
            f"got ({xy[0]:g}, {xy[1]:g})"
        )
