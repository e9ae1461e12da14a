"""A sweep at a glance: the mean error of each method over the variants, one panel a drive and odometry."""

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
    across = min(_MOST_ACROSS, len(tables))
    down = math.ceil(len(tables) / across)
    widest = max(len(table["variants"]) for table in tables)
    figure = new_figure(across * min(4.0 + 0.9 * widest, 14.0), 4.2 * down)
    panels = figure.subplots(down, across, squeeze=False)
    for number, axes in enumerate(panels.flat):
        if number < len(tables):
            _draw(axes, tables[number])
        else:
            axes.set_visible(False)
    legend(panels[0, 0])
    return figure


def _draw(axes: Axes, table: Mapping[str, Any]) -> None:
    names = list(table["variants"])
    at = range(len(names))
    for method in _SHOWN:
        style = METHODS[method]
        spreads = [table["variants"][name]["methods"][method]["position_error_m.mean"] for name in names]
        means = [max(spread["mean"], _SMALLEST_M) for spread in spreads]
        half = [spread["std"] or 0.0 for spread in spreads]
        down = [min(size, mean - _SMALLEST_M) for size, mean in zip(half, means, strict=True)]  # the axis has no zero
        axes.errorbar(
            at,
            means,
            yerr=(down, half),
            fmt="o-" if len(names) > 1 else "o",
            color=style.colour,
            ms=4.5,
            lw=1.0,
            capsize=3.0,
            label=style.label,
            zorder=style.layer,
        )
    axes.set_xticks(list(at), ["\n".join(textwrap.wrap(name, _LABEL_WIDTH)) for name in names])
    axes.margins(x=0.5 / max(len(names), 1))
    emulated = " (emulated)" if table["odometry_emulated"] else ""
    scans = "simulated" if table["scans_simulated"] else "real"
    tidy(axes, title=f"{table['sequence']}, {scans} scans, {table['odometry']}{emulated}", y="mean error (m, log)")
    log_axis(axes)
