"""The map of a drive that comes without one: found beside the drive, georeferenced by latitude and longitude.

The nearest of the drive's own folder and those above it is taken that holds either of

    map/map.json                          a map in the folder format whose `origin_lat_lon_alt` is given; it lies in the
                                          local frame of that origin (`sequences.osm.local_projection`)
    *.osm.pbf, *.osm.gz, *.osm            one OpenStreetMap extract; drawn around the drive at 2 px/m, the resolution of
                                          the KITTI + OSM protocol, in the local frame of the drive's first fix

and where none does, the satellite images of KITTI + aerial, one a record of the drive, as one photograph:

    satmap/DATE/DRIVE/NNNNNNNNNN.png      beside raw_data/; see `sequences.satellite`
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import MapRaster
from sequences.aerial_mosaic import mosaic
from sequences.map_source import MAP_FILE, read_map, read_origin
from sequences.osm import MapFeatures, local_projection, rasterise, read_osm
from sequences.satellite import read_satellite_image

OSM_METRES_PER_PIXEL = 0.5
OSM_MARGIN_M = 100.0
"""Map around the drive: the protocol's crop reaches 64 m around a start that is up to 28 m off."""
_EXTRACTS = ("*.osm.pbf", "*.osm.gz", "*.osm")
WIDEST_M = 20_000.0


@dataclass(frozen=True, slots=True)
class GeoreferencedMap:
    """A map and the latitude and longitude (degrees) of its frame's origin."""

    raster: MapRaster
    origin_lat_lon: tuple[float, float]


def find_map(folders: Iterable[Path], lat_lon: FloatArray, satellite_images: list[Path]) -> GeoreferencedMap:
    """The map of a drive through (N, 2) latitudes and longitudes, from the first of the folders that holds one.

    Where none does it is made of the images, one a fix, if the first of them exists.

    Raises
    ------
    SkyfixError
        If no folder holds a map, one holds several extracts, the map has no origin or cannot be read, or it shows
        nothing around the drive.
    """
    looked = []
    for folder in folders:
        looked.append(str(folder))
        if (folder / "map" / MAP_FILE).exists():
            return _folder_map(folder / "map")
        extracts = sorted({file for pattern in _EXTRACTS for file in folder.glob(pattern)})
        if len(extracts) > 1:
            raise SkyfixError(f"{folder}: expected one map extract, got {', '.join(file.name for file in extracts)}")
        if extracts:
            return _drawn(extracts[0], lat_lon)
    if satellite_images and satellite_images[0].exists():
        origin, xy = _local(lat_lon)
        return GeoreferencedMap(mosaic(xy, lambda index: read_satellite_image(satellite_images[index])), origin)
    raise SkyfixError(
        f"map: expected map/{MAP_FILE} or an OpenStreetMap extract in one of {', '.join(looked)}, or satmap/"
    )


def _local(lat_lon: FloatArray) -> tuple[tuple[float, float], FloatArray]:
    """The first fix, and all of them (N, 2) in its local frame."""
    origin = (float(lat_lon[0, 0]), float(lat_lon[0, 1]))
    return origin, np.stack(local_projection(origin).transform(lat_lon[:, 1], lat_lon[:, 0]), axis=-1)


def _folder_map(folder: Path) -> GeoreferencedMap:
    origin = read_origin(folder)
    if origin is None:
        raise SkyfixError(f"{folder / MAP_FILE}: origin_lat_lon_alt: expected two or three numbers, got None")
    return GeoreferencedMap(read_map(folder), origin)


def _drawn(extract: Path, lat_lon: FloatArray) -> GeoreferencedMap:
    origin, xy = _local(lat_lon)
    low = np.floor(xy.min(axis=0) - OSM_MARGIN_M)
    size = xy.max(axis=0) + OSM_MARGIN_M - low
    if not size.max() < WIDEST_M:
        raise SkyfixError(f"map: expected a drive within {WIDEST_M:g} m, got fixes {size.max():g} m apart")
    cols, rows = np.ceil(size / OSM_METRES_PER_PIXEL).astype(int)
    grid = MapGrid(int(rows), int(cols), OSM_METRES_PER_PIXEL, float(low[0]), float(low[1]))
    return drawn_map(extract, read_osm(extract, origin), grid)


def drawn_map(extract: Path, features: MapFeatures, grid: MapGrid) -> GeoreferencedMap:
    """The features of an extract on a grid in their local frame; SkyfixError if there are none on it."""
    raster, (lat, lon) = rasterise(features, grid), features.origin_lat_lon
    if raster.classes is None or not raster.classes.any():
        raise SkyfixError(f"{extract}: expected map features around {lat:.5f}, {lon:.5f}, got none")
    return GeoreferencedMap(raster, (lat, lon))
