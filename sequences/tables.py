"""The tables that a person reads in a terminal: one line a method, errors in metres and degrees."""

from __future__ import annotations

import math
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from fusion.odometry_errors import OdometryCalibration

ROWS = {
    "prior": "prior",
    "odometry": "odometry",
    "odometry_from_true_start": "odometry, true start",
    "single_shot": "single shot",
    "filter": "filter",
    "smoother": "smoother",
}
"""metrics.json's methods, in the order shown, and what a person calls them."""
ERROR_COLUMNS = (
    *("mean m", "median m", "rmse m", "max m"),
    *("heading mean °", "heading median °"),
    *("lateral @1 m", "longitudinal @1 m", "heading @1°"),
)
"""Headers of `error_cells`. @1: the share of frames with an error below 1."""

_SHORT = {"longitudinal": "long.", "lateral": "lat.", "heading": "head.", "median": "med."}


def error_cells(summary: dict[str, Any]) -> list[str]:
    """The cells under `ERROR_COLUMNS` of one object of metrics.json."""
    position, heading = summary["position_error_m"], summary["heading_error_deg"]
    return [
        *(f"{position[key]:.2f}" for key in ("mean", "median", "rmse", "max")),
        *(f"{heading[key]:.2f}" for key in ("mean", "median")),
        *(f"{100 * summary[key]['1']:.0f} %" for key in ("lateral_recall", "longitudinal_recall", "heading_recall")),
    ]


def run_table(metrics: dict[str, Any]) -> Table:
    """The methods of a run beside each other; without ground truth, a table with no lines."""
    table = Table(title=run_title(metrics), title_justify="left", box=SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("method", no_wrap=True)
    for column in (*map(_stacked, ERROR_COLUMNS), "ell.\n95 %"):
        table.add_column(column, justify="right", no_wrap=True)
    for key, label in ROWS.items():
        if key in metrics:
            ellipse = metrics[key].get("ellipse95")
            table.add_row(
                label.replace("odometry, ", "↳ "),
                *error_cells(metrics[key]),
                "" if ellipse is None else f"{100 * ellipse:.0f} %",
            )
    return table


def _stacked(header: str) -> str:
    """A header in short words, one below the other, so that eleven columns fit a terminal of 80 characters."""
    for word, short in _SHORT.items():
        header = header.replace(word, short)
    quantity, _, unit = header.partition(" ")
    return f"{quantity}\n{unit}"


def run_title(metrics: dict[str, Any]) -> str:
    """What was run, in one line; what was simulated or emulated is said here."""
    scans = "simulated scans" if metrics["scans_simulated"] else "real scans"
    emulated = " (emulated from the truth)" if metrics["odometry_emulated"] else ""
    return (
        f"{metrics['sequence']}: {metrics['length_m']:.0f} m, "
        f"{metrics['measured_frames']} of {metrics['frames']} {scans} matched by {metrics['matcher']}, "
        f"odometry {metrics['odometry_source']}{emulated}"
    )


def closing_lines(metrics: dict[str, Any]) -> list[str]:
    """What the table does not say: drift, the odometry's constant errors, skipped frames, speed."""
    lines = []
    if "drift" in metrics:
        drift = metrics["drift"]
        lines.append(
            f"smoother: {drift['first_quarter_mean_m']:.2f} m in the first quarter, "
            f"{drift['last_quarter_mean_m']:.2f} m in the last; "
            f"odometry from the true start ends {drift['odometry_final_error_m']:.2f} m off"
        )
    else:
        lines.append("no ground truth: errors are not known")
    lines.append(_calibration_line(OdometryCalibration(**metrics["odometry_calibration"])))
    repeats_m = metrics.get("single_shot_correlation_length_m")
    if repeats_m is not None:
        lines.append(
            f"single shots repeat an error over some {repeats_m:.1f} m: --correlation-length-m tells the filter"
        )
    if metrics["skipped_frames"]:
        lines.append(f"{metrics['skipped_frames']} frames were due but could not be used: see frames.csv and log.txt")
    if metrics["scans_simulated"]:
        lines.append("scans simulated: ray-cast from the map, so errors say nothing about real scans")
    if metrics["odometry_emulated"]:
        lines.append("odometry emulated: the truth with drift added")
    lines.append(f"{metrics['realtime_factor']:.2g} times real time")
    lines += [f"doubtful: {doubt}" for doubt in metrics.get("trust", {}).get("doubts", ())]
    return lines


def _calibration_line(found: OdometryCalibration) -> str:
    return (
        f"smoother: moved the odometry's stamps by {found.clock_offset_s:+.2f} s and its headings by "
        f"{found.heading_lead_s:+.2f} s, {found.heading_lead_m:+.1f} m and "
        f"{-math.degrees(found.mount_yaw_rad):+.2f} degrees, sharpened these by {found.heading_blur_s:.1f} s, "
        f"stretched its distances by {100.0 * math.expm1(found.log_scale):+.1f} %; took its noise as "
        f"{found.along_noise:.1f}, {found.across_noise:.1f} and {found.heading_noise:.1f} of what was assumed along, "
        "across and in heading"
    )
