"""`skyfix map`: a map in the folder format, drawn from an OpenStreetMap extract."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX
from sequences.drive_map import OSM_METRES_PER_PIXEL, WIDEST_M, GeoreferencedMap, drawn_map
from sequences.map_source import MAP_FILE, write_map
from sequences.osm import local_projection, read_osm

PREVIEW_FILE = "map_preview.png"
_MOST_PIXELS = 4 * 10**8


@dataclass(frozen=True, slots=True)
class MapRequest:
    """What to draw.

    Attributes
    ----------
    origin_lat_lon
        Latitude and longitude of the map frame's origin, degrees; None: the middle of the extract.
    half_extent_m
        Half the side of the square about the origin; None: all of the extract but stray ends.
    metres_per_pixel
        Resolution.

    Raises
    ------
    SkyfixError
        If a value is out of range.
    """

    origin_lat_lon: tuple[float, float] | None = None
    half_extent_m: float | None = None
    metres_per_pixel: float = OSM_METRES_PER_PIXEL

    def __post_init__(self) -> None:
        if self.origin_lat_lon is not None:
            checked_lat_lon("origin", self.origin_lat_lon)
        for name, value in (("half extent", self.half_extent_m), ("metres per pixel", self.metres_per_pixel)):
            if value is not None and not 0.0 < value < WIDEST_M:
                raise SkyfixError(f"map: expected a {name} above 0 and below {WIDEST_M:g} m, got {value:g}")


def checked_lat_lon(name: str, lat_lon: tuple[float, float]) -> tuple[float, float]:
    """A latitude and a longitude in degrees, or SkyfixError."""
    lat, lon = lat_lon
    if not (-85.0 <= lat <= 85.0 and -180.0 <= lon <= 180.0):
        raise SkyfixError(
            f"{name}: expected a latitude within 85 and a longitude within 180 degrees, got {lat:g} {lon:g}"
        )
    return lat, lon


def map_of_extract(extract: Path, request: MapRequest) -> GeoreferencedMap:
    """Draw an extract.

    Raises
    ------
    SkyfixError
        If the extract cannot be read or is wider than 20 km, or shows nothing there.
    """
    features = read_osm(extract, request.origin_lat_lon)
    half, step = request.half_extent_m, request.metres_per_pixel
    x_min, y_min, x_max, y_max = features.bounds
    if max(x_min, y_min, -x_max, -y_max) > WIDEST_M:
        lat, lon = features.origin_lat_lon
        raise SkyfixError(f"origin: expected one within {WIDEST_M:g} m of {extract.name}, got {lat:g} {lon:g}")
    if half is not None:
        x_min, y_min, x_max, y_max = -half, -half, half, half
    elif (size := max(x_max - x_min, y_max - y_min)) > WIDEST_M:
        raise SkyfixError(f"{extract.name}: expected one within {WIDEST_M:g} m, got {size:.0f}; choose a --half-extent")
    rows, cols = (math.ceil(round(extent / step, 6)) for extent in (y_max - y_min, x_max - x_min))
    if rows * cols > _MOST_PIXELS:
        raise SkyfixError(
            f"map: expected at most {_MOST_PIXELS:.0e} pixels, got {rows} x {cols}; "
            "choose a smaller --half-extent or larger --metres-per-pixel"
        )
    return drawn_map(extract, features, MapGrid(max(rows, 1), max(cols, 1), step, x_min, y_min))


def write_extract_map(directory: Path, drawn: GeoreferencedMap, overwrite: bool = False) -> None:
    """Write `map.json`, `map.png` and a picture to look at into a folder, which may hold a drive.

    Raises
    ------
    SkyfixError
        If there is a map already, unless it may be overwritten, or the folder cannot be written.
    """
    if (directory / MAP_FILE).exists() and not overwrite:
        raise SkyfixError(f"{directory / MAP_FILE}: exists; --overwrite replaces it")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_map(directory, drawn.raster, drawn.origin_lat_lon)
        Image.fromarray(drawn.raster.picture).save(directory / PREVIEW_FILE)
    except OSError as error:
        raise SkyfixError(f"{directory}: cannot be written: {error.strerror}") from error


def local_xy(origin_lat_lon: tuple[float, float], lat_lon: tuple[float, float]) -> tuple[float, float]:
    """Where (latitude, longitude) in degrees lies in the map frame of an origin, metres."""
    lat, lon = lat_lon
    x, y = local_projection(origin_lat_lon).transform(lon, lat)
    return float(x), float(y)


def shares(drawn: GeoreferencedMap, kinds: tuple[str, ...] = ("building", "road")) -> dict[str, float]:
    """Share of the map that each of some classes covers."""
    classes = drawn.raster.classes
    assert classes is not None  # drawn_map sees to it
    return {kind: float(np.mean(classes == CLASS_INDEX[kind])) for kind in kinds}
