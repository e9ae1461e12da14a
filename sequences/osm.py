"""OpenStreetMap extracts (.osm.pbf, .osm.gz, .osm) as plain features in local metres, and their rasters.

Projection: transverse Mercator on WGS 84 with its natural origin at the extract's median node (or a given origin)
and scale 1, so that distances are true to 1e-7 over a town. Rasters look like those that map-localization datasets
use: areas first (the large below the small, buildings last), then every way as a line of one pixel: roads as
centrelines, walls, fences and hedges; points not at all.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import osmium
import pyproj
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences import osm_tags, paint

_LINE_ORDER = ("path", "road", "tree", "hedge", "fence", "wall")
_POINT_KINDS = {("natural", "tree"): "tree", ("highway", "street_lamp"): "pole", ("highway", "traffic_signals"): "pole"}


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon: `rings[0]` its outer ring (N, 2), the rest holes; map frame, metres. Height NaN where it is not
    known."""

    kind: str
    rings: tuple[NDArray[np.float64], ...]
    height_m: float = float("nan")
    size_m2: float = 0.0


@dataclass(frozen=True, slots=True)
class Line:
    """A polyline (N, 2) in metres with the width of its surface; `detail` is the highway or barrier value."""

    kind: str
    points: NDArray[np.float64]
    width_m: float = 0.0
    height_m: float = float("nan")
    detail: str = ""
    one_way: bool = False


@dataclass(frozen=True, slots=True)
class MapFeatures:
    """All features of an extract in a local frame.

    Attributes
    ----------
    areas, lines
        Polygons and polylines, classes of `learned.map_raster.CLASSES`.
    points
        (kind, xy) of single things that maps do not draw and worlds use: 'tree', 'pole'.
    origin_lat_lon
        Where the local frame's origin is, degrees.
    bounds
        (x_min, y_min, x_max, y_max) that hold 96 % of the nodes, metres.
    """

    areas: tuple[Area, ...]
    lines: tuple[Line, ...]
    points: tuple[tuple[str, NDArray[np.float64]], ...] = ()
    origin_lat_lon: tuple[float, float] = (0.0, 0.0)
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    _area_boxes: NDArray[np.float64] = field(init=False, repr=False)
    _line_boxes: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_area_boxes", _boxes([area.rings[0] for area in self.areas]))
        object.__setattr__(self, "_line_boxes", _boxes([line.points for line in self.lines]))

    def within(self, grid: MapGrid, margin_m: float = 0.0) -> MapFeatures:
        """Keep the features whose bounding boxes touch the grid widened by a margin."""
        x_min, y_min = grid.x0 - margin_m, grid.y0 - margin_m
        x_max, y_max = grid.x0 + grid.width_m + margin_m, grid.y0 + grid.height_m + margin_m

        def touching(boxes: NDArray[np.float64]) -> NDArray[np.intp]:
            inside = (boxes[:, 0] <= x_max) & (boxes[:, 2] >= x_min) & (boxes[:, 1] <= y_max) & (boxes[:, 3] >= y_min)
            return np.flatnonzero(inside)

        return MapFeatures(
            tuple(self.areas[i] for i in touching(self._area_boxes)),
            tuple(self.lines[i] for i in touching(self._line_boxes)),
            tuple(p for p in self.points if x_min <= p[1][0] <= x_max and y_min <= p[1][1] <= y_max),
            self.origin_lat_lon,
            (x_min, y_min, x_max, y_max),
        )

    def moved(self, offset: NDArray[np.float64]) -> MapFeatures:
        """Everything shifted by (2,) metres."""
        return replace(
            self,
            areas=tuple(replace(area, rings=tuple(ring + offset for ring in area.rings)) for area in self.areas),
            lines=tuple(replace(line, points=line.points + offset) for line in self.lines),
            points=tuple((kind, xy + offset) for kind, xy in self.points),
        )

    def roads(self) -> list[Line]:
        """The lines that cars drive on, without farm tracks."""
        return [line for line in self.lines if line.kind == "road" and line.detail != "track"]


def _boxes(rings: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    if not rings:
        return np.zeros((0, 4))
    return np.array([[*ring.min(axis=0), *ring.max(axis=0)] for ring in rings])


def read_osm(path: Path | str, origin_lat_lon: tuple[float, float] | None = None) -> MapFeatures:
    """Read an extract into local metres (x east, y north about the origin).

    Parameters
    ----------
    path
        A .osm.pbf, .osm.gz or .osm file.
    origin_lat_lon
        Origin of the local frame, degrees; default: the median of the extract's nodes.

    Raises
    ------
    SkyfixError
        If the file is missing, unreadable or has no features.
    """
    if not Path(path).is_file():
        raise SkyfixError(f"map extract: expected a .osm, .osm.gz or .osm.pbf file at {path}, got no such file")
    areas: list[tuple[dict[str, str], list[list[tuple[float, float]]]]] = []
    ways: list[tuple[dict[str, str], list[tuple[float, float]]]] = []
    points: list[tuple[str, tuple[float, float]]] = []
    try:
        for thing in osmium.FileProcessor(str(path)).with_locations().with_areas():
            if not len(thing.tags):
                continue
            tags = {tag.k: tag.v for tag in thing.tags}
            if isinstance(thing, osmium.osm.Node):
                points.extend(
                    (kind, (thing.location.lon, thing.location.lat))
                    for (key, value), kind in _POINT_KINDS.items()
                    if tags.get(key) == value
                )
            elif isinstance(thing, osmium.osm.Area) and osm_tags.area_class(tags) is not None:
                for outer in thing.outer_rings():
                    rings = [_lon_lat(outer), *(_lon_lat(inner) for inner in thing.inner_rings(outer))]
                    areas.append((tags, [ring for ring in rings if len(ring) >= 3]))
            elif isinstance(thing, osmium.osm.Way) and osm_tags.line_class(tags) is not None:
                ways.append((tags, _lon_lat(thing.nodes)))
    except RuntimeError as error:
        raise SkyfixError(f"map extract: expected OpenStreetMap data in {path}, got {error}") from error
    areas = [(tags, rings) for tags, rings in areas if rings and len(rings[0]) >= 3]
    ways = [(tags, line) for tags, line in ways if len(line) >= 2]
    if not areas and not ways:
        raise SkyfixError(f"map extract: expected buildings or ways in {path}, got none")
    outlines = [ring for _, rings in areas for ring in rings] + [line for _, line in ways]
    lon, lat = np.median(np.concatenate([np.array(outline) for outline in outlines]), axis=0)
    origin = (float(lat), float(lon)) if origin_lat_lon is None else origin_lat_lon
    spots = [[position] for _, position in points]
    projected = iter(_projected([*outlines, *spots], local_projection(origin)))
    local_areas = tuple(_area(tags, tuple(next(projected) for _ in rings)) for tags, rings in areas)
    local_lines = tuple(_line(tags, next(projected)) for tags, _ in ways)
    everything = [ring for area in local_areas for ring in area.rings] + [line.points for line in local_lines]
    low, high = np.percentile(np.concatenate(everything), [2, 98], axis=0)
    return MapFeatures(
        local_areas,
        local_lines,
        tuple((kind, next(projected)[0]) for kind, _ in points),
        origin,
        (float(low[0]), float(low[1]), float(high[0]), float(high[1])),
    )


def local_projection(origin_lat_lon: tuple[float, float]) -> pyproj.Transformer:
    """The transformer from (longitude, latitude) in degrees to local metres (x east, y north)."""
    lat, lon = origin_lat_lon
    crs = f"+proj=tmerc +lat_0={lat!r} +lon_0={lon!r} +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"
    return pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def rasterise(features: MapFeatures, grid: MapGrid, skip: Collection[str] = ()) -> MapRaster:
    """Draw the features as a class raster; classes in `skip` are left out."""
    here = features.within(grid)
    classes = np.zeros((grid.rows, grid.cols), dtype=np.uint8)
    for area in sorted(here.areas, key=lambda a: (a.kind == "building", -a.size_m2)):
        if area.kind not in skip:
            paint.fill(classes, grid, area.rings, CLASS_INDEX[area.kind])
    for kind in _LINE_ORDER:
        for line in here.lines:
            if line.kind == kind and kind not in skip:
                paint.stroke(classes, grid, line.points, CLASS_INDEX[kind])
    return MapRaster.from_classes(grid, classes)


def _lon_lat(nodes: osmium.osm.NodeRefList) -> list[tuple[float, float]]:
    return [(node.location.lon, node.location.lat) for node in nodes if node.location.valid()]


def _projected(outlines: list[list[tuple[float, float]]], local: pyproj.Transformer) -> list[NDArray[np.float64]]:
    """Project lists of (longitude, latitude) in one go."""
    lon_lat = np.concatenate([np.array(outline, dtype=np.float64) for outline in outlines])
    xy = np.stack(local.transform(lon_lat[:, 0], lon_lat[:, 1]), axis=-1)
    return np.split(xy, np.cumsum([len(outline) for outline in outlines])[:-1])


def _area(tags: dict[str, str], rings: tuple[NDArray[np.float64], ...]) -> Area:
    x, y = rings[0].T
    size = 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))
    return Area(str(osm_tags.area_class(tags)), rings, osm_tags.height_m(tags), size)


def _line(tags: dict[str, str], points: NDArray[np.float64]) -> Line:
    detail = tags.get("highway") or tags.get("barrier") or "tree_row"
    return Line(
        str(osm_tags.line_class(tags)),
        points,
        osm_tags.line_width_m(tags),
        osm_tags.height_m(tags),
        detail,
        tags.get("oneway") == "yes" or detail == "motorway",
    )
