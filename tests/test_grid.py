"""MapGrid: one convention, both directions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import MapGrid, SkyfixError

grids = st.builds(
    MapGrid,
    rows=st.integers(1, 500),
    cols=st.integers(1, 500),
    metres_per_pixel=st.floats(0.05, 5.0),
    x0=st.floats(-1e4, 1e4),
    y0=st.floats(-1e4, 1e4),
)
unit = st.floats(0.0, 1.0)


def test_the_documented_formula():
    grid = MapGrid(rows=4, cols=6, metres_per_pixel=0.5, x0=10.0, y0=20.0)
    np.testing.assert_allclose(grid.xy_from_pixel((0.5, 0.5)), [10.25, 21.75])  # centre of the north-west pixel
    np.testing.assert_allclose(grid.xy_from_pixel((4.0, 0.0)), [10.0, 20.0])  # lower-left corner
    np.testing.assert_allclose(grid.pixel_from_xy((13.0, 22.0)), [0.0, 6.0])  # upper-right corner
    assert (grid.width_m, grid.height_m, grid.area_m2) == (3.0, 2.0, 6.0)
    np.testing.assert_allclose(grid.centre_xy, [11.5, 21.0])


@given(grids, unit, unit)
def test_pixels_and_metres_undo_each_other(grid, across, up):
    xy = np.array([grid.x0 + across * grid.width_m, grid.y0 + up * grid.height_m])
    np.testing.assert_allclose(grid.xy_from_pixel(grid.pixel_from_xy(xy)), xy, atol=1e-8)


@given(grids)
def test_centres_are_the_pixels_at_one_half(grid):
    x, y = grid.centres()
    assert x.shape == (grid.cols,)
    assert y.shape == (grid.rows,)
    row, col = grid.rows - 1, grid.cols - 1
    np.testing.assert_allclose([x[col], y[row]], grid.xy_from_pixel((row + 0.5, col + 0.5)), atol=1e-8)
    assert (np.diff(x) > 0).all()
    assert (np.diff(y) < 0).all()


def test_contains_includes_edges_and_excludes_nan():
    grid = MapGrid(2, 2, 1.0, 0.0, 0.0)
    points = [[0.0, 0.0], [2.0, 2.0], [2.0001, 1.0], [1.0, -0.0001], [np.nan, 1.0]]
    np.testing.assert_array_equal(grid.contains(points), [True, True, False, False, False])


@given(grids, st.floats(-0.5, 1.5), st.floats(-0.5, 1.5), st.floats(0.1, 50.0))
def test_window_covers_what_was_asked_for_and_lies_on_the_pixels(grid, across, up, half_extent):
    centre = np.array([grid.x0 + across * grid.width_m, grid.y0 + up * grid.height_m])
    window = grid.window(centre, half_extent)
    slack = 0.01 * grid.metres_per_pixel
    assert window.rows == window.cols
    assert window.rows % 2 == 1
    assert window.width_m <= 2 * half_extent + 3.01 * grid.metres_per_pixel
    assert window.x0 <= centre[0] - half_extent + slack
    assert window.y0 <= centre[1] - half_extent + slack
    assert window.x0 + window.width_m >= centre[0] + half_extent - slack
    assert window.y0 + window.height_m >= centre[1] + half_extent - slack
    row0, col0 = grid.offset_of(window)
    in_window = np.array([1.5, 2.5])
    np.testing.assert_allclose(
        window.xy_from_pixel(in_window), grid.xy_from_pixel(in_window + np.array([row0, col0])), atol=1e-6
    )


def test_offset_slices_the_same_ground():
    grid = MapGrid(20, 30, 0.5, 100.0, -50.0)
    x, y = grid.centres()
    raster = x[None, :] + 1000.0 * y[:, None]
    window = grid.window((107.3, -45.1), 2.0)
    row0, col0 = grid.offset_of(window)
    wx, wy = window.centres()
    cut = raster[row0 : row0 + window.rows, col0 : col0 + window.cols]
    np.testing.assert_allclose(cut, wx[None, :] + 1000.0 * wy[:, None])


def test_offset_refuses_other_pixels():
    grid = MapGrid(10, 10, 0.5, 0.0, 0.0)
    with pytest.raises(SkyfixError, match="window"):
        grid.offset_of(MapGrid(5, 5, 0.5, 0.2, 0.0))
    with pytest.raises(SkyfixError, match="window"):
        grid.offset_of(MapGrid(5, 5, 0.25, 0.0, 0.0))


@pytest.mark.parametrize(
    "bad",
    [
        (0, 5, 1.0, 0, 0),
        (5, 0, 1.0, 0, 0),
        (5, 5, 0.0, 0, 0),
        (5, 5, np.nan, 0, 0),
        (1.5, 2, 1.0, 0, 0),
        (np.nan, 2, 1.0, 0, 0),
    ],
)
def test_impossible_grids_are_refused(bad):
    with pytest.raises(SkyfixError, match="grid"):
        MapGrid(*bad)


def test_windows_need_an_extent_and_a_place():
    grid = MapGrid(10, 10, 0.5, 0.0, 0.0)
    with pytest.raises(SkyfixError, match="half_extent_m"):
        grid.window((0.0, 0.0), 0.0)
    with pytest.raises(SkyfixError, match="centre"):
        grid.window((np.nan, 0.0), 1.0)
