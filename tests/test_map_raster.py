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


@pytest.mark.parametrize("photograph", [False, True])
@pytest.mark.parametrize("metres_per_pixel", [0.25, 0.75, 1.0, 1.5])
def test_of_a_large_map_a_part_is_sampled(
    photograph: bool, metres_per_pixel: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows about a map, over its edges and beside it: what the whole shows, exactly."""
    rng = np.random.default_rng(0)
    grid = MapGrid(90, 120, 0.5, -5.0, 7.0)
    classes = rng.integers(0, len(CLASSES), (90, 120), dtype=np.uint8)
    whole = MapRaster.from_classes(grid, classes)
    if photograph:
        whole = MapRaster(grid, None, rng.integers(0, 256, (90, 120, 3), dtype=np.uint8))
    size = int(8.0 / metres_per_pixel)
    corners = np.concatenate([rng.integers((-80, 0), (440, 416), (60, 2)) / 8.0, [[-500.0, 3e5], [1e5, 20.0]]])
    windows = [MapGrid(size, size - 1, metres_per_pixel, x0, y0) for x0, y0 in corners.tolist()]
    expected = [whole.resampled(window).picture for window in windows]
    assert sum(picture.any() for picture in expected) > 30
    monkeypatch.setattr("learned.map_raster._LARGEST_SIDE", 40)
    for window, picture in zip(windows, expected, strict=True):
        np.testing.assert_array_equal(whole.resampled(window).picture, picture)


@pytest.mark.parametrize("tall", [False, True])
@pytest.mark.parametrize("photograph", [False, True])
def test_a_map_may_be_larger_than_opencv_samples(tall: bool, photograph: bool) -> None:
    shape = (40_000, 8) if tall else (8, 40_000)
    classes = np.zeros(shape, np.uint8)
    classes[(slice(38_000, 38_020), slice(None)) if tall else (slice(None), slice(38_000, 38_020))] = 1
    grid = MapGrid(*shape, 0.25, 0.0, 0.0)
    whole = MapRaster(grid, None, PALETTE[classes]) if photograph else MapRaster.from_classes(grid, classes)
    along = 0.25 * (40_000 - 38_020 if tall else 38_000) - 5.0
    window = MapGrid(30, 4, 0.5, 0.0, along) if tall else MapGrid(4, 30, 0.5, along, 0.0)
    rows, cols = np.nonzero(whole.resampled(window).picture[..., 0] > 85)
    np.testing.assert_array_equal(np.unique(rows if tall else cols), np.arange(10, 20))
    everything = MapGrid(20_000, 4, 0.5, 0.0, 0.0) if tall else MapGrid(4, 20_000, 0.5, 0.0, 0.0)
    got = "20000 x 4 from 40000 x 8" if tall else "4 x 20000 from 8 x 40000"
    with pytest.raises(SkyfixError, match=f"map window: expected at most 32766 pixels on a side, got {got} of the map"):
        whole.resampled(everything)
    finer = MapGrid(3, 40_000, 0.125, 0.0, 0.0)
    with pytest.raises(SkyfixError, match="map window: expected at most 32766 pixels on a side, got 3 x 40000"):
        whole.resampled(finer)


def test_misfits_are_refused() -> None:
    with pytest.raises(SkyfixError, match="below 12"):
        MapRaster.from_classes(GRID, np.full((30, 40), 200, np.uint8))
    with pytest.raises(SkyfixError, match="map picture"):
        MapRaster(GRID, None, np.zeros((30, 41, 3), np.uint8))
