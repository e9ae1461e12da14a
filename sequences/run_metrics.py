"""The content of `metrics.json`: every method's errors, what was run, and how long it took.

Same sequence, settings and seed: the same content, bit for bit, but for `seconds_per_frame` and `realtime_factor`.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fusion.odometry_limits import MotionKind
from fusion.trajectory import Trajectory
from sequences.filter_pass import STAGES
from sequences.metrics import after_first_quarter, correlation_length, drift, from_true_start, scored, summarise
from sequences.run_result import RunResult
from sequences.sequence import odometry_is_emulated
from sequences.start import prior_answers
from sequences.trust import trust

TIMING_KEYS = ("seconds_per_frame", "realtime_factor")
"""The only entries that differ between two runs with the same seed."""


def run_metrics(result: RunResult, smoothing_seconds: float) -> dict[str, Any]:
    """Numbers of a run.

    Parameters
    ----------
    result
        The run; its own `metrics` are not looked at.
    smoothing_seconds
        Time that the smoother took over the whole drive.

    Returns
    -------
    The methods `prior`, `odometry`, `odometry_from_true_start`, `single_shot` (measured frames only), `filter`,
    `filter_after_first_quarter` (of the way) and `smoother`, as `metrics.summarise` describes them, `drift`, and
    `single_shot_correlation_length_m`, None where too few scans were matched to say; none of these without ground
    truth, and of the frames that it covers where it does not cover all.
    Always: what was run, whether to believe it (`sequences.trust`), and `seconds_per_frame` by stage, averaged over all
    frames.
    """
    methods = {} if result.truth is None else _methods(result, result.truth)
    rows, jumps = result.frame_rows, result.odometry_doubts.count(MotionKind.RESET)
    seconds = {stage: sum(row.milliseconds.get(stage, 0.0) for row in rows) / 1e3 for stage in STAGES}
    seconds["smooth"] = smoothing_seconds
    # A simulated scan costs what reading one would not.
    processing = sum(value for stage, value in seconds.items() if stage != "scan" or not result.scans_simulated)
    duration = float(result.stamps_ns[-1] - result.stamps_ns[0]) * 1e-9
    return {
        "sequence": result.sequence_name,
        "matcher": result.matcher_name,
        "odometry_source": result.odometry_source,
        "odometry_emulated": odometry_is_emulated(result.odometry_source),
        "scans_simulated": result.scans_simulated,
        "ground_truth": result.truth is not None,
        "seed": result.settings.seed,
        "length_m": round(result.length_m, 3),
        "duration_s": round(duration, 3),
        "frames": len(rows),
        "measured_frames": sum(row.measured for row in rows),
        "skipped_frames": sum(bool(row.skipped_reason) for row in rows),
        "odometry_calibration": asdict(result.odometry_calibration),
        "filter_calibration": asdict(result.filter_calibration),
        "odometry_doubts": {
            "jumps": jumps,
            "gaps": result.odometry_doubts.count(MotionKind.GAP),
            "gap_seconds": result.odometry_doubts.seconds(MotionKind.GAP),
        },
        "trust": asdict(
            trust(rows, result.odometry_calibration, shows_buildings=result.map.shows_buildings, jumps=jumps)
        ),
        **methods,
        "seconds_per_frame": {stage: value / len(rows) for stage, value in seconds.items()},
        "realtime_factor": duration / processing,
    }


def _methods(result: RunResult, truth: Trajectory) -> dict[str, Any]:
    odometry, shots, filtered, smoother = (
        scored(truth, one) for one in (result.odometry, result.single_shot, result.filter, result.smoother)
    )
    assert odometry is not None  # truth is at some of the frames
    assert filtered is not None
    assert smoother is not None
    trajectories = {
        "prior": prior_answers(truth, result.settings, result.prior),
        "odometry": odometry,
        "odometry_from_true_start": from_true_start(truth, odometry),
        **({} if shots is None else {"single_shot": shots}),
        "filter": filtered,
        "filter_after_first_quarter": after_first_quarter(truth, filtered),
        "smoother": smoother,
    }
    methods: dict[str, Any] = {name: _summary(truth, trajectory) for name, trajectory in trajectories.items()}
    methods["drift"] = drift(truth, smoother, odometry)
    methods["single_shot_correlation_length_m"] = (
        None if shots is None else correlation_length(truth.interpolate(shots.stamp_ns), shots.poses)
    )
    return methods


def _summary(truth: Trajectory, estimate: Trajectory) -> dict[str, Any]:
    return summarise(truth.interpolate(estimate.stamp_ns), estimate.poses, estimate.covariances)
