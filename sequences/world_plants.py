"""Vegetation of a world: trees along streets and in gardens, woods, bushes, overgrown ground, tall grass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sequences.osm import Line
from sequences.world_layers import WorldLayers
from sequences.world_model import Material
from sequences.world_roads import beside, resampled
from sequences.world_style import WorldStyle
from sequences.world_terrain import smooth_noise


def add_tree(
    layers: WorldLayers, xy: NDArray[np.float64], size: float, style: WorldStyle, rng: np.random.Generator
) -> None:
    """Stamp a trunk and a crown; `size` 1 is a grown tree. Some are conifers or shrubs with foliage down to the
    ground."""
    foliage = style.foliage_per_m * rng.uniform(0.4, 1.2)
    radius = size * rng.uniform(1.2, 4.0)
    to_ground = rng.random() < 0.25
    bottom = 0.0 if to_ground else rng.uniform(1.2, 4.0)
    top = bottom + rng.uniform(2.0, 8.0) * size + 0.5
    if to_ground:
        layers.low.disc(xy, 0.6 * radius, top, Material.FOLIAGE, 0.0, foliage)
    else:
        layers.crowns.disc(xy, radius, top, Material.FOLIAGE, bottom, foliage)
    layers.solid.disc(xy, size * rng.uniform(0.08, 0.3), bottom + 1.0, Material.POLE)


def add_bush(layers: WorldLayers, xy: NDArray[np.float64], style: WorldStyle, rng: np.random.Generator) -> None:
    """Stamp a bush of 0.3 to 3 m."""
    top = rng.uniform(0.3, 1.5) * rng.uniform(1.0, 2.0)
    radius = rng.uniform(0.3, 0.3 + 0.6 * top)
    layers.low.disc(xy, radius, top, Material.FOLIAGE, 0.0, style.foliage_per_m * rng.uniform(0.4, 2.0))


def add_tree_row(layers: WorldLayers, line: Line, offset_m: float, style: WorldStyle, rng: np.random.Generator) -> None:
    """Stamp trees of one kind at even distances along a line."""
    points, yaw = resampled(line.points, rng.uniform(5.0, 14.0))
    size = rng.uniform(0.5, 1.3)
    for point in beside(points, yaw, offset_m) + rng.normal(0.0, 0.15, points.shape):
        if rng.random() < 0.85:
            add_tree(layers, point, size * rng.uniform(0.8, 1.2), style, rng)


def add_street_trees(layers: WorldLayers, roads: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    """Rows of trees beside some of the roads."""
    for road in roads:
        half = 0.5 * road.width_m * style.road_width_factor
        for side in (-1.0, 1.0):
            if rng.random() < 0.12 * style.tree_density / 2.0:
                add_tree_row(layers, road, side * (half + rng.uniform(0.7, 2.5)), style, rng)


def scatter(
    mask: NDArray[np.uint8], per_1000_m2: float, layers: WorldLayers, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Random points (N, 2) on the set cells of a mask, so many per 1000 square metres."""
    grid = layers.grid
    number = int(rng.poisson(per_1000_m2 * grid.area_m2 / 1000.0))
    rc = rng.random((number, 2)) * [grid.rows, grid.cols]
    cells = rc.astype(np.intp)
    points: NDArray[np.float64] = grid.xy_from_pixel(rc[mask[cells[:, 0], cells[:, 1]] > 0])
    return points


def overgrow(
    layers: WorldLayers, where: NDArray[np.uint8], share: float, style: WorldStyle, rng: np.random.Generator
) -> None:
    """Cover a share of the set cells with brushwood of varying height and density, in patches of some metres."""
    patches = smooth_noise(layers.grid, 7.0, rng) + 0.6 * smooth_noise(layers.grid, 1.5, rng)
    threshold = float(np.quantile(patches[::7, ::7], 1.0 - np.clip(share, 0.0, 0.98)))
    tallness = np.clip((patches - threshold) * 1.2, 0.0, 2.5)
    grown = (where > 0) & (patches > threshold)
    layers.brush_m[grown] = tallness[grown]
    layers.brush_density_per_m = style.foliage_per_m
