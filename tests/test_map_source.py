"""map.json and its layers: one vocabulary out of many, layers in order, errors that name what is wrong."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, CLASSES, PALETTE, MapRaster
from sequences.map_source import class_of, read_map, write_map

SIZE = {"metres_per_pixel": 0.25, "rows": 2, "cols": 3, "x0": 10.0, "y0": -5.0}


def write(path: Path, layers: list[dict[str, Any]], **changes: Any) -> Path:
    """Write a map of 2 x 3 pixels; each layer brings its pixels along under 'pixels'."""
    for layer in layers:
        pixels = layer.pop("pixels", None)
        if pixels is not None:
            Image.fromarray(np.array(pixels, dtype=np.uint8)).save(path / layer["file"])
    (path / "map.json").write_text(json.dumps({**SIZE, "layers": layers, **changes}))
    return path


def names(raster: MapRaster) -> list[list[str]]:
    assert raster.classes is not None
    return [[CLASSES[index] for index in row] for row in raster.classes]


def layer(name: str, classes: list[str] | None, pixels: Any) -> dict[str, Any]:
    return {"name": name, "file": f"{name}.png", "classes": classes, "pixels": pixels}


def test_ways_are_painted_over_areas_and_void_lets_them_through(tmp_path: Path) -> None:
    ways = layer("ways", ["void", "fence", "busway", "kerb"], [[0, 1, 2], [3, 0, 0]])
    areas = layer("areas", ["void", "building", "park"], [[1, 1, 2], [2, 0, 1]])
    raster = read_map(write(tmp_path, [ways, areas]))  # listed the other way round
    assert names(raster) == [["building", "fence", "road"], ["grass", "void", "building"]]
    assert raster.grid == MapGrid(2, 3, 0.25, 10.0, -5.0)
    np.testing.assert_array_equal(raster.picture, PALETTE[raster.classes])


def test_layers_of_points_are_left_out(tmp_path: Path) -> None:
    nodes = layer("nodes", None, [[9, 9, 9], [9, 9, 9]])
    raster = read_map(write(tmp_path, [nodes, layer("areas", ["void", "water"], [[0, 1, 0], [0, 0, 0]])]))
    assert names(raster) == [["void", "water", "void"], ["void", "void", "void"]]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("building_outline", "void"),
        ("kerb", "void"),
        ("ground", "void"),
        ("not drivable", "void"),
        ("drivable", "road"),
        ("busway", "road"),
        ("cycleway", "path"),
        ("vegetation", "tree"),
        ("tree_row", "tree"),
        ("playground", "grass"),
        ("Park", "grass"),
        *((name, name) for name in CLASSES),
    ],
)
def test_other_peoples_names_are_understood(name: str, expected: str) -> None:
    assert class_of(name) == expected


def test_an_unknown_class_is_refused_and_the_known_ones_listed(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"'lava': unknown; known are .*building.*road"):
        read_map(write(tmp_path, [layer("areas", ["void", "lava"], [[0, 0, 0], [0, 0, 0]])]))


def test_a_photograph_is_a_picture_without_classes(tmp_path: Path) -> None:
    rgb = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    Image.fromarray(rgb).save(tmp_path / "aerial.png")
    raster = read_map(write(tmp_path, [{"name": "aerial", "file": "aerial.png", "kind": "image"}]))
    assert raster.classes is None
    np.testing.assert_array_equal(raster.picture, rgb)


def test_a_palette_image_gives_its_indices(tmp_path: Path) -> None:
    image = Image.new("P", (3, 2))
    image.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255] + [0] * 759)
    image.putdata([0, 1, 2, 2, 1, 0])
    image.save(tmp_path / "areas.png")
    entry = {"name": "areas", "file": "areas.png", "classes": ["void", "road", "grass"]}
    assert names(read_map(write(tmp_path, [entry]))) == [["void", "road", "grass"], ["grass", "road", "void"]]


def test_a_map_survives_writing_and_reading(tmp_path: Path) -> None:
    grid = MapGrid(5, 7, 0.327, 1.5, -2.25)
    classes = np.random.default_rng(0).integers(0, len(CLASSES), (5, 7)).astype(np.uint8)
    write_map(tmp_path, MapRaster.from_classes(grid, classes))
    back = read_map(tmp_path)
    assert back.grid == grid
    np.testing.assert_array_equal(back.classes, classes)
    picture = np.random.default_rng(1).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    write_map(tmp_path, MapRaster(grid, None, picture))
    back = read_map(tmp_path)
    assert back.classes is None
    np.testing.assert_array_equal(back.picture, picture)


AREAS: dict[str, Any] = {"name": "areas", "file": "areas.png", "classes": ["void", "road"]}


@pytest.mark.parametrize(
    ("layers", "changes", "message"),
    [
        ([{**AREAS, "pixels": [[0, 1], [0, 1]]}], {}, r"areas.png: expected \(2, 3\) uint8 .*, got \(2, 2\)"),
        ([{**AREAS, "pixels": [[0, 1, 2], [0, 0, 0]]}], {}, "areas.png: expected indices below 2, its classes, got 2"),
        ([AREAS], {}, "areas.png: cannot be read: No such file"),
        ([], {}, "layers: expected a list"),
        ([{"name": "areas"}], {}, "layers: expected {name, file, classes}"),
        ([{**AREAS, "classes": "road"}], {}, "classes: expected a list of names or null"),
        ([{**AREAS, "classes": None, "pixels": [[0, 0, 0], [0, 0, 0]]}], {}, "expected a layer with classes"),
        ([AREAS], {"rows": "two"}, "rows: expected a finite number, got 'two'"),
        ([AREAS], {"rows": 2.5}, "rows, cols: expected whole numbers"),
        ([AREAS], {"metres_per_pixel": 0}, "expected metres_per_pixel > 0"),
        ([AREAS], {"x0": None}, "x0: expected a finite number"),
    ],
)
def test_bad_maps_are_refused_in_one_line(
    tmp_path: Path, layers: list[dict[str, Any]], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(SkyfixError, match=message) as caught:
        read_map(write(tmp_path, [dict(entry) for entry in layers], **changes))
    assert "\n" not in str(caught.value)


def test_files_that_are_not_what_they_should_be(tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"map\.json: cannot be read: No such file"):
        read_map(tmp_path)
    (tmp_path / "map.json").write_text("{not json")
    with pytest.raises(SkyfixError, match=r"map\.json: expected JSON"):
        read_map(tmp_path)
    (tmp_path / "map.json").write_text("[1, 2]")
    with pytest.raises(SkyfixError, match="expected a JSON object, got a list"):
        read_map(tmp_path)
    (tmp_path / "areas.png").write_bytes(b"not a picture")
    with pytest.raises(SkyfixError, match=r"areas\.png: cannot be read: not a readable image"):
        read_map(write(tmp_path, [dict(AREAS)]))
    assert CLASS_INDEX["void"] == 0  # what paint leaves untouched
