"""Whether the claimed uncertainty is true: bands against signed errors, NEES against chi-square bounds, coverage."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from scipy.stats import chi2

from fusion.consistency import coverage
from sequences.figures.series import FloatArray, RunSeries
from sequences.figures.style import (
    FAINT,
    INK,
    METHODS,
    corner_note,
    legend,
    log_axis,
    new_figure,
    plot_method,
    symmetric_limit,
    tidy,
)

DEGREES_OF_FREEDOM = 3
_COMPONENTS = (("longitudinal", "m", 0.5), ("lateral", "m", 0.5), ("heading", "°", 0.5))
_SMALLEST_SHOWN = 0.02
_LEVELS = np.linspace(0.02, 0.98, 49)


def covariance_figure(series: RunSeries) -> Figure:
    """Draw each component's signed error inside the 1- and 2-sigma bands that were claimed for it."""
    figure = new_figure(12.0, 7.5)
    panels = figure.subplots(3, len(series.claims), sharex=True, sharey="row", squeeze=False)
    for row, (component, unit, floor) in enumerate(_COMPONENTS):
        scale = np.rad2deg(1.0) if unit == "°" else 1.0
        limit = _axis_limit(series, row, scale, floor)
        for column, (name, claim) in enumerate(series.claims.items()):
            axes, errors = panels[row, column], series.errors[name]
            _draw_band(axes, name, errors.distance_m, scale * errors.signed[:, row], scale * claim.sigma[:, row])
            outside = np.abs(scale * errors.signed[:, row]) > limit
            tidy(axes, title=f"{METHODS[name].label}: {component}", y=f"error ({unit})" if column == 0 else "")
            if outside.any():
                corner_note(axes, f"{100 * outside.mean():.1f} % of errors beyond the axis")
        panels[row, 0].set_ylim(-limit, limit)
    for axes in panels[-1]:
        axes.set_xlabel("distance travelled (m)", fontsize=9)
    legend(panels[0, 0], where="lower right", columns=3)
    return figure


def nees_figure(series: RunSeries) -> Figure:
    """Draw NEES along the drive with the 95 % interval of chi-square(3), and empirical against nominal coverage."""
    figure = new_figure(12.0, 4.6)
    along, levels = figure.subplots(1, 2, width_ratios=[2.3, 1.0])
    low, high = chi2.ppf([0.025, 0.975], DEGREES_OF_FREEDOM)
    along.axhspan(low, high, color="#e3ecf4", zorder=0, label="95 % interval of $\\chi^2_3$")
    along.axhline(DEGREES_OF_FREEDOM, color=FAINT, lw=1.0, ls=":", zorder=1, label="expected, 3")
    levels.plot([0, 1], [0, 1], color=FAINT, lw=1.0, ls=":")
    for name, claim in series.claims.items():
        plot_method(along, name, series.errors[name].distance_m, np.maximum(claim.nees, _SMALLEST_SHOWN))
        empirical = np.array([coverage(claim.nees, DEGREES_OF_FREEDOM, float(level)) for level in _LEVELS])
        plot_method(levels, name, _LEVELS, empirical)
    log_axis(along)
    tidy(along, title="NEES of (x, y, heading)", x="distance travelled (m)", y="NEES (log)")
    tidy(levels, title="Coverage", x="claimed", y="found")
    for axis in (levels.xaxis, levels.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    levels.set(xlim=(0, 1), ylim=(0, 1.01), aspect="equal")
    for x, y, word in ((0.25, 0.85, "too cautious"), (0.75, 0.15, "too sure")):
        levels.text(x, y, word, ha="center", va="center", fontsize=9, color=FAINT)
    along.set_ylim(_SMALLEST_SHOWN, 5.0 * max(high, *(float(claim.nees.max()) for claim in series.claims.values())))
    legend(along, where="upper right", columns=4)
    return figure


def _axis_limit(series: RunSeries, component: int, scale: float, floor: float) -> float:
    """Half range that keeps the settled run legible: the wide start may leave the axis."""
    misses = [scale * series.errors[name].signed[:, component] for name in series.claims]
    bands = [2.0 * scale * claim.sigma[:, component] for claim in series.claims.values()]
    return symmetric_limit(*misses, *[np.minimum(band, 3 * np.median(band)) for band in bands], floor=floor)


def _draw_band(axes: Axes, name: str, distance_m: FloatArray, error: FloatArray, sigma: FloatArray) -> None:
    colour = METHODS[name].colour
    for width, alpha in ((2.0, 0.16), (1.0, 0.22)):
        label = f"{width:g} sigma"
        axes.fill_between(distance_m, -width * sigma, width * sigma, color=colour, alpha=alpha, lw=0, label=label)
    axes.plot(distance_m, error, color=INK, lw=0.9, label="error")
    axes.axhline(0.0, color=FAINT, lw=0.6)
