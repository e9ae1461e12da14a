"""Reading OpenStreetMap extracts and drawing them."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pyproj
import pytest

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, CLASSES
from sequences import osm_tags
from sequences.osm import Area, Line, MapFeatures, local_projection, rasterise, read_osm

LAT, LON = 49.0, 8.4


def _document(ways: dict[str, tuple[list[tuple[float, float]], dict[str, str]]], extra: str = "") -> str:
    """An .osm document of ways given by points in metres about (LAT, LON)."""
    to_lon_lat = local_projection((LAT, LON))
    lines, nodes, number = [], [], 0
    for way, (points, tags) in ways.items():
        references = []
        for x, y in points:
            number += 1
            lon, lat = to_lon_lat.transform(x, y, direction=pyproj.enums.TransformDirection.INVERSE)
            nodes.append(f'<node id="{number}" version="1" lat="{lat:.9f}" lon="{lon:.9f}"/>')
            references.append(number)
        if points[0] == points[-1] and len(points) > 3:
            references[-1] = references[0]
        inner = "".join(f'<nd ref="{reference}"/>' for reference in references)
        inner += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        lines.append(f'<way id="{way}" version="1">{inner}</way>')
    return f'<osm version="0.6">{"".join(nodes)}{"".join(lines)}{extra}</osm>'


def _box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float]]:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]


@pytest.fixture
def features(tmp_path: Path) -> MapFeatures:
    courtyard = (
        '<relation id="1" version="1"><member type="way" ref="10" role="outer"/>'
        '<member type="way" ref="11" role="inner"/><tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
        '<tag k="building:levels" v="4"/></relation>'
    )
    document = _document(
        {
            "10": (_box(20, 10, 60, 40), {}),
            "11": (_box(30, 20, 50, 30), {}),
            "12": (_box(-60, -30, -40, -10), {"building": "yes", "layer": "-1"}),
            "13": ([(-90, 0), (90, 0)], {"highway": "residential", "lanes": "2"}),
            "14": ([(0, -90), (0, 90)], {"highway": "primary", "tunnel": "yes"}),
            "15": (_box(-60, 10, -30, 40), {"leisure": "park"}),
            "16": ([(-60, -50), (60, -50)], {"barrier": "hedge", "height": "2"}),
            "17": (_box(-55, 15, -45, 20), {"building": "roof"}),
        },
        courtyard,
    )
    path = tmp_path / "town.osm.gz"
    path.write_bytes(gzip.compress(document.encode()))
    return read_osm(path, (LAT, LON))


def test_extract_becomes_classes_in_local_metres(features: MapFeatures) -> None:
    kinds = sorted(area.kind for area in features.areas)
    assert kinds == ["building", "grass"]
    assert sorted(line.kind for line in features.lines) == ["hedge", "road"]
    building = next(area for area in features.areas if area.kind == "building")
    assert len(building.rings) == 2
    assert building.height_m == pytest.approx(4 * 3.0 + 2.0)
    assert building.rings[0].min(axis=0) == pytest.approx([20.0, 10.0], abs=0.01)
    assert building.rings[0].max(axis=0) == pytest.approx([60.0, 40.0], abs=0.01)
    assert building.size_m2 == pytest.approx(1200.0, rel=1e-3)


def test_local_metres_are_true_distances() -> None:
    local = local_projection((LAT, LON))
    x, y = local.transform(LON + 0.01, LAT + 0.01)
    _, _, geodesic = pyproj.Geod(ellps="WGS84").inv(LON, LAT, LON + 0.01, LAT + 0.01)
    assert math.hypot(x, y) == pytest.approx(geodesic, rel=1e-6)
    assert x > 0.0
    assert y > 0.0


def test_raster_puts_things_where_they_are(features: MapFeatures) -> None:
    grid = MapGrid(400, 400, 0.5, -100.0, -100.0)
    raster = rasterise(features, grid)
    assert raster.classes is not None

    def at(x: float, y: float) -> str:
        row, col = np.floor(grid.pixel_from_xy((x, y))).astype(int)
        assert raster.classes is not None
        return CLASSES[raster.classes[row, col]]

    assert at(25, 25) == "building"
    assert at(40, 25) == "void"  # the courtyard
    assert at(-50, -20) == "void"  # underground
    assert at(-45, 25) == "grass"
    assert at(-50, 17) == "grass"  # a roof is no building
    assert {at(70, y) for y in (-0.5, 0.0, 0.5)} >= {"road"}
    assert at(0, 60) == "void"  # the tunnel
    assert "hedge" in {at(10, y) for y in (-50.5, -50.0, -49.5)}


def test_ways_are_one_pixel_wide_and_areas_keep_their_size(features: MapFeatures) -> None:
    grid = MapGrid(400, 400, 0.5, -100.0, -100.0)
    classes = rasterise(features, grid).classes
    assert classes is not None
    road = classes == CLASS_INDEX["road"]
    assert road[:, 50:350].sum(axis=0).max() == 1
    building = np.count_nonzero(classes == CLASS_INDEX["building"]) * 0.25
    assert building == pytest.approx(1200 - 200, rel=0.1)


def test_skipped_classes_are_left_out(features: MapFeatures) -> None:
    grid = MapGrid(400, 400, 0.5, -100.0, -100.0)
    classes = rasterise(features, grid, skip=("road", "building")).classes
    assert classes is not None
    assert set(np.unique(classes)) == {CLASS_INDEX[name] for name in ("void", "grass", "hedge")}


def test_shift_by_a_pixel_shifts_the_raster(features: MapFeatures) -> None:
    one = rasterise(features, MapGrid(300, 300, 0.5, -80.0, -75.0)).classes
    other = rasterise(features, MapGrid(300, 300, 0.5, -79.5, -74.5)).classes
    assert one is not None
    assert other is not None
    assert np.array_equal(one[:-1, 1:], other[1:, :-1])


def test_window_keeps_only_what_touches_it(features: MapFeatures) -> None:
    window = MapGrid(20, 20, 1.0, 45.0, 15.0)
    here = features.within(window)
    assert [area.kind for area in here.areas] == ["building"]
    assert here.lines == ()
    assert [line.kind for line in features.within(window, margin_m=16.0).lines] == ["road"]


def test_small_areas_cover_large_ones() -> None:
    square = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]])
    features = MapFeatures(
        (Area("forest", (0.25 * square + 15.0,), size_m2=100.0), Area("grass", (square,), size_m2=1600.0)),
        (Line("path", np.array([[0.0, 5.0], [40.0, 5.0]])),),
    )
    classes = rasterise(features, MapGrid(40, 40, 1.0, 0.0, 0.0)).classes
    assert classes is not None
    assert classes[20, 20] == CLASS_INDEX["forest"]
    assert classes[5, 5] == CLASS_INDEX["grass"]


@pytest.mark.parametrize("content", [b"", b"not a map", b'<osm version="0.6"></osm>'])
def test_unusable_extract_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.osm"
    path.write_bytes(content)
    with pytest.raises(SkyfixError, match=r"map extract: expected .*broken\.osm"):
        read_osm(path)


def test_missing_extract_is_named(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"nowhere\.osm\.pbf"):
        read_osm(tmp_path / "nowhere.osm.pbf")


@pytest.mark.parametrize(
    ("text", "expected"), [("12", 12.0), ("12.5 m", 12.5), ("3,5", 3.5), ("10 ft", 3.048), ("10'", 3.048)]
)
def test_lengths_are_parsed(text: str, expected: float) -> None:
    assert osm_tags.metres(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", [None, "", "wide", "-3", "2;3", "1e9999"])
def test_lengths_that_are_not_understood_are_unknown(text: str | None) -> None:
    assert math.isnan(osm_tags.metres(text))


@pytest.mark.parametrize(
    ("tags", "width"),
    [
        ({"highway": "residential", "width": "7.5"}, 7.5),
        ({"highway": "residential", "width": "900"}, osm_tags.ROAD_WIDTH_M["residential"]),
        ({"highway": "primary", "lanes": "4"}, 4 * osm_tags.LANE_WIDTH_M + 0.8),
        ({"highway": "footway"}, osm_tags.PATH_WIDTH_M["footway"]),
        ({"barrier": "wall"}, 0.0),
    ],
)
def test_width_comes_from_tags_then_lanes_then_kind(tags: dict[str, str], width: float) -> None:
    assert osm_tags.line_width_m(tags) == pytest.approx(width)


@pytest.mark.parametrize(
    ("tags", "kind"),
    [
        ({"amenity": "parking"}, "parking"),
        ({"amenity": "parking", "parking": "underground"}, None),
        ({"natural": "wood"}, "forest"),
        ({"landuse": "residential"}, None),
        ({"building": "house", "amenity": "parking"}, "building"),
        ({"building": "yes", "location": "underground"}, None),
        ({"highway": "service", "area": "yes"}, "road"),
    ],
)
def test_area_classes(tags: dict[str, str], kind: str | None) -> None:
    assert osm_tags.area_class(tags) == kind
