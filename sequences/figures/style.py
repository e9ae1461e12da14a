"""What every figure of a report shares: one colour a method, one cartographic palette, one way to make a figure.

The methods' colours are Okabe and Ito's, told apart by people with any colour vision; line styles differ as well, so
that a grey print still reads. Figures are made through matplotlib's objects, never through pyplot's global state.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class MethodStyle:
    """How one method looks in every figure."""

    label: str
    colour: str
    line: str | tuple[float, tuple[float, ...]]
    width: float
    layer: int


METHODS: dict[str, MethodStyle] = {
    "truth": MethodStyle("ground truth", "#111111", "-", 3.0, 3),
    "prior": MethodStyle("prior", "#CC79A7", "-", 1.6, 4),
    "odometry": MethodStyle("odometry alone", "#D55E00", "--", 1.8, 5),
    "single_shot": MethodStyle("single shot", "#E69F00", "none", 0.0, 6),
    "filter": MethodStyle("filter", "#0072B2", "-", 1.6, 7),
    "smoother": MethodStyle("smoother", "#009E73", (0.0, (3.5, 1.5)), 1.4, 8),
}
"""Colour and line of each method, keyed as in metrics.json."""

INK = "#22262b"
FAINT = "#8a9199"
_DOTS_PER_INCH = 130


def new_figure(width_in: float, height_in: float) -> Figure:
    """Make a figure with a layout that keeps labels apart."""
    return Figure(figsize=(width_in, height_in), dpi=_DOTS_PER_INCH, layout="constrained", facecolor="white")


def png_bytes(figure: Figure) -> bytes:
    """Render to PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    # Straight to the canvas: `savefig` would lay the figure out and draw it twice.
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def tidy(axes: Axes, *, title: str = "", x: str = "", y: str = "") -> None:
    """Give axes the common look: light grid, two spines, title on the left."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.grid(True, which="major", color="#d9dce0", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)


LegendPlace = Literal["best", "upper right", "lower right"]


def legend(axes: Axes, *, where: LegendPlace = "best", columns: int = 1) -> None:
    """Add a legend that lets the curves under it show through."""
    axes.legend(loc=where, ncols=columns, fontsize=8, framealpha=0.88, edgecolor="none")


def corner_note(axes: Axes, text: str) -> None:
    """Write a remark into the upper left corner."""
    box = {"boxstyle": "round,pad=0.3", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    axes.text(0.01, 0.97, text, transform=axes.transAxes, va="top", fontsize=8, color=INK, bbox=box, zorder=20)


def plot_method(axes: Axes, name: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Draw one method in its own style: a line, or dots for single shots (and for a run of one frame)."""
    style = METHODS[name]
    if name == "single_shot" or len(x) == 1:
        axes.plot(x, y, "o", ms=3.2, color=style.colour, alpha=0.75, mew=0, zorder=style.layer, label=style.label)
    else:
        axes.plot(x, y, ls=style.line, lw=style.width, color=style.colour, zorder=style.layer, label=style.label)


def log_axis(axes: Axes) -> None:
    """Make y logarithmic, labelled with plain numbers, with a faint line for every minor tick."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: _minor_label(axes, value)))
    axes.tick_params(axis="y", which="minor", labelsize=7, colors=INK)
    axes.grid(True, which="minor", axis="y", color="#eceef0", linewidth=0.5)


def _minor_label(axes: Axes, value: float) -> str:
    """Label 0.2, 0.5, 2, 5, ... where the axis spans less than two decades."""
    low, high = axes.get_ylim()
    leading = round(value / 10.0 ** np.floor(np.log10(value) + 1e-9))
    return f"{value:g}" if high / low < 100.0 and leading in (2, 5) else ""


def halo(width: float = 3.0) -> list[AbstractPathEffect]:
    """White outline that keeps a mark legible on any background."""
    return [withStroke(linewidth=width, foreground="white")]


def symmetric_limit(*samples: NDArray[np.float64], floor: float) -> float:
    """Find a half range that shows all but the wildest values: 1.4 times the 97th percentile of what is given."""
    sizes = np.abs(np.concatenate([np.zeros(0), *samples]))
    return max(floor, 1.4 * float(np.percentile(sizes, 97))) if sizes.size else floor
