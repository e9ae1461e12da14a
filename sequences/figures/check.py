"""A drive before it is tracked: its paths over the map, and scans where the ground truth says they were taken."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fusion import se2
from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.drive import STAMP_TOLERANCE_NS, load_drive
from sequences.figures.map_drawing import draw_map, north_arrow, scale_bar
from sequences.figures.style import INK, METHODS, halo, legend, new_figure, tidy
from sequences.metrics import from_true_start, scored
from sequences.sequence import Sequence

_SCAN_HALF_M = 45.0
_SCANS_SHOWN = 3
_LOWEST_M, _HIGHEST_M = 0.4, 4.0  # above the ground: walls, not the road and not roofs
_DASHES = ("--", "-.", ":", (0.0, (5.0, 1.0, 1.0, 1.0)))


def check_figure(sequence: Sequence, scans: Mapping[int, NDArray[np.float32]]) -> Figure:
    """Draw the map with the truth and every odometry begun at it, and a few scans; without truth, these by themselves.

    Parameters
    ----------
    sequence
        The drive.
    scans
        Some of its scans by index, (N, 4) each.
    """
    truth = sequence.ground_truth
    shown = [index for index in scans if truth is None or _covers(truth, int(sequence.stamps_ns[index]))]
    shown = shown[:: max(1, -(-len(shown) // _SCANS_SHOWN))]
    figure = new_figure(12.0, 9.6)
    places = figure.add_gridspec(2 if shown else 1, max(1, len(shown)), height_ratios=[1.5, 1.0] if shown else None)
    _draw_paths(figure.add_subplot(places[0, :]), sequence, truth)
    for column, index in enumerate(shown):
        pose = None if truth is None else truth.interpolate([sequence.stamps_ns[index]], STAMP_TOLERANCE_NS)[0]
        _draw_scan(figure.add_subplot(places[1, column]), sequence, index, scans[index], pose)
    return figure


def _covers(truth: Trajectory, stamp_ns: int) -> bool:
    first, last = truth.span_ns
    return first - STAMP_TOLERANCE_NS <= stamp_ns <= last + STAMP_TOLERANCE_NS


def _draw_paths(axes: Axes, sequence: Sequence, truth: Trajectory | None) -> None:
    draw_map(axes, sequence.map)
    if truth is not None:
        style = METHODS["truth"]
        axes.plot(*truth.poses[:, :2].T, style.line, lw=style.width, color=style.colour, label=style.label, zorder=3)
        for number, name in enumerate(sequence.odometry_names):
            path = _from_truth(sequence, name)
            if path is not None:
                dashes = _DASHES[number % len(_DASHES)]
                axes.plot(*path[:, :2].T, ls=dashes, lw=1.6, color=METHODS["odometry"].colour, label=name, zorder=5)
        axes.plot(*truth.poses[0, :2], "o", ms=7, mfc="white", mec=INK, mew=1.4, zorder=12)
        legend(axes)
    tidy(axes, title=_title(truth), x="x, east (m)", y="y, north (m)")
    axes.grid(False)
    axes.set_aspect("equal")
    scale_bar(axes)
    north_arrow(axes)


def _from_truth(sequence: Sequence, name: str) -> FloatArray | None:
    """An odometry (N, 3) begun at the true pose; None where it is not of the same time, or cannot be read."""
    try:
        drive = load_drive(sequence, name)
    except SkyfixError:
        return None
    moved = None if drive.truth is None else scored(drive.truth, drive.odometry)
    return None if drive.truth is None or moved is None else from_true_start(drive.truth, moved).poses


def _title(truth: Trajectory | None) -> str:
    return "The map (there is no ground truth)" if truth is None else "Odometry from the true start, over the map"


def _draw_scan(
    axes: Axes, sequence: Sequence, index: int, points: NDArray[np.float32], pose: FloatArray | None
) -> None:
    """Points between 0.4 and 4 m above the ground: on the map where it was taken, or by themselves, x to the top."""
    height = points[:, 2] - sequence.ground_z
    xy = points[(height > _LOWEST_M) & (height < _HIGHEST_M), :2].astype(np.float64)
    if pose is None:
        xy, centre = np.column_stack([-xy[:, 1], xy[:, 0]]), np.zeros(2)
        axes.plot(0.0, 0.0, "^", ms=7, color=INK, path_effects=halo())
    else:
        draw_map(axes, sequence.map)
        xy, centre = se2.transform_points(pose, xy), pose[:2]
        tip = pose[:2] + 8.0 * np.array([np.cos(pose[2]), np.sin(pose[2])])
        arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.8}
        axes.annotate("", xy=tuple(tip), xytext=tuple(pose[:2]), arrowprops=arrow)
    axes.plot(*xy.T, ".", ms=1.2, color=METHODS["odometry"].colour, alpha=0.7, mew=0)
    tidy(axes, title=f"Scan {index}, points {_LOWEST_M:g} to {_HIGHEST_M:g} m up")
    axes.set(xlim=centre[0] + np.array([-1, 1]) * _SCAN_HALF_M, ylim=centre[1] + np.array([-1, 1]) * _SCAN_HALF_M)
    axes.set_aspect("equal")
    axes.grid(False)
    scale_bar(axes)
