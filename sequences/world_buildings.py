"""Buildings of a world: footprints not quite as mapped, missing or new ones, heights, and what sticks out of
facades."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.grid import MapGrid
from sequences import paint
from sequences.osm import Area
from sequences.world_layers import WorldLayers
from sequences.world_model import Material
from sequences.world_style import WorldStyle
from sequences.world_terrain import smooth_noise


def displaced(
    areas: list[Area],
    layers: WorldLayers,
    style: WorldStyle,
    rng: np.random.Generator,
) -> list[Area]:
    """Move every building by the map's offset, an error that varies smoothly, and one of its own; turn it a
    little."""
    coarse = _coarse_grid(layers)
    field = [style.building_shift_m * smooth_noise(coarse, 50.0, rng) for _ in range(2)]
    moved = []
    for area in areas:
        centre = area.rings[0].mean(axis=0)
        rc = np.floor(coarse.pixel_from_xy(centre)).astype(int)
        row, col = np.clip(rc, 0, [coarse.rows - 1, coarse.cols - 1])
        shift = np.array([field[0][row, col], field[1][row, col]]) + rng.normal(0.0, 0.08, 2)
        turn = np.deg2rad(rng.normal(0.0, style.building_turn_deg))
        cos, sin = np.cos(turn), np.sin(turn)
        rotation = np.array([[cos, sin], [-sin, cos]])
        moved.append(replace(area, rings=tuple((ring - centre) @ rotation + centre + shift for ring in area.rings)))
    return moved


def _coarse_grid(layers: WorldLayers, metres_per_pixel: float = 5.0) -> MapGrid:
    """The layers' extent at a coarse resolution."""
    grid = layers.grid
    rows, cols = (max(1, int(np.ceil(size / metres_per_pixel))) for size in (grid.height_m, grid.width_m))
    return MapGrid(rows, cols, metres_per_pixel, grid.x0, grid.y0)


def add_building(layers: WorldLayers, area: Area, style: WorldStyle, rng: np.random.Generator) -> None:
    """Stamp a building and what sticks out of its facades."""
    small = area.size_m2 < 40.0
    if np.isfinite(area.height_m):
        height = area.height_m
    elif small:
        height = rng.uniform(2.2, 3.2)
    else:
        height = 3.0 * max(1.0, rng.normal(style.storeys, 0.8)) + rng.uniform(0.0, 3.0)
    layers.solid.polygon(area.rings, height, Material.BUILDING)
    if small:
        return
    ring = area.rings[0]
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        if length < 4.0 or rng.random() > style.extrusion_share:
            continue
        yaw = float(np.arctan2(end[1] - start[1], end[0] - start[0]))
        middle = start + rng.uniform(0.25, 0.75) * (end - start)
        depth, width = rng.uniform(0.4, 2.2), rng.uniform(1.0, min(6.0, 0.6 * length))
        box = paint.box_corners(np.array([*middle, yaw]), width, 2.0 * depth)
        kind = rng.random()
        if kind < 0.45:
            bottom = rng.uniform(2.2, 3.0)
            layers.crowns.polygon([box], bottom + rng.uniform(0.9, 6.0), Material.FENCE, bottom, 8.0)
        elif kind < 0.8:
            layers.solid.polygon([box], rng.uniform(2.2, max(height, 2.3)), Material.BUILDING)
        else:
            layers.solid.polygon([box], rng.uniform(0.3, 1.2), Material.WALL)


def shed(beside: Area, style: WorldStyle, rng: np.random.Generator) -> Area:
    """A shed or garage somewhere about a building, parallel to one of its walls."""
    ring = beside.rings[0]
    i = int(rng.integers(len(ring)))
    leg = ring[(i + 1) % len(ring)] - ring[i]
    yaw = float(np.arctan2(leg[1], leg[0]))
    reach = 0.5 * np.sqrt(max(beside.size_m2, 1.0)) + rng.uniform(1.0, 0.8 * style.plot_depth_m + 3.0)
    towards = rng.uniform(0.0, 2.0 * np.pi)
    centre = ring.mean(axis=0) + reach * np.array([np.cos(towards), np.sin(towards)])
    length, width = rng.uniform(2.0, 7.0), rng.uniform(1.8, 3.5)
    corners = paint.box_corners(np.array([*centre, yaw]), length, width)
    return Area("building", (corners,), rng.uniform(2.0, 3.0), length * width)
