"""One held-out sample in detail: the map's picture, the scan from above, and where the network says it was taken."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fusion import se2
from fusion.likelihood import LikelihoodVolume
from learned.map_raster import MapRaster
from sequences.figures.frames import bev_picture
from sequences.figures.map_drawing import extent_of, for_people, scale_bar
from sequences.figures.style import FAINT, INK, METHODS, halo, new_figure

_NATS_SHOWN = 10.0
_CLEAR_TO_PURPLE = LinearSegmentedColormap.from_list(
    "heat", [(1, 1, 1, 0.0), (0.99, 0.75, 0.45, 0.55), (0.85, 0.25, 0.38, 0.8), (0.28, 0.05, 0.42, 0.92)]
)


def validation_figure(
    raster: MapRaster,
    bev: NDArray[np.float32],
    volume: LikelihoodVolume,
    truth: NDArray[np.float64],
    best: NDArray[np.float64],
) -> Figure:
    """Draw the picture that the network sees, the view from above and the likelihood with the true and best poses.

    Parameters
    ----------
    raster
        The map around the search.
    bev
        (bands, n, n) log densities of the scan, body frame.
    volume
        The likelihood.
    truth, best
        (3,) poses in the map frame.
    """
    figure = new_figure(10.5, 3.9)
    picture, scan, heat = figure.subplots(1, 3)
    extent = extent_of(raster.grid)
    picture.imshow(raster.picture, extent=extent, interpolation="antialiased")
    scan.imshow(bev_picture(bev), cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    scan.plot(bev.shape[2] / 2, bev.shape[1] / 2, ">", ms=6, color=METHODS["filter"].colour, mec="white", mew=0.8)
    grey = for_people(raster).mean(axis=-1)
    heat.imshow(grey, extent=extent, cmap="gray", vmin=60, vmax=255, interpolation="antialiased")
    heights = volume.log_prob.max(axis=2).astype(np.float64)
    shown = np.clip(1.0 + (heights - heights.max()) / _NATS_SHOWN, 0.0, 1.0)
    heat.imshow(shown, extent=extent_of(volume.grid), cmap=_CLEAR_TO_PURPLE, vmin=0, vmax=1)
    for axes in (picture, heat):
        _arrow(axes, truth, METHODS["truth"].colour, 0.14 * raster.grid.width_m)
        _arrow(axes, best, METHODS["single_shot"].colour, 0.14 * raster.grid.width_m)
        axes.set(xlim=extent[:2], ylim=extent[2:])
        scale_bar(axes)
    away = float(np.hypot(*(best - truth)[:2]))
    turned = float(np.degrees(se2.wrap(best[2] - truth[2])))
    for axes, word in (
        (picture, "map"),
        (scan, "scan from above"),
        (heat, f"likelihood: best {away:.1f} m, {turned:+.1f}° off"),
    ):
        axes.set_title(word, fontsize=9, color=INK)
        axes.set(xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set(color=FAINT, linewidth=0.6)
    return figure


def _arrow(axes: Axes, pose: NDArray[np.float64], colour: str, length: float) -> None:
    tip = pose[:2] + length * np.array([np.cos(pose[2]), np.sin(pose[2])])
    style = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11}
    axes.annotate("", xy=tuple(tip), xytext=tuple(pose[:2]), arrowprops={**style, "path_effects": halo()})
    axes.plot(*pose[:2], "o", ms=3.5, color=colour, mec="white", mew=0.5)
