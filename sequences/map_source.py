"""Read `map.json` and its PNG layers into the one class vocabulary.

A map is a stack of class rasters (row 0 = north) whose class names are other people's. One table brings them to
`learned.map_raster.CLASSES`: names that say 'nothing in particular is here' leave what lies underneath, and so do
names that are derived from others (the outline of a building is where its area ends). Layers are painted areas first,
ways last. A layer without class names holds points (trees, lamps) and is left out. A photograph (`kind: "image"`) is
the picture of a map that has no class layers.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, CLASSES, MapRaster
from sequences.picture import read_indices, read_photograph

MAP_FILE = "map.json"
_TRANSPARENT = 255
_ALIASES: dict[str, str] = {
    # The last three are derived from other classes, or too low for a laser to tell.
    "void": "void, none, nothing, unknown, unlabeled, background, ground, terrain, other, not drivable, "
    "building outline, kerb, curb",
    "building": "building, buildings, house, roof",
    "parking": "parking, parking lot, car park, parking aisle",
    "grass": "grass, park, playground, meadow, lawn, garden, pitch, low vegetation",
    "forest": "forest, wood, woods, scrub",
    "water": "water, river, lake",
    "road": "road, roads, street, busway, drivable, driveable, drivable area, lane, asphalt",
    "path": "path, cycleway, footway, sidewalk, pavement, walkway, crossing, ped crossing, pedestrian",
    "wall": "wall, retaining wall, barrier",
    "fence": "fence, guard rail, railing",
    "hedge": "hedge",
    "tree": "tree, trees, tree row, vegetation, high vegetation",
}
_CLASS_OF_NAME: dict[str, str] = {alias: name for name, aliases in _ALIASES.items() for alias in aliases.split(", ")}
_FIRST, _LAST = "areas", "ways"


@dataclass(frozen=True, slots=True)
class _Layer:
    name: str
    file: str
    class_names: tuple[str, ...] | None
    is_image: bool


def class_of(name: str) -> str:
    """The vocabulary's class for another map's class name; case, `_` and `-` do not matter.

    Raises
    ------
    SkyfixError
        If the name is unknown; the message lists the names that are known.
    """
    key = " ".join(name.lower().replace("_", " ").replace("-", " ").split())
    if key not in _CLASS_OF_NAME:
        raise SkyfixError(f"map class {name!r}: unknown; known are {', '.join(sorted(_CLASS_OF_NAME))}")
    return _CLASS_OF_NAME[key]


def read_map(directory: Path) -> MapRaster:
    """Read `directory/map.json` and its layers at the map's own resolution.

    Raises
    ------
    SkyfixError
        If a file is missing or unreadable, a key is absent or of the wrong type, a layer's size differs from the
        stated one, an index has no class name, or a class name is unknown.
    """
    description = read_json(directory / MAP_FILE)
    grid = _grid(description)
    layers = _layers(description)
    class_layers = [layer for layer in layers if layer.class_names is not None]
    if class_layers:
        classes = np.zeros((grid.rows, grid.cols), dtype=np.uint8)
        for layer in sorted(class_layers, key=_painting_order):
            _paint(classes, _read_png(directory, layer, grid), layer)
        return MapRaster.from_classes(grid, classes)
    images = [layer for layer in layers if layer.is_image]
    if not images:
        raise SkyfixError(f"{MAP_FILE}: expected a layer with classes or one of kind 'image', got neither")
    picture = _read_png(directory, images[0], grid)
    return MapRaster(grid, None, picture)


def read_origin(directory: Path) -> tuple[float, float] | None:
    """Latitude and longitude, degrees, of the origin of `directory/map.json`'s frame; None where it is not given.

    Raises
    ------
    SkyfixError
        If the file is missing or unreadable, or `origin_lat_lon_alt` is anything else than two or three numbers.
    """
    origin = read_json(directory / MAP_FILE).get("origin_lat_lon_alt")
    if origin is None:
        return None
    values = origin if isinstance(origin, list) else []
    if len(values) not in (2, 3) or not all(isinstance(v, (int, float)) and math.isfinite(v) for v in values):
        raise SkyfixError(f"{directory / MAP_FILE}: origin_lat_lon_alt: expected two or three numbers, got {origin!r}")
    return float(values[0]), float(values[1])


def write_map(directory: Path, map_raster: MapRaster, origin_lat_lon: tuple[float, float] | None = None) -> None:
    """Write a map as `map.json` and one PNG: a class raster where classes are known, the picture otherwise.

    `origin_lat_lon`, degrees, says where the map frame's origin is (see `sequences.osm.local_projection`).
    """
    grid = map_raster.grid
    if map_raster.classes is not None:
        layer = {"name": "semantic", "file": "map.png", "classes": list(CLASSES)}
        Image.fromarray(map_raster.classes).save(directory / "map.png")
    else:
        layer = {"name": "aerial", "file": "map.png", "kind": "image"}
        Image.fromarray(map_raster.picture).save(directory / "map.png")
    description = {
        "metres_per_pixel": grid.metres_per_pixel,
        "rows": grid.rows,
        "cols": grid.cols,
        "x0": grid.x0,
        "y0": grid.y0,
        "layers": [layer],
        "origin_lat_lon_alt": None if origin_lat_lon is None else [*origin_lat_lon, 0.0],
    }
    (directory / MAP_FILE).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")


def _painting_order(layer: _Layer) -> int:
    return {_FIRST: 0, _LAST: 2}.get(layer.name, 1)


def _paint(classes: NDArray[np.uint8], indices: NDArray[np.uint8], layer: _Layer) -> None:
    """Paint a layer over `classes` in place."""
    names = layer.class_names or ()
    if int(indices.max()) >= len(names):
        raise SkyfixError(f"{layer.file}: expected indices below {len(names)}, its classes, got {int(indices.max())}")
    table = np.full(256, _TRANSPARENT, dtype=np.uint8)
    for index, name in enumerate(names):
        if class_of(name) != "void":
            table[index] = CLASS_INDEX[class_of(name)]
    painted = table[indices]
    np.copyto(classes, painted, where=painted != _TRANSPARENT)


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file; `SkyfixError` when it cannot be read or holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SkyfixError(f"{path}: expected JSON, got: {error}") from error
    if not isinstance(content, dict):
        raise SkyfixError(f"{path}: expected a JSON object, got a {type(content).__name__}")
    return content


def read_number(content: dict[str, Any], key: str, file: str) -> float:
    """The finite number under `key` of a JSON object read from `file`; `SkyfixError` when it is absent or no number."""
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise SkyfixError(f"{file}: {key}: expected a finite number, got {value!r}")
    return float(value)


def _grid(description: dict[str, Any]) -> MapGrid:
    rows, cols = (read_number(description, key, MAP_FILE) for key in ("rows", "cols"))
    scale, x0, y0 = (read_number(description, key, MAP_FILE) for key in ("metres_per_pixel", "x0", "y0"))
    if not (rows.is_integer() and cols.is_integer()):
        raise SkyfixError(f"{MAP_FILE}: rows, cols: expected whole numbers, got {rows}, {cols}")
    return MapGrid(int(rows), int(cols), scale, x0, y0)


def _layers(description: dict[str, Any]) -> list[_Layer]:
    listed = description.get("layers")
    if not isinstance(listed, list) or not listed:
        raise SkyfixError(f"{MAP_FILE}: layers: expected a list of {{name, file, classes}}, got {listed!r}")
    return [_layer(entry) for entry in listed]


def _layer(entry: Any) -> _Layer:
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise SkyfixError(f"{MAP_FILE}: layers: expected {{name, file, classes}}, got {entry!r}")
    names = entry.get("classes")
    is_list = isinstance(names, list) and names and all(isinstance(name, str) for name in names)
    if names is not None and not is_list:
        raise SkyfixError(
            f"{MAP_FILE}: layer {entry['file']}: classes: expected a list of names or null, got {names!r}"
        )
    is_image = entry.get("kind") == "image"
    class_names = None if names is None or is_image else tuple(names)
    return _Layer(str(entry.get("name", "")), entry["file"], class_names, is_image)


def _read_png(directory: Path, layer: _Layer, grid: MapGrid) -> NDArray[np.uint8]:
    """Pixels of a layer: colours of a photograph, or the indices of an 8-bit grey or palette image."""
    path = directory / layer.file
    pixels = read_photograph(path) if layer.is_image else read_indices(path)
    expected = (grid.rows, grid.cols, 3) if layer.is_image else (grid.rows, grid.cols)
    if pixels.shape != expected or pixels.dtype != np.uint8:
        raise SkyfixError(f"{path.name}: expected {expected} uint8 (8-bit PNG), got {pixels.shape} {pixels.dtype}")
    return pixels
