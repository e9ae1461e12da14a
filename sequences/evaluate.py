"""Single-shot evaluation: each scan by itself from a start that is off by up to so much, beside the prior's own score.

Every frame gets a box around its true pose, displaced by a seeded offset drawn uniformly from the box; the matcher
searches that box and answers its best pose, the prior answers the box's centre. Without the prior's line a table says
little: on 20 m boxes a centre is 15.3 m off on average, and a method that reports the prior's heading looks like one
that found it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.frame_set import FrameSet, covering_half_extent_m
from sequences.measurement import Measurement
from sequences.metrics import summarise
from sequences.sequence import ScanError, Sequence
from sequences.start import offset_in_box
from sequences.tables import ERROR_COLUMNS, error_cells

_OFFSET_STREAM = 4


def evaluate_single_shot(
    sequence: Sequence,
    matchers: Mapping[str, MapMatcher],
    half_extent_m: float = 20.0,
    half_heading_deg: float = 10.0,
    max_frames: int = 200,
    seed: int = 0,
) -> dict[str, Any]:
    """Score matchers on the scans of one sequence.

    Parameters
    ----------
    sequence
        With ground truth.
    matchers
        By the name to list them under. All get the same frames and the same starts.
    half_extent_m, half_heading_deg
        Half sides of the start's box, metres and degrees; 180 leaves the heading open.
    max_frames
        At most so many scans, spread evenly.
    seed
        Of the offsets.

    Returns
    -------
    `sequence`, `scans_simulated`, `skipped_frames`, `seed`, `start` and `methods`: {"prior" or a matcher's key: an
    object as `metrics.summarise` makes it}.

    Raises
    ------
    SkyfixError
        If there is no ground truth, no scan can be used, or a matcher cannot use the map.
    """
    truth = sequence.ground_truth
    if truth is None:
        raise SkyfixError(f"{sequence.name}: expected ground truth to evaluate against, found none")
    half_heading = math.radians(half_heading_deg)
    chosen = _frames(sequence, truth, max_frames)
    true_poses = truth.interpolate(sequence.stamps_ns[chosen], STAMP_TOLERANCE_NS)
    rng = np.random.default_rng([seed, _OFFSET_STREAM])
    centres = true_poses + offset_in_box(half_extent_m, half_heading, rng, len(chosen))

    def shots() -> Iterator[_Shot | None]:
        for place, index in enumerate(chosen):
            search = SearchRegion(centres[place], half_extent_m, half_heading)
            try:
                points = sequence.scan(int(index))
            except ScanError:
                yield None
            else:
                yield _Shot(points, sequence.map, search, true_poses[place])

    start = {"half_extent_m": half_extent_m, "half_heading_deg": half_heading_deg}
    return {**_scored(sequence, shots(), matchers), "seed": seed, "start": start}


def evaluate_frames(frames: FrameSet, matchers: Mapping[str, MapMatcher], max_frames: int = 200) -> dict[str, Any]:
    """Score matchers on single frames, each from its listed start on its own map.

    The square that is searched holds the protocol's box, which lies on the axes of the vehicle.

    Parameters
    ----------
    frames, matchers, max_frames
        As for `evaluate_single_shot`, which says what is returned; `seed` is None.

    Raises
    ------
    SkyfixError
        If a frame's map or pose cannot be read, no scan can be used, or a matcher cannot use a map.
    """
    half_extent_m = covering_half_extent_m(frames.half_extent_m, frames.half_heading_deg)

    def shots() -> Iterator[_Shot | None]:
        for index in _spread(np.arange(len(frames)), max_frames):
            frame = frames.frame(int(index))
            search = SearchRegion(frame.start, half_extent_m, math.radians(frames.half_heading_deg))
            try:
                points = frames.scan(int(index))
            except ScanError:
                yield None
            else:
                yield _Shot(points, frame.map, search, frame.true_pose)

    start = {"half_extent_m": frames.half_extent_m, "half_heading_deg": frames.half_heading_deg}
    return {**_scored(frames, shots(), matchers), "seed": None, "start": start}


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    """One usable scan, where it is looked for and where it is."""

    points: NDArray[np.float32]
    map: MapRaster
    search: SearchRegion
    true_pose: FloatArray


def _scored(
    source: Sequence | FrameSet, shots: Iterable[_Shot | None], matchers: Mapping[str, MapMatcher]
) -> dict[str, Any]:
    answers: dict[str, list[FloatArray]] = {"prior": [], **{name: [] for name in matchers}}
    true_poses: list[FloatArray] = []
    skipped = 0
    for shot in shots:
        if shot is None:
            skipped += 1
            continue
        true_poses.append(shot.true_pose)
        answers["prior"].append(shot.search.centre)
        for name, matcher in matchers.items():
            likelihood = matcher.match(shot.points, source.ground_z, shot.map, shot.search)
            answers[name].append(Measurement(shot.points, shot.search, likelihood, 1.0).best_pose())
    if not true_poses:
        raise SkyfixError(f"{source.name}: expected a usable scan, got none in {skipped}")
    return {
        "sequence": source.name,
        "scans_simulated": source.scans_simulated,
        "skipped_frames": skipped,
        "methods": {name: summarise(np.array(true_poses), np.array(poses)) for name, poses in answers.items()},
    }


def markdown_table(evaluations: list[dict[str, Any]]) -> str:
    """Evaluations as one Markdown table, a line a sequence and method."""
    header = ["sequence", "method", "frames", *ERROR_COLUMNS, "within 5 m"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for evaluation in evaluations:
        label = evaluation["sequence"] + (" (scans simulated)" if evaluation["scans_simulated"] else "")
        for name, summary in evaluation["methods"].items():
            within = f"{100 * summary['position_recall']['5']:.0f} %"
            cells = [label, name, str(summary["frames"]), *error_cells(summary), within]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _frames(sequence: Sequence, truth: Trajectory, max_frames: int) -> np.ndarray:
    first, last = truth.span_ns
    stamps = sequence.stamps_ns
    covered = np.flatnonzero((stamps >= first - STAMP_TOLERANCE_NS) & (stamps <= last + STAMP_TOLERANCE_NS))
    if len(covered) == 0:
        raise SkyfixError(f"{sequence.name}: expected ground truth that overlaps the scans in time, got none")
    return _spread(covered, max_frames)


def _spread(indices: np.ndarray, most: int) -> np.ndarray:
    if len(indices) <= most:
        return indices
    return indices[np.linspace(0, len(indices) - 1, most).round().astype(int)]
