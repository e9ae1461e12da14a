"""Worlds to simulate scans in, made from map features with everything that maps leave out, get wrong or show too
late.

`build_area` makes a small world and the map that goes with it (training);
`sequences.world_raster.world_from_raster` makes one from a map that exists only as a class raster.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from learned.map_raster import MapRaster
from sequences import paint, world_plants, world_plots, world_roads
from sequences.osm import Area, Line, MapFeatures, rasterise
from sequences.world_buildings import add_building, displaced, shed
from sequences.world_layers import WorldLayers
from sequences.world_model import Material, World
from sequences.world_raster import world_from_raster
from sequences.world_style import WorldStyle
from sequences.world_terrain import smooth_noise, terrain
from sequences.world_variants import rebuilt

__all__ = ["Material", "World", "WorldStyle", "build_area", "sample_road_poses", "world_from_raster"]

WORLD_METRES_PER_PIXEL = 0.2


def build_area(
    features: MapFeatures,
    grid: MapGrid,
    style: WorldStyle,
    rng: np.random.Generator,
    metres_per_pixel: float = WORLD_METRES_PER_PIXEL,
) -> tuple[World, MapRaster]:
    """Make a world over the extent of `grid` and the map raster on `grid` itself.

    Parameters
    ----------
    features
        Map features, as `sequences.osm.read_osm` gives them.
    grid
        Extent and resolution of the map raster.
    style
        How the world deviates from the map.
    rng
        Everything random is drawn from it: same state, same world.
    metres_per_pixel
        Resolution of the world.
    """
    drawn = rebuilt(features.within(grid, 15.0), style, rng)
    layers = WorldLayers(_finer(grid, metres_per_pixel))
    offset = rng.normal(0.0, style.map_offset_m, 2)
    here = drawn.moved(offset)
    lines = [replace(line, points=line.points + rng.normal(0.0, style.building_shift_m, 2)) for line in here.lines]
    known = [area for area in drawn.areas if area.kind != "building" or rng.random() > style.lost_share]
    standing = [area for area in here.areas if area.kind == "building" and rng.random() > style.lost_share]
    footprints = displaced(standing, layers, style, rng)

    outlines: NDArray[np.uint8] = np.zeros_like(layers.paved)
    for footprint in footprints:
        paint.fill(outlines, layers.grid, footprint.rings, 1)
    world_roads.pave(layers, lines, style)
    _surface_areas(layers, here.areas)
    ground, off_road = terrain(layers.grid, layers.paved, style, rng)
    room = world_plots.room_for_boundaries(layers, off_road, [line for line in lines if line.kind == "path"], outlines)

    boundaries = world_plots.frontages(layers, _roads(lines), outlines, style, rng)
    boundaries += world_plots.around(here.areas, style, rng)
    for boundary in boundaries:
        world_plots.add_boundary(layers.boundaries, boundary, float("nan"), style, rng)
    sheds = _sheds(layers, footprints, room & (off_road > 2.0), style, rng)
    for building in (*footprints, *sheds):
        add_building(layers, building, style, rng)
    _mapped_barriers(layers, lines, style, rng)
    _vegetate(layers, here, lines, room, style, rng)
    world_roads.populate(layers, here, lines, style, rng)

    texture = np.exp(np.float32(0.5) * smooth_noise(layers.grid, 0.8, rng))
    world = replace(layers.finish(ground, room, texture), roads=tuple(_roads(lines)))
    surveyed = [world_plots.mapped(boundary, rng) for boundary in boundaries if rng.random() < style.mapped_share]
    parts = [part for line in surveyed for part in world_plots.standing_parts(line, room, layers.grid)]
    found = MapFeatures(tuple(small for small in sheds if rng.random() < 0.4), tuple(parts)).moved(-offset)
    return world, rasterise(MapFeatures((*known, *found.areas), (*drawn.lines, *found.lines)), grid)


def sample_road_poses(
    world: World, number: int, rng: np.random.Generator, margin_m: float = 0.0
) -> NDArray[np.float64]:
    """Up to `number` poses (N, 3) of a vehicle driving on the world's roads, where nothing is in its way.

    Poses lie in a lane with some lateral scatter, headings along it with some degrees of scatter; `margin_m` keeps them
    away from the border of the world. Fewer come back where the area has little road.
    """
    grid = world.grid
    candidates = []
    for road in world.roads:
        points, yaw = world_roads.resampled(road.points, 2.0)
        against = (rng.random(len(points)) < 0.5) & (not road.one_way)
        heading = yaw + np.where(against, np.pi, 0.0)
        left = -rng.uniform(-0.2 if road.one_way else 0.0, 0.35, len(points)) * road.width_m
        spots = points + left[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        candidates.append(np.column_stack([spots, heading + rng.normal(0.0, 0.06, len(points))]))
    if not candidates:
        return np.zeros((0, 3))
    poses = np.concatenate(candidates)
    low = np.array([grid.x0, grid.y0]) + margin_m
    high = np.array([grid.x0 + grid.width_m, grid.y0 + grid.height_m]) - margin_m
    inside = np.all((poses[:, :2] > low) & (poses[:, :2] < high), axis=1)
    poses = poses[inside & world.is_free(poses[:, :2], 1.6)]
    chosen: NDArray[np.float64] = poses[rng.permutation(len(poses))[:number]]
    chosen[:, 2] = np.mod(chosen[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return chosen


def _finer(grid: MapGrid, metres_per_pixel: float) -> MapGrid:
    rows, cols = (max(1, round(size / metres_per_pixel)) for size in (grid.height_m, grid.width_m))
    return MapGrid(rows, cols, metres_per_pixel, grid.x0, grid.y0)


def _roads(lines: Iterable[Line]) -> list[Line]:
    return [line for line in lines if line.kind == "road"]


def _surface_areas(layers: WorldLayers, areas: Iterable[Area]) -> None:
    materials = {"grass": Material.GRASS, "water": Material.WATER, "parking": Material.ROAD, "road": Material.ROAD}
    for area in sorted(areas, key=lambda a: -a.size_m2):
        if area.kind in materials:
            paint.fill(layers.base, layers.grid, area.rings, materials[area.kind])
        if area.kind in ("parking", "road"):
            paint.fill(layers.paved, layers.grid, area.rings, 1)


def _sheds(
    layers: WorldLayers, houses: list[Area], room: NDArray[np.bool_], style: WorldStyle, rng: np.random.Generator
) -> list[Area]:
    if not houses:
        return []
    number = min(int(rng.poisson(style.shed_density * layers.grid.area_m2 / 1000.0)), 2 * len(houses))
    built = (shed(houses[int(rng.integers(len(houses)))], style, rng) for _ in range(number))
    return [small for small in built if world_plots.share_on(room, layers.grid.pixel_from_xy(small.rings[0])) > 0.99]


def _mapped_barriers(layers: WorldLayers, lines: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    for line in lines:
        if line.kind in ("wall", "fence", "hedge") and rng.random() > style.lost_share:
            boundary = world_plots.Boundary(line.kind, line.points)
            world_plots.add_boundary(layers.boundaries, boundary, line.height_m * rng.uniform(0.6, 1.3), style, rng)
        elif line.kind == "tree" and rng.random() > style.lost_share:
            world_plants.add_tree_row(layers, line, 0.0, style, rng)


def _vegetate(
    layers: WorldLayers,
    here: MapFeatures,
    lines: list[Line],
    room: NDArray[np.bool_],
    style: WorldStyle,
    rng: np.random.Generator,
) -> None:
    woods: NDArray[np.uint8] = np.zeros_like(layers.paved)
    for area in here.areas:
        if area.kind == "forest":
            paint.fill(woods, layers.grid, area.rings, 1)
    woods &= room.astype(np.uint8)
    open_ground = (room & (layers.base != Material.WATER)).astype(np.uint8)
    world_plants.overgrow(layers, open_ground, style.undergrowth, style, rng)
    world_plants.overgrow(layers, woods, 0.2 + 0.7 * rng.random(), style, rng)
    for point in world_plants.scatter(woods, 1000.0 / style.forest_spacing_m**2, layers, rng):
        world_plants.add_tree(layers, point, rng.uniform(0.4, 1.3), style, rng)
    gardens = open_ground & (woods == 0).astype(np.uint8)
    for point in world_plants.scatter(gardens, style.tree_density, layers, rng):
        world_plants.add_tree(layers, point, rng.uniform(0.3, 1.2), style, rng)
    for point in world_plants.scatter(gardens, style.bush_density, layers, rng):
        world_plants.add_bush(layers, point, style, rng)
    for kind, point in here.points:
        if kind == "tree":
            world_plants.add_tree(layers, point, rng.uniform(0.5, 1.3), style, rng)
    world_plants.add_street_trees(layers, _roads(lines), style, rng)
