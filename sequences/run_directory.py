"""The run directory: everything a tracked drive leaves on disk, written as a whole or not at all.

    config.yaml     what was run, every setting resolved
    metrics.json    see `run_metrics`
    report.html     see `report`
    filter.tum  smoother.tum  odometry.tum  single_shot.tum    poses in the map frame, see `trajectory_io`
    frames.csv      a line per frame: errors, covariance, effective sample size, evidence, lost score, milliseconds a
                    stage
    log.txt         what happened on the way

Files go to a hidden folder beside the target, which is renamed when all of them are there.
"""

from __future__ import annotations

import csv
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.filter_pass import STAGES
from sequences.geojson import write_geojson
from sequences.metrics import position_errors, vehicle_frame_errors
from sequences.report import write_report
from sequences.run_files import CONFIG_FILE, METRICS_FILE, check_target, config_text
from sequences.run_result import FrameRow, RunResult
from sequences.trajectory_io import format_seconds, write_tum


def write_run(result: RunResult, out_dir: Path | str, overwrite: bool = False) -> Path:
    """Write a run directory.

    Parameters
    ----------
    result
        The tracked drive.
    out_dir
        Where to; its parents are made.
    overwrite
        Replace a run that is there.

    Returns
    -------
    Path of report.html.

    Raises
    ------
    SkyfixError
        If the target is taken or cannot be written. Nothing is left behind then.
    """
    out_dir = Path(out_dir)
    check_target(out_dir, overwrite)
    try:
        out_dir.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{out_dir.name}.", dir=out_dir.parent))
    except OSError as error:
        raise SkyfixError(f"{out_dir}: cannot be written: {error.strerror}") from error
    try:
        draft.chmod(0o755)
        _write_files(result, draft)
        _put_in_place(draft, out_dir)
    except OSError as error:
        raise SkyfixError(f"{out_dir}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return out_dir / "report.html"


def _put_in_place(draft: Path, out_dir: Path) -> None:
    if not out_dir.exists():
        draft.rename(out_dir)
        return
    old = draft.with_name(f"{draft.name}.old")
    out_dir.rename(old)
    try:
        draft.rename(out_dir)
    except OSError:
        old.rename(out_dir)
        raise
    shutil.rmtree(old)


def _write_files(result: RunResult, out_dir: Path) -> None:
    config = config_text(result.sequence_name, result.matcher_name, result.settings)
    (out_dir / CONFIG_FILE).write_text(config, encoding="utf-8")
    metrics = json.dumps(result.metrics, indent=1, allow_nan=False)
    (out_dir / METRICS_FILE).write_text(metrics + "\n", encoding="utf-8")
    for name in ("filter", "smoother", "odometry", "single_shot"):
        write_tum(out_dir / f"{name}.tum", getattr(result, name))
    if result.origin_lat_lon is not None:
        write_geojson(result, result.origin_lat_lon, out_dir / "trajectories.geojson")
    _write_frames(result, out_dir / "frames.csv")
    (out_dir / "log.txt").write_text("".join(f"{line}\n" for line in result.log), encoding="utf-8")
    write_report(result, out_dir)


def _write_frames(result: RunResult, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = [_frame_line(result, number, row) for number, row in enumerate(result.frame_rows)]
        writer = csv.DictWriter(file, fieldnames=list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def _frame_line(result: RunResult, number: int, row: FrameRow) -> dict[str, str | int]:
    """One line of frames.csv; what is unknown is empty. Errors are estimate minus truth in the true vehicle's frame."""
    return {
        "index": row.index,
        "t_s": format_seconds(row.stamp_ns),
        "measured": int(row.measured),
        "skipped_reason": row.skipped_reason,
        **_estimate_cells("filter", result.filter, result.truth, number),
        **_estimate_cells("smoother", result.smoother, result.truth, number),
        "effective_sample_size": _cell(row.effective_sample_size),
        "log_evidence": _cell(row.log_evidence),
        "lost_score": _cell(row.lost_score),
        "temperature": _cell(row.temperature),
        "search_half_extent_m": _cell(row.search_half_extent_m),
        "search_half_heading_deg": _cell(
            None if row.search_half_heading_rad is None else np.rad2deg(row.search_half_heading_rad)
        ),
        **{f"{stage}_ms": _cell(row.milliseconds.get(stage)) for stage in STAGES},
    }


def _estimate_cells(name: str, estimate: Trajectory, truth: Trajectory | None, number: int) -> dict[str, str]:
    cells: dict[str, str] = {}
    if truth is not None:
        names = ("error_m", "longitudinal_m", "lateral_m", "heading_deg")
        errors: list[float] | list[None] = [None] * len(names)
        known = truth.within(int(estimate.stamp_ns[number]), int(estimate.stamp_ns[number]))
        if known is not None:
            true_pose, pose = known.poses, estimate.poses[[number]]
            longitudinal, lateral, heading = (float(error[0]) for error in vehicle_frame_errors(true_pose, pose))
            errors = [float(position_errors(true_pose, pose)[0]), longitudinal, lateral, float(np.rad2deg(heading))]
        cells |= {f"{name}_{what}": _cell(error) for what, error in zip(names, errors, strict=True)}
    if estimate.covariances is not None:
        covariance = estimate.covariances[number]
        entries = {"xx": (0, 0), "xy": (0, 1), "xyaw": (0, 2), "yy": (1, 1), "yyaw": (1, 2), "yawyaw": (2, 2)}
        cells |= {f"{name}_cov_{key}": _cell(covariance[at], digits=9) for key, at in entries.items()}
    return cells


def _cell(value: float | np.floating[Any] | None, digits: int = 6) -> str:
    return "" if value is None else f"{float(value):.{digits}g}"
