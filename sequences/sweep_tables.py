"""The tables and the picture of a sweep: one for every drive and odometry, its variants beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fusion.errors import SkyfixError
from sequences.figures.style import png_bytes
from sequences.figures.sweep import sweep_figure
from sequences.over_seeds import cell, markdown_table, over_seeds, write_content
from sequences.run_files import is_run_directory, read_metrics
from sequences.sweep_plan import SweepRun, matcher_label
from sequences.tables import ROWS

_COLUMNS: dict[str, tuple[str, float]] = {
    "mean m": ("position_error_m.mean", 1),
    "median m": ("position_error_m.median", 1),
    "max m": ("position_error_m.max", 1),
    "heading mean °": ("heading_error_deg.mean", 1),
    "lateral @1 m %": ("lateral_recall.1", 100),
    "longitudinal @1 m %": ("longitudinal_recall.1", 100),
    "in the 95 % ellipse %": ("ellipse95", 100),
    "NEES (3 expected)": ("nees.mean", 1),
}
"""Header -> key of a method in metrics.json, and the unit it is shown in."""
_ROWS = {name: label for name, label in ROWS.items() if name != "smoother"}
_ROWS |= {"filter_after_first_quarter": "filter, after first quarter", "smoother": ROWS["smoother"]}
_SAME_FOR_ALL = ("prior", "odometry", "odometry_from_true_start")


def write_sweep(out_dir: Path, runs: Sequence[SweepRun], failed: Mapping[str, str]) -> None:
    """Write sweep.json, sweep.md and sweep.png of the runs that are on disk; SkyfixError if that fails."""
    content = summary(runs, failed)
    write_content(out_dir, "sweep", content, markdown(content))
    if content["tables"]:
        partial = out_dir / "sweep.png.part"
        try:
            partial.write_bytes(png_bytes(sweep_figure(content["tables"])))
            partial.replace(out_dir / "sweep.png")
        except OSError as error:
            raise SkyfixError(f"{out_dir / 'sweep.png'}: cannot be written: {error.strerror}") from error


def summary(runs: Sequence[SweepRun], failed: Mapping[str, str]) -> dict[str, Any]:
    """Everything for JSON.

    Returns
    -------
    `runs_done`, `runs_planned`, `failed`: {label: reason}; `tables`: one a drive and odometry, each with `sequence`,
    `odometry`, `length_m`, `frames`, `scans_simulated`, `odometry_emulated` and `variants`: {name: {matcher, changes,
    seeds, methods: {method: {dotted key of metrics.json: {mean, std}}}, doubts: {seed: [why not to believe it]}}}`, std
    None for a single seed.
    """
    done = [(run, read_metrics(run.folder)) for run in runs if is_run_directory(run.folder)]
    tables: dict[tuple[str, str], dict[str, Any]] = {}
    together: dict[tuple[str, str, str], list[tuple[SweepRun, dict[str, Any]]]] = {}
    for run, metrics in done:
        where = run.name, run.settings.odometry
        keys = ("length_m", "frames", "scans_simulated", "odometry_emulated")
        told = {key: metrics[key] for key in keys}
        tables.setdefault(where, {"sequence": where[0], "odometry": where[1], **told, "variants": {}})
        together.setdefault((*where, run.variant), []).append((run, metrics))
    for (sequence, odometry, variant), each in together.items():
        first = each[0][0]
        tables[sequence, odometry]["variants"][variant] = {
            "matcher": matcher_label(first.matcher),
            "changes": dict(first.changes),
            "seeds": [run.settings.seed for run, _ in each],
            "methods": _methods([metrics for _, metrics in each]),
            "doubts": {str(run.settings.seed): metrics["trust"]["doubts"] for run, metrics in each},
        }
    return {
        "runs_done": len(done),
        "runs_planned": len(runs),
        "failed": dict(failed),
        "tables": list(tables.values()),
    }


def _methods(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The methods that every run has, over seeds."""
    return {name: over_seeds([run[name] for run in runs]) for name in _ROWS if all(name in run for run in runs)}


def markdown(content: Mapping[str, Any]) -> str:
    """The tables for a person, from what `summary` gave."""
    legend = (
        f"{content['runs_done']} of {content['runs_planned']} runs done. Mean ± standard deviation over seeds, where "
        "there are several; errors against the ground truth, nothing aligned. @1 m: the share of frames with an error "
        "below 1 m. 'Prior' answers the middle of the box that the start is known to lie in, 'odometry' starts there, "
        "'odometry, true start' at the true first pose.\n"
    )
    parts = ["# Sweep\n", legend]
    if content["failed"]:
        parts.append("Failed:\n")
        parts += [f"- {label}: {reason}" for label, reason in content["failed"].items()]
        parts.append("")
    for table in content["tables"]:
        scans = "simulated" if table["scans_simulated"] else "real"
        emulated = " (emulated from the truth)" if table["odometry_emulated"] else ""
        parts.append(
            f"## {table['sequence']}: {table['length_m']:.0f} m, {table['frames']} frames, {scans} scans, "
            f"odometry {table['odometry']}{emulated}\n"
        )
        parts.append(_table(table["variants"]))
        doubts = [
            f"- {name}, seed {seed}: doubtful: {doubt}"
            for name, facts in table["variants"].items()
            for seed, of_run in facts["doubts"].items()
            for doubt in of_run
        ]
        parts += [*doubts, ""] if doubts else []
    return "\n".join(parts)


def _table(variants: Mapping[str, Any]) -> str:
    """A line a method and variant; what the variants have in common is said once."""
    rows = []
    for method, label in _ROWS.items():
        scores = {name: facts["methods"][method] for name, facts in variants.items() if method in facts["methods"]}
        if method in _SAME_FOR_ALL and all(each == next(iter(scores.values())) for each in scores.values()):
            scores = {"-": next(iter(scores.values()))}
        for name, each in scores.items():
            rows.append([label, name, *(cell(each.get(key), unit) for key, unit in _COLUMNS.values())])
    return markdown_table(["method", "matcher, settings", *_COLUMNS], rows, left=2)
