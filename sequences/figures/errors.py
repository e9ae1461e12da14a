"""How far off each method is along the drive."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sequences.figures.series import FloatArray, RunSeries
from sequences.figures.style import legend, log_axis, new_figure, plot_method, tidy

_SMALLEST_SHOWN = {"m": 0.02, "deg": 0.01}


def error_figure(series: RunSeries) -> Figure:
    """Draw position and heading errors against the distance travelled; log axes show metres and centimetres alike."""
    figure = new_figure(12.0, 7.0)
    position, heading = figure.subplots(2, 1, sharex=True, height_ratios=[1.35, 1.0])
    for name, errors in series.errors.items():
        _plot(position, name, errors.distance_m, errors.position_m, _SMALLEST_SHOWN["m"])
        _plot(heading, name, errors.distance_m, np.rad2deg(np.abs(errors.signed[:, 2])), _SMALLEST_SHOWN["deg"])
    tidy(position, title="Position error against ground truth, no alignment", y="error (m, log)")
    tidy(heading, title="Heading error", x="distance travelled (m)", y="error (°, log)")
    for axes in (position, heading):
        log_axis(axes)
    position.margins(y=0.16)
    legend(position, where="upper right", columns=4)
    return figure


def _plot(axes: Axes, name: str, distance_m: FloatArray, error: FloatArray, smallest: float) -> None:
    plot_method(axes, name, distance_m, np.maximum(error, smallest))
