"""Neighbourhoods that map extracts lack: divided roads with planted medians, verges, parking strips and pavements
on the map.

Old extracts draw little beside buildings and centrelines. These variants change what is mapped and what is there
alike: the features they return are a richer or rebuilt neighbourhood, of which both the map and the world are made.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sequences.osm import Area, Line, MapFeatures
from sequences.world_roads import beside, resampled
from sequences.world_style import WorldStyle

_DIVIDED = frozenset({"primary", "secondary", "tertiary", "unclassified", "residential"})
_LINED = frozenset({*_DIVIDED, "living_street"})


def rebuilt(here: MapFeatures, style: WorldStyle, rng: np.random.Generator) -> MapFeatures:
    """Divide some roads and map strips and pavements along others, as much as the style says."""
    corners = [ring for area in here.areas if area.kind == "building" for ring in area.rings]
    buildings = np.concatenate(corners) if corners else np.zeros((0, 2))
    lines: list[Line] = []
    areas: list[Area] = []
    half_median = rng.uniform(1.0, 7.0)
    for line in here.lines:
        if line.kind != "road" or line.detail not in _LINED:
            lines.append(line)
            continue
        carriageways = [line]
        wide_enough = half_median + line.width_m * style.road_width_factor + 1.5
        divide = line.detail in _DIVIDED and not line.one_way and rng.random() < style.divided_share
        if divide and _nearest(buildings, line.points) > wide_enough:
            carriageways, median = _divided(line, half_median, style)
            if rng.random() < 0.6:
                areas.append(median)
        lines.extend(carriageways)
        for carriageway in carriageways:
            for side in (-1.0,) if len(carriageways) == 2 else (-1.0, 1.0):
                strips, paths = _strips(carriageway, side, style, rng)
                areas.extend(strips)
                lines.extend(paths)
    return replace(here, areas=(*here.areas, *areas), lines=tuple(lines))


def _nearest(points: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Least distance of points from a polyline, metres; far where there are none."""
    dense, _ = resampled(line, 4.0)
    if not len(points) or not len(dense):
        return 1e3
    return float(np.sqrt(((points[:, None] - dense[None]) ** 2).sum(axis=-1).min()))


def _divided(line: Line, half_median_m: float, style: WorldStyle) -> tuple[list[Line], Area]:
    """Two one-way carriageways, driven on the right, and the median between them."""
    points, yaw = resampled(line.points, 3.0)
    ends = line.points[[0, -1]]
    points, yaw = np.concatenate([ends[:1], points, ends[1:]]), yaw[[0, *range(len(yaw)), -1]]
    offset = half_median_m + 0.5 * line.width_m * style.road_width_factor
    right, left = beside(points, yaw, -offset), beside(points, yaw, offset)
    rings = (
        np.concatenate([beside(points, yaw, half_median_m - 0.3), beside(points, yaw, 0.3 - half_median_m)[::-1]]),
    )
    median = Area("grass", rings, size_m2=2.0 * half_median_m * 3.0 * len(points))
    return [replace(line, points=right, one_way=True), replace(line, points=left[::-1], one_way=True)], median


def _strips(line: Line, side: float, style: WorldStyle, rng: np.random.Generator) -> tuple[list[Area], list[Line]]:
    """Mapped verge or parking strip and mapped pavement on one side of a road."""
    points, yaw = resampled(line.points, 3.0)
    if len(points) < 4:
        return [], []
    inner = 0.5 * line.width_m * style.road_width_factor + 0.2
    areas, paths = [], []
    if rng.random() < style.mapped_strip_share:
        start = int(rng.integers(0, len(points) - 3))
        end = int(rng.integers(start + 3, len(points) + 1))
        outer = inner + rng.uniform(1.5, 4.0)
        edge = beside(points[start:end], yaw[start:end], side * inner)
        back = beside(points[start:end], yaw[start:end], side * outer)
        kind = "parking" if rng.random() < 0.3 else "grass"
        areas.append(Area(kind, (np.concatenate([edge, back[::-1]]),), size_m2=(outer - inner) * 3.0 * (end - start)))
    if rng.random() < style.mapped_pavement_share:
        offset = inner + rng.uniform(0.8, 0.8 + style.pavement_m)
        paths.append(Line("path", beside(points, yaw, side * offset), 1.8, detail="footway"))
    return areas, paths
