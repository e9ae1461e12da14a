"""What stands on and along roads: median strips, guard rails, parked and moving cars, poles, bins, people; and car
parks."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sequences import paint
from sequences.osm import Area, Line, MapFeatures
from sequences.world_layers import WorldLayers
from sequences.world_model import Material
from sequences.world_style import WorldStyle

_NO_PARKING = frozenset({"motorway", "motorway_link", "trunk", "trunk_link", "primary_link", "track", "busway"})
_FAST = frozenset({"motorway", "trunk", "primary"})


def resampled(points: NDArray[np.float64], step_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (M, 2) every `step_m` along a polyline, and the direction (M,) of the line at each, radians."""
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    keep = lengths > 1e-6
    legs, lengths, starts = legs[keep], lengths[keep], points[:-1][keep]
    if not len(legs):
        return np.zeros((0, 2)), np.zeros(0)
    ends = np.cumsum(lengths)
    stations = np.arange(0.5 * min(step_m, ends[-1]), ends[-1], step_m)
    leg = np.minimum(np.searchsorted(ends, stations, side="right"), len(legs) - 1)
    along = (stations - (ends - lengths)[leg]) / lengths[leg]
    return starts[leg] + along[:, None] * legs[leg], np.arctan2(legs[leg, 1], legs[leg, 0])


def beside(points: NDArray[np.float64], yaw: NDArray[np.float64], offset_m: float) -> NDArray[np.float64]:
    """Points (N, 2) moved to the left of their direction (N,) by `offset_m` (negative: right)."""
    return points + offset_m * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)


def add_car(layers: WorldLayers, pose: NDArray[np.float64], rng: np.random.Generator) -> None:
    """Stamp a car, a van or a lorry at (x, y, yaw)."""
    kind = rng.random()
    if kind < 0.86:
        size = rng.normal(1.0, 0.06)
        length, width, height = 4.4 * size, 1.8, rng.uniform(1.4, 1.75)
        cabin = np.array([*(pose[:2] - 0.25 * np.array([np.cos(pose[2]), np.sin(pose[2])])), pose[2]])
        layers.solid.polygon([paint.box_corners(pose, length, width)], rng.uniform(0.75, 1.0), Material.CAR)
        layers.solid.polygon([paint.box_corners(cabin, 0.58 * length, 0.9 * width)], height, Material.CAR)
    elif kind < 0.96:
        corners = paint.box_corners(pose, rng.uniform(4.8, 6.5), 2.0)
        layers.solid.polygon([corners], rng.uniform(1.9, 2.7), Material.CAR)
    else:
        corners = paint.box_corners(pose, rng.uniform(6.5, 11.0), 2.5)
        layers.solid.polygon([corners], rng.uniform(3.0, 3.8), Material.CAR)


def pave(layers: WorldLayers, lines: list[Line], style: WorldStyle) -> None:
    """Paint carriageways with their real width."""
    for line in lines:
        if line.kind == "road":
            paint.stroke(layers.paved, layers.grid, line.points, 1, line.width_m * style.road_width_factor)
            paint.stroke(layers.base, layers.grid, line.points, Material.ROAD, line.width_m * style.road_width_factor)


def add_medians(layers: WorldLayers, roads: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    """Median strips and guard rails of wide and divided roads."""
    for road in roads:
        width = road.width_m * style.road_width_factor
        if not (road.detail in _FAST or width > 11.0) or rng.random() > style.median_share:
            continue
        points, yaw = resampled(road.points, 2.0)
        if len(points) < 5:
            continue
        inset = 3
        middle = beside(points, yaw, 0.5 * width + 0.9 if road.one_way else 0.0)[inset:-inset]
        if len(middle) < 2:
            continue
        kind = rng.random()
        if kind < 0.4:
            layers.low.line(middle, 0.2, 0.8, Material.FENCE, 0.4, 8.0)
        elif kind < 0.7:
            top, density = rng.uniform(0.5, 1.6), style.foliage_per_m * 2.0
            layers.low.line(middle, rng.uniform(0.6, 1.6), top, Material.FOLIAGE, 0.0, density)
        if kind > 0.3:
            layers.solid.line(middle, rng.uniform(0.8, 2.0), style.kerb_m + 0.05, Material.SOIL)
        if road.one_way and rng.random() < 0.4:
            outer = beside(points, yaw, -(0.5 * width + 1.0))[inset:-inset]
            layers.low.line(outer, 0.2, 0.8, Material.FENCE, 0.4, 8.0)


def add_parked_cars(layers: WorldLayers, roads: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    """Cars along both sides of roads, in runs, on the carriageway or half on the pavement."""
    for road in roads:
        if road.detail in _NO_PARKING:
            continue
        points, yaw = resampled(road.points, 6.2)
        half = 0.5 * road.width_m * style.road_width_factor
        for side in (-1.0, 1.0):
            share = np.clip(style.parked_share + rng.normal(0.0, 0.3), 0.0, 0.95)
            offset = half + (rng.uniform(-0.9, 1.6) if half > 3.0 else rng.uniform(0.6, 1.6))
            runs = np.repeat(rng.random(len(points) // 5 + 1) < share, 5)[: len(points)]
            for i in np.flatnonzero(runs & (rng.random(len(points)) < 0.5 + 0.5 * share)):
                centre = beside(points[i : i + 1], yaw[i : i + 1], side * offset)[0] + rng.normal(0.0, 0.12, 2)
                turned = yaw[i] + (np.pi if side > 0 else 0.0) + rng.normal(0.0, 0.03)
                add_car(layers, np.array([*centre, turned]), rng)


def add_traffic(layers: WorldLayers, roads: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    """Moving cars in their lanes."""
    for road in roads:
        points, yaw = resampled(road.points, 5.0)
        half = 0.5 * road.width_m * style.road_width_factor
        factor = 2.0 if road.detail in _FAST else 1.0 if half > 2.5 else 0.3
        for i in np.flatnonzero(rng.random(len(points)) < factor * style.traffic_per_km * 5.0 / 1000.0):
            side = -1.0 if road.one_way or rng.random() < 0.5 else 1.0
            centre = beside(points[i : i + 1], yaw[i : i + 1], side * rng.uniform(0.3, 0.6) * half)[0]
            add_car(layers, np.array([*centre, yaw[i] + (np.pi if side > 0 else 0.0)]), rng)


def add_street_furniture(layers: WorldLayers, lines: list[Line], style: WorldStyle, rng: np.random.Generator) -> None:
    """Poles, signs, bins and boxes, and people, along roads and paths."""
    for line in lines:
        points, yaw = resampled(line.points, 2.5)
        half = 0.5 * line.width_m * (style.road_width_factor if line.kind == "road" else 1.0)
        share = 2.5 / 100.0 * (1.0 if line.kind == "road" else 0.4)
        for i in np.flatnonzero(rng.random(len(points)) < share * style.poles_per_100m):
            offset = rng.choice((-1.0, 1.0)) * (half + rng.uniform(0.3, 2.5))
            spot = beside(points[i : i + 1], yaw[i : i + 1], offset)[0]
            kind = rng.random()
            if kind < 0.6:
                layers.solid.disc(spot, rng.uniform(0.05, 0.15), rng.uniform(2.2, 7.0), Material.POLE)
            else:
                box = paint.box_corners(np.array([*spot, yaw[i]]), rng.uniform(0.5, 1.4), rng.uniform(0.4, 0.8))
                layers.solid.polygon([box], rng.uniform(0.7, 1.6), Material.WALL)
        for i in np.flatnonzero(rng.random(len(points)) < share * style.pedestrians_per_100m):
            spot = points[i] + rng.normal(0.0, 1.0 + half, 2)
            layers.solid.disc(spot, 0.22, rng.uniform(1.5, 1.9), Material.CAR)


def add_car_park(layers: WorldLayers, area: Area, style: WorldStyle, rng: np.random.Generator) -> None:
    """Rows of cars on a car park, aligned with its longest extent."""
    ring = area.rings[0]
    (centre_x, centre_y), (width, height), angle_deg = cv2.minAreaRect(ring.astype(np.float32))
    yaw = np.deg2rad(angle_deg) + (0.0 if width >= height else 0.5 * np.pi)
    along, across = max(width, height), min(width, height)
    if along > 400.0:
        return
    cos, sin = np.cos(yaw), np.sin(yaw)
    row_offsets = np.concatenate([np.arange(2.8, across - 2.0, 16.0), np.arange(8.0, across - 2.0, 16.0)])
    outline = ring.astype(np.float32)[:, None]
    share = np.clip(style.car_park_share + rng.normal(0.0, 0.2), 0.0, 1.0)
    for v in row_offsets - 0.5 * across:
        for u in np.arange(1.5, along - 1.0, 2.6) - 0.5 * along:
            if rng.random() > share:
                continue
            spot = np.array([centre_x + cos * u - sin * v, centre_y + sin * u + cos * v])
            if cv2.pointPolygonTest(outline, (float(spot[0]), float(spot[1])), True) > 1.5:
                add_car(layers, np.array([*spot, yaw + 0.5 * np.pi * rng.choice((-1.0, 1.0))]), rng)


def populate(
    layers: WorldLayers, here: MapFeatures, lines: list[Line], style: WorldStyle, rng: np.random.Generator
) -> None:
    """Put everything of this module onto the roads and car parks of an area; `lines` are where ways really are."""
    roads = [line for line in lines if line.kind == "road"]
    add_medians(layers, roads, style, rng)
    add_parked_cars(layers, roads, style, rng)
    for area in here.areas:
        if area.kind == "parking":
            add_car_park(layers, area, style, rng)
    add_traffic(layers, roads, style, rng)
    add_street_furniture(layers, [line for line in lines if line.kind in ("road", "path")], style, rng)
    for kind, point in here.points:
        if kind == "pole":
            layers.solid.disc(point, 0.1, rng.uniform(4.0, 8.0), Material.POLE)
