"""Where everybody went: trajectories over the map, with close-ups of the start and of the filter's worst moment."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sequences.figures.map_drawing import draw_map, draw_prior, north_arrow, scale_bar
from sequences.figures.series import RunSeries, trajectories_of
from sequences.figures.style import INK, halo, legend, new_figure, plot_method, tidy
from sequences.metrics import scored
from sequences.run_result import RunResult

FloatArray = NDArray[np.float64]
Box = tuple[float, float, float, float]
"""(left, right, bottom, top), metres."""

_SETTLED_SHARE = 0.25
_CLOSE_UP_HALF_M = 14.0


def trajectories_figure(result: RunResult, series: RunSeries) -> Figure:
    """Draw the map with every trajectory, the prior's box, a scale bar and two close-ups; north is up."""
    overview = _overview_box(result)
    aspect = (overview[1] - overview[0]) / (overview[3] - overview[2])
    if aspect > 1.5:
        figure = new_figure(12.0, 12.0 / aspect + 5.6)
        rows = figure.subplot_mosaic([["all", "all"], ["start", "worst"]], height_ratios=[12.0 / aspect, 5.6])
    else:
        figure = new_figure(12.0, float(np.clip(7.9 / aspect + 0.7, 6.6, 13.0)))
        rows = figure.subplot_mosaic([["all", "start"], ["all", "worst"]], width_ratios=[2.06, 1.0])
    panels = {
        "all": (overview, "Trajectories over the map"),
        "start": (_start_box(result), "The start"),
        "worst": _worst_box(result, series),
    }
    for name, (box, title) in panels.items():
        _draw_panel(rows[name], result, box, title, overview=name == "all")
    return figure


def _draw_panel(axes: Axes, result: RunResult, box: Box, title: str, *, overview: bool) -> None:
    draw_map(axes, result.map)
    if result.truth is not None:
        plot_method(axes, "truth", *_xy(result.truth.poses))
    for name, trajectory in trajectories_of(result).items():
        plot_method(axes, name, *_xy(trajectory.poses))
    draw_prior(axes, result.prior)
    path = result.filter.poses
    for pose, marker, word in ((path[-1], "s", "end"), (path[0], "o", "start")):
        axes.plot(*pose[:2], marker, ms=7, mfc="white", mec=INK, mew=1.4, zorder=12)
        if overview:
            axes.annotate(
                word, pose[:2], xytext=(8, 6), textcoords="offset points", color=INK, zorder=12, path_effects=halo()
            )
    tidy(axes, title=title, x="x, east (m)", y="y, north (m)")
    axes.grid(False)
    axes.set_xlim(box[0], box[1])
    axes.set_ylim(box[2], box[3])
    axes.set_aspect("equal")
    scale_bar(axes)
    if overview:
        legend(axes)
        north_arrow(axes)


def _xy(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    return poses[:, 0], poses[:, 1]


def _overview_box(result: RunResult) -> Box:
    """Box of the path and the prior, grown towards the odometry but by no more than half its own size."""
    half = result.prior.half_extent_m
    known = [result.filter.poses[:, :2], result.prior.centre[:2] + half * np.array([[-1.0], [1.0]])]
    if result.truth is not None:
        known.append(result.truth.poses[:, :2])
    points = np.concatenate(known)
    low, high = points.min(axis=0), points.max(axis=0)
    slack = 0.5 * (high - low)
    drifted = np.clip(result.odometry.poses[:, :2], low - slack, high + slack)
    low, high = np.minimum(low, drifted.min(axis=0)), np.maximum(high, drifted.max(axis=0))
    margin = max(10.0, 0.05 * float((high - low).max()))
    # Half the longer side at least, so that a straight drive does not become a ribbon.
    middle, size = (low + high) / 2, high - low + 2 * margin
    size = np.maximum(size, 0.5 * size.max())
    low, high = middle - size / 2, middle + size / 2
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _start_box(result: RunResult) -> Box:
    half = 1.35 * result.prior.half_extent_m
    x, y = (float(value) for value in result.prior.centre[:2])
    return x - half, x + half, y - half, y + half


def _worst_box(result: RunResult, series: RunSeries) -> tuple[Box, str]:
    """Close-up of the filter's largest error after the first quarter, when it should have settled.

    Without truth: of where it is least sure.
    """
    settled_m = _SETTLED_SHARE * series.distance_m[-1]
    poses = result.filter.poses[series.distance_m >= settled_m]
    errors = series.errors.get("filter")
    known = None if result.truth is None else scored(result.truth, result.filter)
    if errors is not None and known is not None and (errors.distance_m >= settled_m).any():
        after = errors.distance_m >= settled_m
        poses, off_m = known.poses[after], errors.position_m[after]
        at, title = int(off_m.argmax()), f"Worst after a quarter: {off_m.max():.2f} m"
    elif result.filter.covariances is not None:
        spread = np.trace(result.filter.covariances[-len(poses) :, :2, :2], axis1=1, axis2=2)
        at, title = int(spread.argmax()), "Least sure after a quarter"
    else:
        at, title = len(poses) - 1, "The end"
    x, y = (float(value) for value in poses[at, :2])
    half = _CLOSE_UP_HALF_M
    return (x - half, x + half, y - half, y + half), title
