"""The words and tables of a report: verdict, what was simulated, errors by method, milliseconds by stage, settings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sequences.dotted_keys import dotted
from sequences.figures.series import RunSeries
from sequences.figures.style import METHODS
from sequences.run_result import RunResult
from sequences.sequence import odometry_is_emulated

MISSING = "–"
_ESTIMATORS = {
    "prior": ("prior", ""),
    "odometry": ("odometry", ""),
    "odometry_from_true_start": ("odometry", ", begun at the truth"),
    "single_shot": ("single_shot", ""),
    "filter": ("filter", ""),
    "filter_after_first_quarter": ("filter", ", after first quarter"),
    "smoother": ("smoother", ""),
}
"""metrics.json's methods in the order shown: the style that each is drawn in, and what is said besides its label."""
_RECALLS = ("lateral_recall", "longitudinal_recall", "heading_recall")
_THRESHOLDS = ("1", "3", "5")


@dataclass(frozen=True, slots=True)
class Card:
    """One number that a reader should see first."""

    value: str
    label: str


@dataclass(frozen=True, slots=True)
class MethodRow:
    """One method's line in the table, cells already formatted in the order of the template's header."""

    label: str
    colour: str
    cells: list[str]


@dataclass(frozen=True, slots=True)
class StageRow:
    """Time that one stage took: mean and 95th percentile in milliseconds over `frames`, share of all stages' time."""

    name: str
    mean_ms: float
    p95_ms: float
    frames: int
    share: float


def verdict(result: RunResult, series: RunSeries) -> str:
    """Say in one line how it went, and whatever speaks against believing it."""
    return " Doubtful: ".join([_outcome(result, series), *result.metrics["trust"]["doubts"]])


def _outcome(result: RunResult, series: RunSeries) -> str:
    length = f"{result.length_m:,.0f} m"
    if "filter" not in series.errors:
        return f"{length} tracked; there is no ground truth, so the errors are not known."
    mean_m = series.errors["filter"].position_m.mean()
    end_m = result.metrics["drift"]["odometry_final_error_m"]
    return (
        f"Filter: {mean_m:.2f} m mean error over {length}; odometry alone, begun at the truth, ends {end_m:.1f} m off."
    )


def cards(result: RunResult, series: RunSeries) -> list[Card]:
    """Choose the numbers that head the report."""
    found = [Card(f"{result.length_m:,.0f} m", "driven")]
    for name in ("filter", "smoother"):
        if name in series.errors:
            errors = series.errors[name]
            heading_deg = np.rad2deg(np.abs(errors.signed[:, 2]).mean())
            found.append(Card(f"{errors.position_m.mean():.2f} m", f"{name}, mean position error"))
            found.append(Card(f"{heading_deg:.2f}°", f"{name}, mean heading error"))
    if "drift" in result.metrics:
        end_m = result.metrics["drift"]["odometry_final_error_m"]
        found.append(Card(f"{end_m:.1f} m", "odometry's drift at the end"))
    factor = result.metrics["realtime_factor"]
    return [*found, Card(f"{factor:.1f}×", "real time")]


def provenance(result: RunResult) -> list[str]:
    """State what was measured, what was simulated and what the run was told to start with."""
    scans = "simulated: ray-cast from the map, not measured" if result.scans_simulated else "measured by a LiDAR"
    emulated = odometry_is_emulated(result.odometry_source)
    odometry = "emulated: made from the ground truth with drift added" if emulated else "as given with the sequence"
    doubts = f"; {result.odometry_doubts}" if len(result.odometry_doubts) else ""
    prior = result.prior
    heading = np.rad2deg(prior.half_heading_rad)
    known = "heading unknown" if heading >= 180.0 else f"heading within ±{heading:g}°"
    measured = sum(row.measured for row in result.frame_rows)
    skipped = sum(bool(row.skipped_reason) for row in result.frame_rows)
    unusable = f", {skipped} more could not be" if skipped else ""
    truth = "none: no errors are given"
    if result.truth is not None:
        truth = "compared in the map frame, with no alignment"
        frames = len(result.frame_rows)
        truth += f", at the {len(result.truth)} of {frames} frames that it covers" * (len(result.truth) < frames)
    return [
        f"LiDAR scans: {scans}.",
        f"Odometry '{result.odometry_source}': {odometry}{doubts}.",
        f"Start: position within ±{prior.half_extent_m:g} m in x and y, {known}; the odometry begins at its middle.",
        f"Matcher '{result.matcher_name}': {measured} of {len(result.frame_rows)} scans matched{unusable}.",
        f"Ground truth: {truth}.",
    ]


def method_rows(result: RunResult) -> list[MethodRow]:
    """Format metrics.json's object of each method that has one."""
    rows = []
    for name, (method, besides) in _ESTIMATORS.items():
        summary = result.metrics.get(name)
        if summary:
            rows.append(MethodRow(METHODS[method].label + besides, METHODS[method].colour, _cells(summary)))
    return rows


def _cells(summary: dict[str, Any]) -> list[str]:
    position, heading = summary["position_error_m"], summary["heading_error_deg"]
    cells = [f"{position[key]:.2f}" for key in ("mean", "median", "rmse", "max")]
    cells += [f"{heading[key]:.2f}" for key in ("mean", "median", "max")]
    cells += [" / ".join(f"{100 * summary[recall][limit]:.0f}" for limit in _THRESHOLDS) for recall in _RECALLS]
    nees = summary.get("nees")
    cells += [f"{nees['mean']:.2f}", f"{100 * nees['coverage95']:.0f} %"] if nees else [MISSING, MISSING]
    return [*cells, f"{summary['frames']:,}"]


def stage_rows(result: RunResult) -> list[StageRow]:
    """Summarise the milliseconds of every stage over the frames that had it, slowest in total first."""
    by_stage: dict[str, list[float]] = {}
    for row in result.frame_rows:
        for stage, milliseconds in row.milliseconds.items():
            by_stage.setdefault(stage, []).append(milliseconds)
    by_stage["smooth"] = [1e3 * result.metrics["seconds_per_frame"]["smooth"]] * len(result.frame_rows)
    total = sum(sum(times) for times in by_stage.values())
    rows = [
        StageRow(
            name="scan (simulated)" if stage == "scan" and result.scans_simulated else stage,
            mean_ms=float(np.mean(times)),
            p95_ms=float(np.percentile(times, 95)),
            frames=len(times),
            share=sum(times) / total if total > 0.0 else 0.0,
        )
        for stage, times in by_stage.items()
    ]
    return sorted(rows, key=lambda row: -row.share)


def settings_rows(result: RunResult) -> list[tuple[str, str]]:
    """Flatten the resolved settings to (name, value) lines."""
    rows = [("sequence", result.sequence_name), ("matcher", result.matcher_name)]
    return [*rows, *((name, _shown(value)) for name, value in dotted(asdict(result.settings)).items())]


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else MISSING if value is None else str(value)
