"""Single-shot evaluation: each scan by itself from a start that is off by up to so much, beside the prior's own score.

Every frame gets a box around its true pose, displaced by a seeded offset drawn uniformly from the box; the matcher
searches that box and answers its best pose, the prior answers the box's centre. Without the prior's line a table says
little: on 20 m boxes a centre is 15.3 m off on average, and a method that reports the prior's heading looks like one
that found it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.matcher import MapMatcher, SearchRegion
from sequences.drive import STAMP_TOLERANCE_NS
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
    `sequence`, `scans_simulated`, `start` and `methods`: {"prior" or a matcher's key: an object as
    `metrics.summarise` makes it}.

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
    answers: dict[str, list[np.ndarray]] = {"prior": [], **{name: [] for name in matchers}}
    used = []
    for place, index in enumerate(chosen):
        try:
            points = sequence.scan(int(index))
        except ScanError:
            continue
        used.append(place)
        search = SearchRegion(centres[place], half_extent_m, half_heading)
        answers["prior"].append(centres[place])
        for name, matcher in matchers.items():
            likelihood = matcher.match(points, sequence.ground_z, sequence.map, search)
            answers[name].append(Measurement(points, search, likelihood, 1.0).best_pose())
    if not used:
        raise SkyfixError(f"{sequence.name}: expected a usable scan, got none in {len(chosen)}")
    return {
        "sequence": sequence.name,
        "scans_simulated": sequence.scans_simulated,
        "skipped_frames": len(chosen) - len(used),
        "seed": seed,
        "start": {"half_extent_m": half_extent_m, "half_heading_deg": half_heading_deg},
        "methods": {name: summarise(true_poses[used], np.array(poses)) for name, poses in answers.items()},
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
    if len(covered) <= max_frames:
        return covered
    return covered[np.linspace(0, len(covered) - 1, max_frames).round().astype(int)]
