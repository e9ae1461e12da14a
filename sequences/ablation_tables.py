"""The tables of an ablation: mean +- standard deviation over seeds, the prior's line first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sequences.ablation_config import Ablation
from sequences.ablation_run import NETWORK, FinishedRun
from sequences.evaluation_tables import PRIOR, start_label
from sequences.over_seeds import cell, markdown_table, mean_and_std, numbers, over_seeds, write_content

_COLUMNS: dict[str, tuple[str, float]] = {
    "mean m": ("position_error_m.mean", 1),
    "median m": ("position_error_m.median", 1),
    "@2 m %": ("position_recall.2", 100),
    "@5 m %": ("position_recall.5", 100),
    "lateral @1 m %": ("lateral_recall.1", 100),
    "longitudinal @1 m %": ("longitudinal_recall.1", 100),
    "heading mean °": ("heading_error_deg.mean", 1),
    "heading median °": ("heading_error_deg.median", 1),
    "@2° %": ("heading_recall.2", 100),
    "@5° %": ("heading_recall.5", 100),
    "NLL": ("likelihood.nll", 1),
    "NLL with floor": ("likelihood.nll_with_floor", 1),
    "in 50 % region": ("likelihood.coverage.50", 100),
    "in 90 % region": ("likelihood.coverage.90", 100),
    "ECE": ("confidence.expected_calibration_error", 1),
}
"""Header -> key of an evaluation's summary, and the unit it is shown in."""
_GRID_KEY, _GRID_TITLE = "position_error_m.mean", "mean position error, m"


def write_tables(out_dir: Path, ablation: Ablation, finished: Sequence[FinishedRun], planned: int) -> None:
    """Write ablation.json and ablation.md, of as many runs as there are; SkyfixError if that fails."""
    content = summary(ablation, finished, planned)
    write_content(out_dir, "ablation", content, markdown(content))


def summary(ablation: Ablation, finished: Sequence[FinishedRun], planned: int) -> dict[str, Any]:
    """Everything for JSON.

    Returns
    -------
    `ablation`, `base` (file names), `runs_done`, `runs_planned`, `grid`; `variants`: {name: {changes, point, seeds,
    steps, parameters, cpu_minutes}}; `tables`: one an evaluation, each with what it is of, `prior` (a summary) and
    `variants`: {name: {dotted key of a summary: {mean, std}}}, std None for a single seed. Steps and parameters are
    of a run; cpu_minutes is {mean, std}.
    """
    by_variant: dict[str, list[FinishedRun]] = {}
    for run in finished:
        by_variant.setdefault(run.run.variant.name, []).append(run)
    variants = {
        name: {
            "changes": dict(runs[0].run.variant.changes),
            "point": runs[0].run.variant.point,
            "seeds": [run.run.seed for run in runs],
            "steps": runs[0].steps,
            "parameters": runs[0].parameters,
            "cpu_minutes": mean_and_std([run.cpu_minutes for run in runs]),
        }
        for name, runs in by_variant.items()
    }
    tables = []
    for number, first in enumerate(finished[0].evaluations):
        told = {key: value for key, value in first.items() if key != "methods"}
        rows = {
            name: over_seeds([run.evaluations[number]["methods"][NETWORK] for run in runs])
            for name, runs in by_variant.items()
        }
        tables.append({**told, "prior": first["methods"][PRIOR], "variants": rows})
    return {
        "ablation": ablation.path.name,
        "base": ablation.base.name,
        "runs_done": len(finished),
        "runs_planned": planned,
        "grid": {key: list(values) for key, values in ablation.grid.items()},
        "variants": variants,
        "tables": tables,
    }


def markdown(content: Mapping[str, Any]) -> str:
    """The tables for a person, from what `summary` gave."""
    done, planned = content["runs_done"], content["runs_planned"]
    legend = (
        f"Variants of {content['base']}, {done} of {planned} runs done. Mean ± standard deviation over seeds, where "
        "there are several. Single shots; NLL and ECE as in `skyfix evaluate`; the prior answers the middle of the "
        "start's box.\n"
    )
    parts = [f"# {content['ablation']}\n", legend, _variants_table(content["variants"])]
    for table in content["tables"]:
        scans = "simulated scans" if table["scans_simulated"] else "real scans"
        frames = table["prior"]["frames"]
        parts.append(f"## {table['sequence']}: {frames} {scans}, start within {start_label(table['start'])}\n")
        parts.append(_scores_table(table))
        if len(content["grid"]) == 2:
            parts.append(_grid_table(content["grid"], content["variants"], table["variants"]))
    return "\n".join(parts)


def _variants_table(variants: Mapping[str, Any]) -> str:
    rows = []
    for name, facts in variants.items():
        changes = ", ".join(f"`{key}: {value}`" for key, value in facts["changes"].items()) or "-"
        seeds = ", ".join(str(seed) for seed in facts["seeds"])
        size = f"{facts['parameters'] / 1e6:.2f} M"
        rows.append([name, changes, size, str(facts["steps"]), cell(facts["cpu_minutes"], 1, 1), seeds])
    return markdown_table(["variant", "changes", "parameters", "steps", "CPU minutes a run", "seeds"], rows, left=2)


def _scores_table(table: Mapping[str, Any]) -> str:
    prior = {key: {"mean": value, "std": None} for key, value in numbers(table["prior"]).items()}
    rows = [
        [name, *(cell(scores.get(key), unit) for key, unit in _COLUMNS.values())]
        for name, scores in {PRIOR: prior, **table["variants"]}.items()
    ]
    return markdown_table(["variant", *_COLUMNS], rows, left=1)


def _grid_table(
    grid: Mapping[str, Sequence[Any]], variants: Mapping[str, Any], scores: Mapping[str, Mapping[str, Any]]
) -> str:
    """One number over the two axes of a grid."""
    (down, across), (down_values, across_values) = grid, grid.values()
    at = {tuple(facts["point"]): scores[name] for name, facts in variants.items() if facts["point"] is not None}
    rows = [
        [f"{left}", *(cell(at.get((left, top), {}).get(_GRID_KEY), 1) for top in across_values)] for left in down_values
    ]
    corner = f"{down.rpartition('.')[2]} \\ {across.rpartition('.')[2]}"
    return f"{_GRID_TITLE}:\n\n" + markdown_table([corner, *map(str, across_values)], rows, left=1)
