"""A sweep at a glance: the mean error of each method, one panel a drive, its odometries and variants side by side."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sequences.figures.style import METHODS, legend, log_axis, new_figure, tidy

_MOST_ACROSS = 2
_LABEL_WIDTH = 16
_SHOWN = ("odometry", "single_shot", "filter", "smoother")
_SMALLEST_M = 0.01


def sweep_figure(tables: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the tables of `sequences.sweep_tables.summary`; bars are a standard deviation over seeds to both sides."""
    drives: dict[str, list[Mapping[str, Any]]] = {}
    for table in tables:
        drives.setdefault(table["sequence"], []).append(table)
    across = min(_MOST_ACROSS, len(drives))
    down = math.ceil(len(drives) / across)
    widest = max(sum(len(table["variants"]) for table in of_drive) for of_drive in drives.values())
    figure = new_figure(across * min(4.0 + 0.9 * widest, 16.0), 4.2 * down)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, of_drive in zip(panels, drives.values(), strict=False):
        _draw(axes, of_drive)
    for axes in panels[len(drives) :]:
        axes.set_visible(False)
    legend(panels[0])
    return figure


def _draw(axes: Axes, tables: Sequence[Mapping[str, Any]]) -> None:
    """One drive: the variants of an odometry are joined by a line."""
    labels: list[str] = []
    for table in tables:
        first, names = len(labels), list(table["variants"])
        for method in _SHOWN:
            if not all(method in table["variants"][name]["methods"] for name in names):
                continue
            spreads = [table["variants"][name]["methods"][method]["position_error_m.mean"] for name in names]
            _plot(axes, method, first, spreads, is_labelled=first == 0)
        labels += [
            _label(table["odometry"] if len(tables) > 1 else "", name if len(names) > 1 else "") for name in names
        ]
    if len(labels) == 1:
        labels = [_label(tables[0]["odometry"], next(iter(tables[0]["variants"])))]
    axes.set_xticks(range(len(labels)), labels)
    axes.margins(x=0.5 / len(labels))
    scans = "simulated" if tables[0]["scans_simulated"] else "real"
    tidy(axes, title=f"{tables[0]['sequence']}, {scans} scans", y="mean error (m, log)")
    log_axis(axes)


def _plot(axes: Axes, method: str, first: int, spreads: Sequence[Mapping[str, Any]], *, is_labelled: bool) -> None:
    style = METHODS[method]
    means = [max(spread["mean"], _SMALLEST_M) for spread in spreads]
    half = [spread["std"] or 0.0 for spread in spreads]
    down = [min(size, mean - _SMALLEST_M) for size, mean in zip(half, means, strict=True)]  # the axis has no zero
    axes.errorbar(
        range(first, first + len(means)),
        means,
        yerr=(down, half),
        fmt="o-" if len(means) > 1 else "o",
        color=style.colour,
        ms=4.5,
        lw=1.0,
        capsize=3.0,
        label=style.label if is_labelled else None,
        zorder=style.layer,
    )


def _label(odometry: str, variant: str) -> str:
    """One below the other, in short lines."""
    return "\n".join(
        line
        for part in (odometry, variant)
        if part
        for line in textwrap.wrap(part, _LABEL_WIDTH, break_long_words=False)
    )
