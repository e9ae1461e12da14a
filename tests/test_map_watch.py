"""Is the vehicle still where the filter has it: when that is asked of the whole map, and what counts as there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.estimate import Estimate
from fusion.grid import MapGrid
from learned.map_raster import MapRaster
from sequences.anywhere_search import AnywhereSearch
from sequences.map_watch import MapWatch
from sequences.track_settings import TrackSettings


def test_the_watch_needs_more_than_one_scan_that_fits_elsewhere_a_little() -> None:
    watch = MapWatch(4.0, 1e5)
    assert not watch.is_due(3.9)
    assert watch.is_due(4.0)
    for way_m in range(4, 404, 4):
        assert watch.record(float(way_m), 0.0) < 1e-3
    assert watch.record(408.0, 1e3) < 0.06  # however much it fits better elsewhere: no scan decides alone
    assert watch.is_due(408.5)  # suspicion: the next scan, however near
    watch.record(412.0, 8.0)
    watch.record(416.0, 8.0)
    assert watch.record(420.0, 8.0) > 0.8
    watch.restart(424.0, 0.0)
    assert watch.lost < 0.01
    assert not watch.is_due(427.9)
    watch.restart(424.0, 0.1)
    assert watch.is_due(424.5)  # a place found with one chance in ten of another is looked at again at once
    assert not MapWatch(0.0, 1e5).is_due(1e6)


def test_a_watch_goes_on_after_the_probation() -> None:
    watch = MapWatch(4.0, 1e5)
    watch.restart(500.0, 0.0)
    assert watch.is_due(2000.0)


def test_a_place_that_was_found_is_on_probation_without_a_watch() -> None:
    watch = MapWatch(0.0, 1e5)
    watch.restart(500.0, 0.0)
    assert not watch.is_due(503.9)
    for way_m in range(504, 600, 4):
        assert watch.is_due(float(way_m))
        watch.record(float(way_m), 0.0)
    assert not watch.is_due(600.0)
    watch.record(600.0, 1e3)
    assert watch.is_due(601.0)  # nothing is left in suspicion
    assert not MapWatch(4.0, 5e6).is_due(19.0)


class _Search:
    """Keeps what it is asked."""

    def __init__(self) -> None:
        self.reaches: list[NDArray[np.float64]] = []

    def over_map(self, map_raster: MapRaster) -> _Search:
        return self

    def contrast(self, points: Any, ground_z: float, pose: Any, reach: NDArray[np.float64]) -> float:
        self.reaches.append(reach)
        return 0.0


def test_near_the_filter_is_what_it_leaves_open() -> None:
    asked: Any = _Search()
    bare = MapRaster.from_classes(MapGrid(100, 100, 1.0, 0.0, 0.0), np.zeros((100, 100), np.uint8))
    search = AnywhereSearch(asked, bare, -1.7, TrackSettings("wheels"), np.random.default_rng(0))
    for sigmas in ([0.1, 1.5, np.deg2rad(1.0)], [50.0, 2.5, np.deg2rad(2.5)], [1.0, 0.0, 3.0]):
        estimate = Estimate(0, np.zeros(3), np.diag(np.square(sigmas)), None, 1.0, 0.0, 0.0)
        search.contrast(np.zeros((1, 4), np.float32), estimate)
    expected = [[2.0, 4.5, np.deg2rad(5.0)], [10.0, 7.5, np.deg2rad(7.5)], [3.0, 2.0, np.deg2rad(10.0)]]
    np.testing.assert_allclose(asked.reaches, expected)
