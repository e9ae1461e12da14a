"""The table of single-shot evaluations: a line a sequence, start and method, the prior's first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from learned.own_matcher import own_matcher_named

PRIOR = "prior"
_HEADER = (
    *("sequence", "start", "method", "frames", "mean m", "median m", "heading mean °", "heading median °"),
    *("lateral @1/3/5 m", "longitudinal @1/3/5 m", "heading @1/3/5°", "position @2/5 m"),
    *("NLL", "NLL with floor", "in 50/90 % region", "ECE"),
)
_TABLE_LIMITS = ("1", "3", "5")
_NOTE = (
    "Shares of frames in per cent: errors below so many metres or degrees, lateral and longitudinal in the true "
    "vehicle's frame; true poses in the highest-density regions of 50 and 90 %. "
    "NLL: mean negative log density of the true pose per m² rad; with floor: of the mixture that a filter takes, "
    "{floor:g} % uniform. ECE: expected calibration error of the stated chance that the best mode is within 5 m "
    "(the mode's mass, calibrated where the checkpoint says how). "
    "The prior answers the middle of the start's box, and its density is uniform in the box."
)


def markdown_table(evaluations: Sequence[dict[str, Any]]) -> str:
    """Evaluations as one Markdown table, a line a sequence, start and method."""
    lines = ["| " + " | ".join(_HEADER) + " |", "|---|---|---|" + "---:|" * (len(_HEADER) - 3)]
    for evaluation in evaluations:
        label = evaluation["sequence"] + (" (scans simulated)" if evaluation["scans_simulated"] else "")
        start = start_label(evaluation["start"])
        for name, summary in evaluation["methods"].items():
            lines.append("| " + " | ".join([label, start, name, *_cells(summary)]) + " |")
    return "\n".join(lines) + "\n"


def markdown_page(evaluations: Sequence[dict[str, Any]], matchers: dict[str, str]) -> str:
    """The table with what its columns are and which matchers were asked, for a file of its own.

    `matchers`: label -> name or file, as `matcher_labels` gives it.
    """
    floor = 100 * evaluations[0]["methods"][PRIOR]["likelihood"]["outlier_probability"]
    files = [f"- {label}: `{name}`" for label, name in matchers.items() if label != name]
    parts = ["# Single shots\n", markdown_table(evaluations), _NOTE.format(floor=floor) + "\n"]
    return "\n".join([*parts, *(["\n".join(files) + "\n"] if files else [])])


def start_label(start: dict[str, float]) -> str:
    """The start's box in words."""
    heading = start["half_heading_deg"]
    return f"±{start['half_extent_m']:g} m, " + ("any heading" if heading >= 180 else f"±{heading:g}°")


def matcher_labels(names: Sequence[str]) -> dict[str, str]:
    """Short labels -> the names or checkpoint files that were given; a file is called by its stem if that is enough.

    Otherwise files are called by their folders too, and if that does not tell them apart either, by their paths.
    """
    distinct = list(dict.fromkeys(names))
    for folders in (0, 1):
        labels = {_label(name, folders): name for name in distinct}
        if len(labels) == len(distinct) and PRIOR not in labels:
            return labels
    return {name: name for name in distinct}


def _label(name: str, folders: int) -> str:
    own = own_matcher_named(name)
    if own is not None:
        return own.label if folders == 0 else name
    path = Path(name).with_suffix("")
    return "/".join(path.parts[-1 - folders :]) if name.endswith(".safetensors") else name


def _cells(summary: dict[str, Any]) -> list[str]:
    position, heading, likelihood = (summary[key] for key in ("position_error_m", "heading_error_deg", "likelihood"))
    coverage, confidence = likelihood["coverage"], summary.get("confidence")
    return [
        str(summary["frames"]),
        *(f"{errors[key]:.2f}" for errors in (position, heading) for key in ("mean", "median")),
        *(_shares(summary[f"{name}_recall"], _TABLE_LIMITS) for name in ("lateral", "longitudinal", "heading")),
        _shares(summary["position_recall"], ("2", "5")),
        *(f"{likelihood[key]:.2f}" for key in ("nll", "nll_with_floor")),
        "-" if coverage is None else _shares(coverage, ("50", "90")),
        "-" if confidence is None else f"{confidence['expected_calibration_error']:.2f}",
    ]


def _shares(shares: dict[str, float], keys: Sequence[str]) -> str:
    return " / ".join(f"{100 * shares[key]:.0f}" for key in keys)
