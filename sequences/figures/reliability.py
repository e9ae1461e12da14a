"""Whether a calibrated matcher is to be believed: its stated chances and its credible regions against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from learned.reliability import Reliability
from sequences.figures.style import FAINT, METHODS, corner_note, new_figure, tidy


def reliability_figure(confidence: Reliability, levels: NDArray[np.float64]) -> Figure:
    """Draw the reliability diagram, and how many truths lie within the highest-density regions of every mass.

    Parameters
    ----------
    confidence
        Stated chances against found ones.
    levels
        (N,) `learned.reliability.highest_density_level` of each truth.
    """
    figure = new_figure(9.0, 4.4)
    diagram, regions = figure.subplots(1, 2)
    colour = METHODS["single_shot"].colour
    used = confidence.count > 0
    sizes = 20.0 + 200.0 * confidence.count[used] / confidence.count.sum()
    diagram.scatter(confidence.stated[used], confidence.found[used], s=sizes, color=colour, zorder=3)
    ordered = np.sort(levels)
    regions.step(np.append(ordered, 1.0), np.append(np.arange(len(ordered)) / len(ordered), 1.0), color=colour)
    tidy(diagram, title="Chance of being right", x="stated", y="found")
    tidy(regions, title="Truths within the region", x="mass of the region", y="found")
    corner_note(diagram, f"expected calibration error {100 * confidence.expected_calibration_error:.1f} %")
    for axes in (diagram, regions):
        axes.plot([0, 1], [0, 1], color=FAINT, lw=1.0, ls=":")
        axes.set(xlim=(0, 1.01), ylim=(0, 1.01), aspect="equal")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return figure
