"""A few frames in detail: the scan from above, the map around it, and what matching the two says about the position."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from scipy.stats import chi2

from sequences.figures.map_drawing import draw_map, extent_of, for_people, scale_bar
from sequences.figures.series import FloatArray, RunSeries
from sequences.figures.style import FAINT, INK, METHODS, halo, new_figure
from sequences.run_result import RunResult, Snapshot

_MOST_FRAMES = 6
_NATS_SHOWN = 10.0
_LEAST_HALF_M = 6.0
_CLEAR_TO_PURPLE = LinearSegmentedColormap.from_list(
    "heat", [(1, 1, 1, 0.0), (0.99, 0.75, 0.45, 0.55), (0.85, 0.25, 0.38, 0.8), (0.28, 0.05, 0.42, 0.92)]
)


def frames_figure(result: RunResult, series: RunSeries) -> Figure:
    """Draw up to six of a run's snapshots, one at least: bird's-eye view, map with poses, likelihood over the map."""
    shown = _spread(result.snapshots, _MOST_FRAMES)
    figure = new_figure(2.05 * max(3, len(shown)), 7.0)
    panels = figure.subplots(3, len(shown), squeeze=False)
    for axes in panels.ravel():
        _frame_only(axes)
    for column, snapshot in enumerate(shown):
        distance = float(series.distance_at(np.array([_stamp_of(result, snapshot)]))[0])
        _draw_bev(panels[0, column], snapshot)
        panels[0, column].set_title(f"frame {snapshot.index}, {distance:.0f} m", fontsize=9, color=INK)
        _draw_poses(panels[1, column], snapshot)
        _draw_likelihood(panels[2, column], result, snapshot)
    for row, word in enumerate(("scan from above", "map and poses", "likelihood")):
        _label_row(panels[row, 0], word)
    _add_legend(figure, with_truth=result.truth is not None)
    return figure


def bev_picture(bev: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Ink on paper (H, W) uint8 from a bird's-eye view (C, H, W): darker where any channel holds more."""
    low = bev.min(axis=(1, 2), keepdims=True)
    high = np.percentile(bev, 99.5, axis=(1, 2), keepdims=True)
    filled = np.clip((bev - low) / np.maximum(high - low, 1e-9), 0.0, 1.0).mean(axis=0)
    filled = np.sqrt(filled / max(float(filled.max()), 1e-9))
    return (255 - 225 * filled).astype(np.uint8)


def _draw_bev(axes: Axes, snapshot: Snapshot) -> None:
    picture = bev_picture(snapshot.bev)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    rows, cols = picture.shape
    size = 0.045 * cols
    axes.plot(cols / 2, rows / 2, ">", ms=6, color=METHODS["filter"].colour, mec="white", mew=0.8)
    axes.plot([cols / 2, cols / 2 + 3 * size], [rows / 2, rows / 2], color=METHODS["filter"].colour, lw=1.2)


def _draw_poses(axes: Axes, snapshot: Snapshot) -> None:
    grid = snapshot.map_crop.grid
    draw_map(axes, snapshot.map_crop)
    length = 0.14 * grid.width_m
    if snapshot.truth is not None:
        _arrow(axes, snapshot.truth, METHODS["truth"].colour, length)
    _arrow(axes, snapshot.best, METHODS["single_shot"].colour, length)
    _arrow(axes, snapshot.estimate, METHODS["filter"].colour, length)
    left, right, bottom, top = extent_of(grid)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    scale_bar(axes)


def _draw_likelihood(axes: Axes, result: RunResult, snapshot: Snapshot) -> None:
    heat = snapshot.heat.astype(np.float64)
    shown = np.clip(1.0 + (heat - heat.max()) / _NATS_SHOWN, 0.0, 1.0)
    grey = for_people(snapshot.map_crop).mean(axis=-1)
    axes.imshow(
        grey, extent=extent_of(snapshot.map_crop.grid), cmap="gray", vmin=60, vmax=255, interpolation="antialiased"
    )
    axes.imshow(shown, extent=extent_of(snapshot.heat_grid), cmap=_CLEAR_TO_PURPLE, vmin=0, vmax=1)
    if snapshot.truth is not None:
        axes.plot(*snapshot.truth[:2], "+", ms=11, mew=1.8, color=METHODS["truth"].colour, path_effects=halo())
    axes.plot(*snapshot.best[:2], "o", ms=3.5, mec="white", mew=0.7, color=METHODS["single_shot"].colour)
    axes.plot(*snapshot.estimate[:2], "o", ms=3.5, mec="white", mew=0.7, color=METHODS["filter"].colour)
    at = np.flatnonzero(result.filter.stamp_ns == _stamp_of(result, snapshot))
    if result.filter.covariances is not None and len(at):
        axes.add_patch(covariance_ellipse(snapshot.estimate, result.filter.covariances[at[0], :2, :2]))
    _zoom(axes, snapshot)
    scale_bar(axes)


def _zoom(axes: Axes, snapshot: Snapshot) -> None:
    """Show the searched square, or that part of it which holds the poses and the likelihood's mass around them."""
    left, right, bottom, top = extent_of(snapshot.heat_grid)
    poses = [snapshot.estimate, snapshot.best, *([] if snapshot.truth is None else [snapshot.truth])]
    reach = max(float(np.abs(pose[:2] - snapshot.estimate[:2]).max()) for pose in poses)
    half = max(_LEAST_HALF_M, 1.5 * reach)
    x, y = (float(value) for value in snapshot.estimate[:2])
    if half < (right - left) / 2:
        left, right, bottom, top = x - half, x + half, y - half, y + half
    axes.set(xlim=(left, right), ylim=(bottom, top))


def covariance_ellipse(pose: FloatArray, covariance: FloatArray, level: float = 0.95) -> Ellipse:
    """Outline the region that holds the position with probability `level`, from a (2, 2) covariance."""
    variances, axes = np.linalg.eigh(covariance)
    widths = 2.0 * np.sqrt(variances * chi2.ppf(level, 2))
    angle = float(np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])))
    colour = METHODS["filter"].colour
    ellipse = Ellipse((float(pose[0]), float(pose[1])), widths[1], widths[0], angle=angle)
    ellipse.set(fill=False, edgecolor=colour, linewidth=1.5, zorder=9, path_effects=halo(3.2))
    return ellipse


def _arrow(axes: Axes, pose: FloatArray, colour: str, length: float) -> None:
    tip = pose[:2] + length * np.array([np.cos(pose[2]), np.sin(pose[2])])
    style = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11}
    axes.annotate("", xy=tuple(tip), xytext=tuple(pose[:2]), arrowprops={**style, "path_effects": halo()})
    axes.plot(*pose[:2], "o", ms=3.5, color=colour, mec="white", mew=0.5)


def _frame_only(axes: Axes) -> None:
    """Leave a thin frame and no ticks: these panels are pictures."""
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.6)


def _label_row(axes: Axes, word: str) -> None:
    axes.text(-0.06, 0.5, word, transform=axes.transAxes, rotation=90, ha="center", va="center", fontsize=9, color=INK)


def _add_legend(figure: Figure, *, with_truth: bool) -> None:
    names = [*(["truth"] if with_truth else []), "single_shot", "filter"]
    handles = [
        Line2D([], [], color=METHODS[name].colour, marker="o", lw=2, label=METHODS[name].label) for name in names
    ]
    handles.append(Line2D([], [], color=METHODS["filter"].colour, lw=1.4, label="filter, 95 % ellipse"))
    if with_truth:
        cross = METHODS["truth"].colour
        handles.append(Line2D([], [], color=cross, marker="+", ms=10, ls="", label="ground truth, position"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)


def _stamp_of(result: RunResult, snapshot: Snapshot) -> int:
    return next(row.stamp_ns for row in result.frame_rows if row.index == snapshot.index)


def _spread(snapshots: list[Snapshot], most: int) -> list[Snapshot]:
    """At most `most` of them, evenly spread, first and last included."""
    if len(snapshots) <= most:
        return snapshots
    return [snapshots[i] for i in np.linspace(0, len(snapshots) - 1, most).round().astype(int)]
