"""What OpenStreetMap tags mean in the map vocabulary: class, width and height of a tagged thing.

The tables follow the OpenStreetMap wiki (keys building, highway, barrier, landuse, natural, leisure, amenity,
waterway). The classes are those of `learned.map_raster.CLASSES`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

Tags = Mapping[str, str]

ROAD_WIDTH_M: dict[str, float] = {
    "motorway": 11.0,
    "motorway_link": 6.0,
    "trunk": 9.0,
    "trunk_link": 6.0,
    "primary": 8.5,
    "primary_link": 5.5,
    "secondary": 8.0,
    "secondary_link": 5.5,
    "tertiary": 7.0,
    "tertiary_link": 5.0,
    "unclassified": 5.5,
    "residential": 6.0,
    "living_street": 5.0,
    "service": 4.0,
    "road": 5.5,
    "busway": 4.0,
    "track": 3.0,
}
"""Ways for cars and their usual carriageway width in metres."""
PATH_WIDTH_M: dict[str, float] = {
    "pedestrian": 5.0,
    "footway": 2.0,
    "cycleway": 2.2,
    "path": 1.6,
    "bridleway": 2.0,
    "steps": 2.0,
}
"""Ways not for cars and their usual width in metres."""
BARRIER_CLASS: dict[str, str] = {
    "wall": "wall",
    "retaining_wall": "wall",
    "city_wall": "wall",
    "fence": "fence",
    "guard_rail": "fence",
    "handrail": "fence",
    "hedge": "hedge",
}
BARRIER_HEIGHT_M: dict[str, float] = {
    "wall": 1.6,
    "retaining_wall": 1.2,
    "city_wall": 4.0,
    "fence": 1.4,
    "guard_rail": 0.75,
    "handrail": 1.0,
    "hedge": 1.6,
}
LANE_WIDTH_M = 3.1
STOREY_HEIGHT_M = 3.0
ROOF_HEIGHT_M = 2.0

_AREA_CLASS: dict[tuple[str, str], str] = {
    **{("landuse", value): "grass" for value in ("grass", "meadow", "village_green", "recreation_ground", "cemetery")},
    **{("leisure", value): "grass" for value in ("park", "garden", "playground", "pitch", "golf_course", "common")},
    ("natural", "grassland"): "grass",
    ("natural", "heath"): "grass",
    ("landuse", "forest"): "forest",
    ("natural", "wood"): "forest",
    ("natural", "scrub"): "forest",
    ("natural", "water"): "water",
    ("waterway", "riverbank"): "water",
    ("landuse", "reservoir"): "water",
    ("landuse", "basin"): "water",
    ("amenity", "parking"): "parking",
}
_NO_BUILDING = frozenset({"no", "roof", "carport", "canopy", "ruins", "demolished", "construction", "bridge"})
_NO_SURFACE_PARKING = frozenset({"underground", "multi-storey", "rooftop", "street_side", "lane"})
_NUMBER = re.compile(r"^\s*(\d+(?:[.,]\d+)?)\s*(m|metres|meters|ft|')?\s*$")


def metres(text: str | None) -> float:
    """Parse a length tag ('12', '12.5 m', '40 ft'); NaN if there is none or it is not understood."""
    match = _NUMBER.match(text or "")
    if match is None:
        return math.nan
    factor = 0.3048 if match.group(2) in ("ft", "'") else 1.0
    return float(match.group(1).replace(",", ".")) * factor


def is_underground(tags: Tags) -> bool:
    """Whether a thing is in a tunnel, below ground or indoors, so that neither a scan nor an aerial image shows
    it."""
    layer = re.match(r"^\s*-\d", tags.get("layer", ""))
    return (
        layer is not None
        or tags.get("tunnel", "no") != "no"
        or tags.get("location") == "underground"
        or "indoor" in tags
        or tags.get("highway") in ("corridor", "elevator")
    )


def area_class(tags: Tags) -> str | None:
    """Class of a closed area, or None if it is not drawn. A building wins over what else the same area is."""
    if is_underground(tags):
        return None
    if tags.get("building", "no") not in _NO_BUILDING and tags.get("location") != "roof":
        return "building"
    if tags.get("amenity") == "parking" and tags.get("parking") in _NO_SURFACE_PARKING:
        return None
    if tags.get("area") == "yes" and tags.get("highway") in ROAD_WIDTH_M:
        return "road"
    if tags.get("area") == "yes" and tags.get("highway") in PATH_WIDTH_M:
        return "path"
    for key in ("landuse", "natural", "leisure", "amenity", "waterway"):
        if (key, tags.get(key, "")) in _AREA_CLASS:
            return _AREA_CLASS[key, tags[key]]
    return None


def line_class(tags: Tags) -> str | None:
    """Class of a way that is drawn as a line, or None."""
    if is_underground(tags):
        return None
    highway = tags.get("highway")
    if highway is not None:
        if tags.get("area") == "yes":
            return None
        return "road" if highway in ROAD_WIDTH_M else "path" if highway in PATH_WIDTH_M else None
    if tags.get("natural") == "tree_row":
        return "tree"
    return BARRIER_CLASS.get(tags.get("barrier", ""))


def line_width_m(tags: Tags) -> float:
    """Width of a way's surface: its tag, else lanes times a lane, else what is usual for its kind; 0 for barriers."""
    highway = tags.get("highway")
    if highway is None:
        return 0.0
    width = metres(tags.get("width"))
    if 1.0 <= width <= 40.0:
        return width
    lanes = metres(tags.get("lanes"))
    if highway in ROAD_WIDTH_M and 1.0 <= lanes <= 10.0:
        return max(lanes * LANE_WIDTH_M + 0.8, 3.5)
    usual = ROAD_WIDTH_M.get(highway, PATH_WIDTH_M.get(highway, 2.0))
    return 0.6 * usual if tags.get("oneway") == "yes" and highway in ("primary", "secondary", "tertiary") else usual


def height_m(tags: Tags) -> float:
    """Height of a building or barrier in metres; NaN where a building says nothing."""
    height = metres(tags.get("height"))
    if 0.2 <= height <= 600.0:
        return height
    levels = metres(tags.get("building:levels"))
    if 1.0 <= levels <= 200.0:
        return levels * STOREY_HEIGHT_M + ROOF_HEIGHT_M
    return BARRIER_HEIGHT_M.get(tags.get("barrier", ""), math.nan)
