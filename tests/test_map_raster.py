"""Map rasters: palette, crops and resampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.map_raster import CLASS_INDEX, CLASSES, PALETTE, MapRaster

GRID = MapGrid(30, 40, 0.5, -5.0, 7.0)


def raster(seed: int = 0) -> MapRaster:
    classes = np.random.default_rng(seed).integers(0, len(CLASSES), (30, 40), dtype=np.uint8)
    return MapRaster.from_classes(GRID, classes)


def test_every_class_has_a_colour_of_its_own() -> None:
    assert len(np.unique(PALETTE, axis=0)) == len(CLASSES)


@given(x=st.floats(-12, 22), y=st.floats(0, 30))
def test_a_crop_shows_what_the_map_shows_and_void_outside(x: float, y: float) -> None:
    whole = raster()
    crop = whole.crop(GRID.window((x, y), 4.0))
    rows, cols = np.mgrid[0 : crop.grid.rows, 0 : crop.grid.cols] + 0.5
    xy = crop.grid.xy_from_pixel(np.stack([rows, cols], axis=-1))
    inside = GRID.contains(xy)
    pixel = np.floor(GRID.pixel_from_xy(xy[inside])).astype(int)
    assert crop.classes is not None
    assert whole.classes is not None
    np.testing.assert_array_equal(crop.classes[inside], whole.classes[pixel[:, 0], pixel[:, 1]])
    assert (crop.classes[~inside] == CLASS_INDEX["void"]).all()
    np.testing.assert_array_equal(crop.picture, PALETTE[crop.classes])


@pytest.mark.parametrize("metres_per_pixel", [0.25, 0.4, 1.0])
def test_resampling_keeps_places(metres_per_pixel: float) -> None:
    classes = np.zeros((30, 40), np.uint8)
    classes[8:16, 20:28] = CLASS_INDEX["building"]
    size = round(10 / metres_per_pixel)
    window = MapGrid(size, size, metres_per_pixel, 3.0, 11.0)
    for whole in (
        MapRaster.from_classes(GRID, classes),
        MapRaster(GRID, None, PALETTE[classes]),
    ):
        picture = whole.resampled(window).picture
        rows, cols = np.nonzero(picture[..., 0] > 85)
        centre = window.xy_from_pixel((rows.mean() + 0.5, cols.mean() + 0.5))
        np.testing.assert_allclose(centre, GRID.xy_from_pixel((12, 24)), atol=metres_per_pixel / 2 + 0.01)


def test_misfits_are_refused() -> None:
    with pytest.raises(SkyfixError, match="below 12"):
        MapRaster.from_classes(GRID, np.full((30, 40), 200, np.uint8))
    with pytest.raises(SkyfixError, match="map picture"):
        MapRaster(GRID, None, np.zeros((30, 41, 3), np.uint8))
