"""Single-shot evaluation: each scan by itself from a start that is off by up to so much, beside the prior's own score.

Every frame gets a box around its true pose, displaced by a seeded offset drawn uniformly from the box; the matcher
searches that box and answers its best pose and a likelihood, the prior answers the box's centre and the box. Without
the prior's line a table says little: on 20 m boxes a centre is 15.3 m off on average, and a method that reports the
prior's heading looks like one that found it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fusion.arrays import Float32Array, FloatArray
from fusion.errors import SkyfixError
from fusion.likelihood import LikelihoodVolume
from fusion.trajectory import Trajectory
from learned.answers import match_scan
from learned.calibration import Calibration, sample_map
from learned.map_raster import MapRaster
from learned.matcher import MapMatcher, SearchRegion
from learned.network import NetworkMatcher
from learned.samples import Sample
from sequences.drive import STAMP_TOLERANCE_NS
from sequences.frame_set import FrameSet, covering_half_extent_m
from sequences.sequence import ScanError, Sequence
from sequences.shot_protocol import ShotProtocol
from sequences.shot_scores import ShotScore, score_prior, score_shot, summarise_shots


@dataclass(frozen=True, slots=True, eq=False)
class _Shot:
    """A scan's true pose, what is searched, and how a matcher of some kind is asked."""

    truth: FloatArray
    search: SearchRegion
    ask: Callable[[Any], LikelihoodVolume]


def evaluate_single_shot(
    sequence: Sequence, matchers: Mapping[str, MapMatcher], protocol: ShotProtocol | None = None
) -> dict[str, Any]:
    """Score matchers on the scans of one sequence.

    Parameters
    ----------
    sequence
        With ground truth.
    matchers
        By the name to list them under. All get the same frames and the same starts.
    protocol
        The starts; None: the defaults.

    Returns
    -------
    `sequence`, `scans_simulated`, `skipped_frames`, `seed`, `max_frames`, `start` and `methods`: {"prior" or a
    matcher's key: an object as `shot_scores.summarise_shots` makes it}.

    Raises
    ------
    SkyfixError
        If there is no ground truth, no scan can be used, or a matcher cannot use the map.
    """
    protocol = protocol or ShotProtocol()
    truth = sequence.ground_truth
    if truth is None:
        raise SkyfixError(f"{sequence.name}: expected ground truth to evaluate against, found none")
    chosen = frames_with_truth(sequence, truth, protocol.max_frames)
    true_poses = truth.interpolate(sequence.stamps_ns[chosen], STAMP_TOLERANCE_NS)

    def shots() -> Iterable[_Shot]:
        for index, pose, search in zip(chosen, true_poses, protocol.searches(true_poses), strict=True):
            try:
                points = sequence.scan(int(index))
            except ScanError:
                continue
            yield _Shot(pose, search, partial(_ask_matcher, points, sequence.ground_z, sequence.map, search))

    frames, methods = _scored(shots(), matchers)
    if frames == 0:
        raise SkyfixError(f"{sequence.name}: expected a usable scan, got none in {len(chosen)}")
    return {
        "sequence": sequence.name,
        "scans_simulated": sequence.scans_simulated,
        "skipped_frames": len(chosen) - frames,
        **protocol.stated(),
        "methods": methods,
    }


def evaluate_frames(frames: FrameSet, matchers: Mapping[str, MapMatcher], max_frames: int = 200) -> dict[str, Any]:
    """Score matchers on single frames, each from its listed start on its own map; as `evaluate_single_shot`.

    The square that is searched holds the protocol's box, which lies on the axes of the vehicle.

    Parameters
    ----------
    frames
        With a map, a true pose and a start each.
    matchers
        By the name to list them under.
    max_frames
        At most so many, spread evenly. `seed` in what is returned is None: nothing is drawn.

    Raises
    ------
    SkyfixError
        If a frame's map or pose cannot be read, no scan can be used, or a matcher cannot use a map.
    """
    half_extent_m = covering_half_extent_m(frames.half_extent_m, frames.half_heading_deg)
    chosen = _spread(np.arange(len(frames)), max_frames)

    def shots() -> Iterable[_Shot]:
        for index in chosen:
            frame = frames.frame(int(index))
            search = SearchRegion(frame.start, half_extent_m, math.radians(frames.half_heading_deg))
            try:
                points = frames.scan(int(index))
            except ScanError:
                continue
            yield _Shot(frame.true_pose, search, partial(_ask_matcher, points, frames.ground_z, frame.map, search))

    used, methods = _scored(shots(), matchers)
    if used == 0:
        raise SkyfixError(f"{frames.name}: expected a usable scan, got none in {len(chosen)}")
    return {
        "sequence": frames.name,
        "scans_simulated": frames.scans_simulated,
        "skipped_frames": len(chosen) - used,
        "seed": None,
        "max_frames": max_frames,
        "start": {"half_extent_m": frames.half_extent_m, "half_heading_deg": frames.half_heading_deg},
        "methods": methods,
    }


def evaluate_samples(
    name: str, samples: list[Sample], matchers: Mapping[str, NetworkMatcher], protocol: ShotProtocol
) -> dict[str, Any]:
    """Score networks on simulated samples; as `evaluate_single_shot`, all of them.

    Parameters
    ----------
    name
        What to call them.
    samples
        At least one; their class rasters reach as far as the search and the scans about it do.
    """
    if len(samples) == 0:
        raise SkyfixError(f"{name}: expected at least one sample, got none")

    rasters = [sample_map(sample) for sample in samples]
    truths = np.array(
        [
            [*raster.grid.xy_from_pixel((sample.row, sample.col)), sample.yaw]
            for raster, sample in zip(rasters, samples, strict=True)
        ]
    )

    def shots() -> Iterable[_Shot]:
        for sample, raster, truth, search in zip(samples, rasters, truths, protocol.searches(truths), strict=True):
            counts = sample.counts.astype(np.float32)
            yield _Shot(truth, search, partial(_ask_network, counts, raster, search))

    _, methods = _scored(shots(), matchers)
    return {"sequence": name, "scans_simulated": True, "skipped_frames": 0, **protocol.stated(), "methods": methods}


def _ask_matcher(
    points: Float32Array, ground_z: float, raster: MapRaster, search: SearchRegion, matcher: MapMatcher
) -> LikelihoodVolume:
    return match_scan(matcher, points, ground_z, raster, search)


def _ask_network(
    counts: Float32Array, raster: MapRaster, search: SearchRegion, matcher: NetworkMatcher
) -> LikelihoodVolume:
    return matcher.match_counts(counts, raster, search)


def _scored(shots: Iterable[_Shot], matchers: Mapping[str, Any]) -> tuple[int, dict[str, Any]]:
    """Number of shots, and the summary of the prior and of every matcher (empty if there are none)."""
    truths: list[FloatArray] = []
    scores: dict[str, list[ShotScore]] = {"prior": [], **{name: [] for name in matchers}}
    calibrations = {name: _calibration(matcher) for name, matcher in matchers.items()}
    for shot in shots:
        truths.append(shot.truth)
        scores["prior"].append(score_prior(shot.search))
        for name, matcher in matchers.items():
            scores[name].append(score_shot(shot.ask(matcher), shot.truth, calibrations[name]))
    if not truths:
        return 0, {}
    sources = {name: _chance_source(calibration) for name, calibration in calibrations.items()}
    stacked = np.array(truths)
    return len(truths), {name: summarise_shots(stacked, found, sources.get(name)) for name, found in scores.items()}


def _calibration(matcher: Any) -> Calibration | None:
    """A matcher's calibration if its confidence was fitted."""
    calibration = getattr(matcher, "calibration", None)
    if not isinstance(calibration, Calibration):
        return None
    fitted = (calibration.confidence_slope, calibration.confidence_intercept) != (1.0, 0.0)
    return calibration if fitted else None


def _chance_source(calibration: Calibration | None) -> str:
    return "peak mass" if calibration is None else "calibrated peak mass"


def frames_with_truth(sequence: Sequence, truth: Trajectory, max_frames: int) -> np.ndarray:
    """Indices of at most so many scans, evenly, that ground truth covers; SkyfixError if there is none."""
    first, last = truth.span_ns
    stamps = sequence.stamps_ns
    covered = np.flatnonzero((stamps >= first - STAMP_TOLERANCE_NS) & (stamps <= last + STAMP_TOLERANCE_NS))
    if len(covered) == 0:
        raise SkyfixError(f"{sequence.name}: expected ground truth that overlaps the scans in time, got none")
    return _spread(covered, max_frames)


def _spread(indices: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the indices, evenly."""
    if len(indices) <= most:
        return indices
    return indices[np.linspace(0, len(indices) - 1, most).round().astype(int)]
