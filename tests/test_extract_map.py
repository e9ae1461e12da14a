"""`skyfix map`: what is drawn is what is read again, where it says, and in the frame of its origin."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
import pyproj
import pytest

from fusion.errors import SkyfixError
from learned.map_raster import CLASS_INDEX
from sequences.cli import main
from sequences.drive_map import find_map
from sequences.extract_map import MapRequest, local_xy, map_of_extract, write_extract_map
from sequences.map_source import read_map
from sequences.osm import rasterise, read_osm

EXTRACT = Path(str(resources.files("pyrosm") / "data" / "test.osm.pbf"))
ORIGIN = read_osm(EXTRACT).origin_lat_lon


def skyfix(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr("sys.argv", ["skyfix", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_square_about_an_origin_is_read_again_as_it_was_drawn(tmp_path: Path) -> None:
    drawn = map_of_extract(EXTRACT, MapRequest(ORIGIN, 150.0, 0.5))
    write_extract_map(tmp_path / "drive", drawn)
    grid = drawn.raster.grid
    assert (grid.rows, grid.cols, grid.x0, grid.y0) == (600, 600, -150.0, -150.0)
    read = read_map(tmp_path / "drive")
    assert read.grid == grid
    np.testing.assert_array_equal(read.classes, drawn.raster.classes)
    np.testing.assert_array_equal(read.classes, rasterise(read_osm(EXTRACT, ORIGIN), grid).classes)
    assert (read.classes == CLASS_INDEX["building"]).mean() > 0.05
    assert (tmp_path / "drive" / "map_preview.png").stat().st_size > 1000


def test_all_of_an_extract_is_drawn_about_its_middle() -> None:
    drawn = map_of_extract(EXTRACT, MapRequest(metres_per_pixel=2.0))
    x_min, y_min, x_max, y_max = read_osm(EXTRACT).bounds
    grid = drawn.raster.grid
    assert (grid.x0, grid.y0) == (x_min, y_min)
    assert grid.width_m - 2.0 < x_max - x_min <= grid.width_m
    assert grid.height_m - 2.0 < y_max - y_min <= grid.height_m
    assert drawn.origin_lat_lon == ORIGIN


@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (700.0, -300.0), (-1500.0, 2000.0)])
def test_places_are_where_the_ellipsoid_has_them(east: float, north: float) -> None:
    """Distance and direction from the origin are the geodesic's."""
    azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
    lon, lat, _ = pyproj.Geod(ellps="WGS84").fwd(ORIGIN[1], ORIGIN[0], azimuth, distance)
    np.testing.assert_allclose(local_xy(ORIGIN, (lat, lon)), [east, north], atol=0.01)


def test_a_drive_beside_it_finds_the_map_and_its_origin(tmp_path: Path) -> None:
    write_extract_map(tmp_path / "map", map_of_extract(EXTRACT, MapRequest(ORIGIN, 100.0, 1.0)))
    found = find_map([tmp_path], np.array([ORIGIN]), [])
    assert found.origin_lat_lon == ORIGIN
    assert found.raster.grid.width_m == 200.0


def test_the_command_says_what_it_drew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lat, lon = ORIGIN
    about = ("--origin", lat, lon, "--half-extent", 100)
    north = pyproj.Geod(ellps="WGS84").fwd(lon, lat, 0.0, 60.0)[1]
    assert skyfix(monkeypatch, "map", EXTRACT, tmp_path / "mine", *about, "--place", north, lon) == 0
    told = capsys.readouterr().out.splitlines()
    assert "200 x 200 m" in told[0]
    assert "building" in told[0]
    assert told[-1].endswith("is at x 0.0 y 60.0") or told[-1].endswith("is at x -0.0 y 60.0")
    before = (tmp_path / "mine" / "map.json").read_bytes()
    assert json.loads(before)["origin_lat_lon_alt"][:2] == [lat, lon]
    assert skyfix(monkeypatch, "map", EXTRACT, tmp_path / "mine", *about) == 2
    assert "--overwrite replaces it" in capsys.readouterr().err
    assert (tmp_path / "mine" / "map.json").read_bytes() == before
    assert skyfix(monkeypatch, "map", EXTRACT, tmp_path / "mine", "--overwrite", "--metres-per-pixel", 2) == 0
    assert (tmp_path / "mine" / "map.json").read_bytes() != before


@pytest.mark.parametrize(
    ("request_of", "expected"),
    [
        (lambda: MapRequest((95.0, 8.0)), "origin: expected a latitude within 85 .* got 95 8"),
        (lambda: MapRequest((float("nan"), 8.0)), "origin: expected a latitude"),
        (lambda: MapRequest(half_extent_m=-3.0), "expected a half extent above 0"),
        (lambda: MapRequest(metres_per_pixel=0.0), "expected a metres per pixel above 0"),
        (lambda: MapRequest(ORIGIN, 15_000.0, 0.5), "expected at most 4e.08 pixels, got 60000 x 60000"),
        (lambda: MapRequest((10.0, 8.0)), "origin: expected one within 20000 m of test.osm.pbf, got 10 8"),
        (lambda: MapRequest((ORIGIN[0] + 0.1, ORIGIN[1]), 50.0), "expected map features around"),
    ],
)
def test_bad_requests_are_one_line_and_write_nothing(
    tmp_path: Path, request_of: Callable[[], MapRequest], expected: str
) -> None:
    with pytest.raises(SkyfixError, match=expected) as caught:
        write_extract_map(tmp_path / "mine", map_of_extract(EXTRACT, request_of()))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "mine").exists()


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    drawn = map_of_extract(EXTRACT, MapRequest(ORIGIN, 20.0, 2.0))
    with pytest.raises(SkyfixError, match="cannot be written"):
        write_extract_map(tmp_path / "file" / "below", drawn)
