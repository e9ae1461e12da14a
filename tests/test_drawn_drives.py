"""Drawn worlds about the demo's streets: what is drawn, what is shifted, and which map is shown."""

import numpy as np

from benchmarks.drawn_drives import AERIAL_IMAGE, CARRIAGEWAYS, OPEN_STREET_MAP, DrawnDrive
from learned.map_raster import CLASS_INDEX
from sequences.demo import DemoSequence


def test_a_drive_shows_the_map_of_its_kind_and_has_a_world_of_its_own() -> None:
    drive = DrawnDrive(1, kind=CARRIAGEWAYS)
    assert set(drive.maps) == {OPEN_STREET_MAP, AERIAL_IMAGE, CARRIAGEWAYS}
    assert drive.map is drive.maps[CARRIAGEWAYS]
    assert {kind for kind, shown in drive.maps.items() if shown.shows_buildings} == {OPEN_STREET_MAP, AERIAL_IMAGE}
    of_demo = DemoSequence(1)
    assert not np.array_equal(drive.world.surface, of_demo.world.surface)
    known, roads = drive.maps[OPEN_STREET_MAP].classes, drive.map.classes
    assert known is not None
    assert roads is not None
    on_both = (known == CLASS_INDEX["road"]) & (roads == CLASS_INDEX["road"])
    assert on_both.sum() > 0.9 * (known == CLASS_INDEX["road"]).sum()  # the same streets


def test_an_offset_shifts_the_world_and_not_the_map() -> None:
    drives = [DrawnDrive(0), DrawnDrive(0, map_offset_m=0.0)]
    assert np.array_equal(drives[0].world.surface, DemoSequence(0).world.surface)
    assert not np.array_equal(drives[0].world.surface, drives[1].world.surface)
    first, second = (drive.map.classes for drive in drives)
    assert first is not None
    assert second is not None
    assert (first == second).mean() > 0.999  # but for the garden fences and sheds that it knows
