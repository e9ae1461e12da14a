"""Run directories on disk: whether a folder is one, whether a new one may go there, and what an old one holds."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import yaml

from fusion.errors import SkyfixError
from fusion.odometry_errors import OdometryCalibration
from sequences.track_settings import TrackSettings

METRICS_FILE = "metrics.json"
CONFIG_FILE = "config.yaml"


def check_target(out_dir: Path, overwrite: bool) -> None:
    """Refuse a target that `write_run` would refuse, before any time is spent.

    Raises
    ------
    SkyfixError
        If it exists and is not an empty folder, unless it is a run directory and `overwrite` is set.
    """
    if not out_dir.exists() or (out_dir.is_dir() and not any(out_dir.iterdir())):
        return
    if not is_run_directory(out_dir):
        raise SkyfixError(f"{out_dir}: exists and is not a run directory; choose another --out")
    if not overwrite:
        raise SkyfixError(f"{out_dir}: holds a run already; give --overwrite to replace it, or another --out")


def is_run_directory(path: Path) -> bool:
    """Whether a folder looks like one that `write_run` wrote."""
    return (path / METRICS_FILE).is_file() and (path / CONFIG_FILE).is_file()


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """The content of a run's `metrics.json`; `SkyfixError` when `run_dir` is not a run directory."""
    if not is_run_directory(run_dir):
        raise SkyfixError(f"{run_dir}: expected a run directory ({METRICS_FILE}, {CONFIG_FILE}), found none")
    try:
        metrics: dict[str, Any] = json.loads((run_dir / METRICS_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SkyfixError(f"{run_dir / METRICS_FILE}: cannot be read: {error}") from error
    return metrics


def config_text(sequence_name: str, matcher_name: str, settings: TrackSettings) -> str:
    """The content of a run's `config.yaml`."""
    content = asdict(settings)
    if content["start"] is not None:
        content["start"] = [float(value) for value in content["start"]]  # numpy's would not be written
    return yaml.safe_dump({"sequence": sequence_name, "matcher": matcher_name, **content}, sort_keys=False)


def doubts_of(run_dir: Path) -> list[str]:
    """Why not to believe a run, as it says itself."""
    found: Any = read_metrics(run_dir).get("trust")
    doubts = found.get("doubts") if isinstance(found, dict) else None
    return [str(doubt) for doubt in doubts] if isinstance(doubts, list) else []


def read_calibration(run_dir: Path) -> OdometryCalibration:
    """The odometry's errors that a run has found, for a filter; `SkyfixError` when there are none to be read."""
    found: Any = read_metrics(run_dir).get("filter_calibration")
    try:
        known = {"heading_blur_s": 0.0, **found}  # which runs of earlier versions did not look for
        return OdometryCalibration(**{entry.name: float(known[entry.name]) for entry in fields(OdometryCalibration)})
    except (KeyError, TypeError, ValueError, SkyfixError) as error:
        where = run_dir / METRICS_FILE
        raise SkyfixError(f"{where}: expected the numbers of a filter_calibration, got {found!r}") from error
