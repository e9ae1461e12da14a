"""Garden and roadside boundaries: walls, fences, hedges and rows of bushes, most of which no map knows.

They stand where plots would have them: along both sides of roads some metres back, between neighbours at right
angles to the road, along the backs of gardens, and around parks, woods and car parks.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.grid import MapGrid
from sequences import paint
from sequences.osm import Area, Line
from sequences.world_layers import StampLayer, WorldLayers
from sequences.world_model import Material
from sequences.world_roads import beside, resampled
from sequences.world_style import WorldStyle

_NO_FRONTAGE = frozenset({"motorway", "motorway_link", "trunk_link", "track"})


@dataclass(frozen=True, slots=True)
class Boundary:
    """One stretch of boundary: its line (N, 2) and 'wall', 'fence', 'hedge' or 'bushes'."""

    kind: str
    points: NDArray[np.float64]


def _kind(style: WorldStyle, rng: np.random.Generator) -> str:
    draw = rng.random()
    for kind, share in (("wall", style.wall_share), ("hedge", style.hedge_share), ("bushes", style.bush_share)):
        if draw < share:
            return kind
        draw -= share
    return "fence"


def frontages(
    layers: WorldLayers,
    roads: list[Line],
    building: NDArray[np.uint8],
    style: WorldStyle,
    rng: np.random.Generator,
) -> list[Boundary]:
    """Boundaries of the plots along roads; `building` (rows, cols) is non-zero where one stands."""
    grid = layers.grid
    boundaries: list[Boundary] = []
    for road in roads:
        points, yaw = resampled(road.points, 1.0)
        if road.detail in _NO_FRONTAGE or len(points) < 8:
            continue
        half = 0.5 * road.width_m * style.road_width_factor
        for side in (-1.0, 1.0):
            front = half + style.pavement_m + rng.normal(0.3, 0.4)
            start = int(rng.integers(0, 8))
            kind = _kind(style, rng)
            while start < len(points) - 4:
                end = min(start + int(rng.integers(10, 32)), len(points) - 1)
                stretch = slice(start, end + 1)
                start = end
                if rng.random() < 0.6:
                    kind = _kind(style, rng)
                if rng.random() > style.plot_share:
                    continue
                set_back = front + (rng.uniform(0.5, 4.0) if rng.random() < 0.25 else rng.normal(0.0, 0.15))
                line = beside(points[stretch], yaw[stretch], side * set_back)
                beyond = beside(points[stretch], yaw[stretch], side * (set_back + 1.5))
                if share_on(building, grid.pixel_from_xy(beyond)) > 0.3 and rng.random() < 0.85:
                    continue
                boundaries.extend(Boundary(kind, part) for part in _with_driveway(line, rng))
                depth = style.plot_depth_m * rng.uniform(0.6, 1.3)
                if rng.random() < 0.75:
                    far = beside(points[end : end + 1], yaw[end : end + 1], side * (set_back + depth))
                    boundaries.append(Boundary(_kind(style, rng), np.concatenate([line[-1:], far])))
                if rng.random() < 0.5:
                    back = beside(points[stretch], yaw[stretch], side * (set_back + depth))
                    boundaries.append(Boundary(_kind(style, rng), back[:: max(len(back) - 1, 1)]))
    return boundaries


def around(areas: Iterable[Area], style: WorldStyle, rng: np.random.Generator) -> list[Boundary]:
    """Boundaries around parks, woods and car parks, with openings."""
    boundaries: list[Boundary] = []
    for area in areas:
        if area.kind not in ("grass", "forest", "parking") or rng.random() > style.area_boundary_share:
            continue
        closed = np.concatenate([area.rings[0], area.rings[0][:1]])
        points, yaw = resampled(closed, 2.0)
        points = beside(points, yaw, rng.normal(0.0, 0.5))
        kind = _kind(style, rng)
        start = 0
        while start < len(points) - 3:
            end = start + int(rng.integers(6, 40))
            if rng.random() < 0.8:
                boundaries.append(Boundary(kind, points[start : end + 1]))
            start = end + int(rng.integers(1, 3))
    return [boundary for boundary in boundaries if len(boundary.points) >= 2]


def add_boundary(
    layer: StampLayer, boundary: Boundary, height_m: float, style: WorldStyle, rng: np.random.Generator
) -> None:
    """Stamp a boundary; a height of NaN draws one that is usual for its kind."""
    known = np.isfinite(height_m)
    foliage = float(style.foliage_per_m * rng.uniform(1.5, 4.0))
    if boundary.kind == "wall":
        top = height_m if known else rng.choice((rng.uniform(0.3, 1.0), rng.uniform(1.0, 2.4)))
        layer.line(boundary.points, rng.uniform(0.15, 0.35), top, Material.WALL)
    elif boundary.kind == "fence":
        top = height_m if known else rng.uniform(0.8, 2.0)
        if rng.random() < 0.3:
            layer.line(boundary.points, 0.1, top, Material.FENCE)
        else:
            layer.line(boundary.points, 0.1, top, Material.FENCE, 0.0, rng.uniform(0.6, 7.0))
    elif boundary.kind == "hedge":
        top = height_m if known else rng.choice((rng.uniform(0.7, 2.0), rng.uniform(1.5, 4.0)))
        layer.line(boundary.points, rng.uniform(0.5, 1.3), top, Material.FOLIAGE, 0.0, foliage)
    else:
        points, _ = resampled(boundary.points, rng.uniform(0.8, 2.5))
        for point in points + rng.normal(0.0, 0.3, points.shape):
            top = rng.uniform(0.5, 3.5)
            layer.disc(point, rng.uniform(0.3, 0.4 + 0.5 * top), top, Material.FOLIAGE, 0.0, 0.5 * foliage)


def mapped(boundary: Boundary, rng: np.random.Generator) -> Line:
    """The boundary as a map draws it: a line somewhat beside it."""
    kind = "hedge" if boundary.kind == "bushes" else boundary.kind
    return Line(kind, boundary.points + rng.normal(0.0, 0.25, 2), detail=kind)


def standing_parts(line: Line, room: NDArray[np.bool_], grid: MapGrid) -> list[Line]:
    """The parts of a boundary that stand in the world, so that a map does not draw the rest."""
    points, _ = resampled(line.points, 0.5)
    rows, cols = np.floor(grid.pixel_from_xy(points)).astype(np.intp).T
    stands = np.zeros(len(points), dtype=bool)
    inside = (rows >= 0) & (cols >= 0) & (rows < grid.rows) & (cols < grid.cols)
    stands[inside] = room[rows[inside], cols[inside]]
    parts = np.split(np.arange(len(points)), np.flatnonzero(np.diff(stands)) + 1)
    return [replace(line, points=points[part]) for part in parts if len(part) >= 2 and stands[part[0]]]


def _with_driveway(line: NDArray[np.float64], rng: np.random.Generator) -> list[NDArray[np.float64]]:
    if len(line) < 9 or rng.random() > 0.6:
        return [line]
    gap = int(rng.integers(2, len(line) - 5))
    return [part for part in (line[:gap], line[gap + int(rng.integers(3, 6)) :]) if len(part) >= 2]


def share_on(mask: NDArray[np.uint8] | NDArray[np.bool_], rc: NDArray[np.float64]) -> float:
    """Share of pixel positions (N, 2) at which a mask is set; outside it counts as not set."""
    rows, cols = np.floor(rc).astype(np.intp).T
    inside = (rows >= 0) & (cols >= 0) & (rows < mask.shape[0]) & (cols < mask.shape[1])
    return float(np.count_nonzero(mask[rows[inside], cols[inside]])) / max(len(rc), 1)


def room_for_boundaries(
    layers: WorldLayers, off_road: NDArray[np.float32], paths: list[Line], building: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Where garden boundaries may stand: off carriageways and their edges, off paths, not in buildings."""
    taken = (off_road < 0.6) | (building > 0)
    walked = np.zeros(building.shape, dtype=np.uint8)
    for path in paths:
        paint.stroke(walked, layers.grid, path.points, 1, path.width_m + 0.4)
    return ~(taken | (walked > 0))
