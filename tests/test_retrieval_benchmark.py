"""The map that retrieval is measured on: three drives' maps side by side, and scans taken where it says."""

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.retrieval import Mosaic, Window, main
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.trajectory import Trajectory
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences.lidar import LidarModel, simulate_scan

PLACES = (((240.0, 360.0), (0.0, 0.0)), ((240.0, 240.0), (1000.0, 20.0)), ((240.0, 240.0), (1500.0, 1700.0)))


class Straight:
    """A drive along a road between houses, which stand elsewhere with every seed."""

    scans_simulated, odometry_names, ground_z = False, (), -1.0

    def __init__(self, seed: int, origin: tuple[float, float]) -> None:
        rng = np.random.default_rng(seed)
        self.name = f"straight-{seed}"
        self.map = MapRaster.from_classes(MapGrid(800, 900, 0.5, *origin), self._classes(rng))
        self.stamps_ns: NDArray[np.int64] = np.arange(60, dtype=np.int64) * 10**9
        along = origin[0] + 150.0 + np.arange(60) * 2.0
        poses = np.column_stack([along, np.full(60, origin[1] + 200.0), np.zeros(60)])
        self.ground_truth: Trajectory | None = Trajectory(self.stamps_ns, poses, None, "map")

    @staticmethod
    def _classes(rng: np.random.Generator) -> NDArray[np.uint8]:
        classes = np.full((800, 900), CLASS_INDEX["grass"], np.uint8)
        for row, col in rng.integers(0, (780, 880), (90, 2)):
            classes[row : row + 20, col : col + 20] = CLASS_INDEX["building"]
        classes[386:414] = CLASS_INDEX["road"]
        return classes

    def scan(self, index: int) -> NDArray[np.float32]:
        raise AssertionError("its own scans are not asked for")

    def odometry(self, name: str) -> Trajectory:
        raise SkyfixError(f"odometry: expected none, got {name}")


@pytest.fixture(scope="module")
def windows() -> list[Window]:
    drives = [Straight(0, (10.2, -700.0)), Straight(1, (0.0, 0.0)), Straight(2, (-450.0, 33.5))]
    return [Window.about(drive, *place) for drive, place in zip(drives, PLACES, strict=True)]


def test_scans_are_taken_where_the_map_shows_their_surroundings(windows: list[Window]) -> None:
    mosaic = Mosaic(windows, 8, seed=3)
    assert mosaic.ground_truth is not None
    assert mosaic.map.classes is not None
    assert len(mosaic.stamps_ns) == 8
    assert (mosaic.map.grid.width_m, mosaic.map.grid.height_m) == (2000.0, 2000.0)
    grid, poses = mosaic.map.grid, mosaic.ground_truth.poses
    per_window = [3, 3, 2]
    for number, pose in enumerate(poses):
        window = windows[int(np.searchsorted(np.cumsum(per_window), number, side="right"))]
        own = window.drive.map
        assert own.classes is not None
        row, col = np.rint(grid.pixel_from_xy(pose[:2])).astype(int)
        at_row, at_col = np.rint(own.grid.pixel_from_xy((pose - window.shift)[:2])).astype(int)
        about, there = (
            (slice(at - 80, at + 80) for at in (row, col)),
            (slice(at - 80, at + 80) for at in (at_row, at_col)),
        )
        np.testing.assert_array_equal(mosaic.map.classes[tuple(about)], own.classes[tuple(there)])
    assert len(np.unique(poses.round(3), axis=0)) == 8
    model = LidarModel()
    by_hand = simulate_scan(windows[1].world(3), (poses[4] - windows[1].shift), model, np.random.default_rng((3, 4)))
    np.testing.assert_array_equal(mosaic.scan(4), by_hand)


def test_what_cannot_be_put_together_is_one_line(windows: list[Window]) -> None:
    drive = Straight(4, (0.0, 0.0))
    with pytest.raises(SkyfixError, match=r"straight-4: expected a drive inside a window of .* got none of it there"):
        Window.about(drive, (150.0, 150.0), (0.0, 0.0))
    drive.ground_truth = None
    with pytest.raises(SkyfixError, match="straight-4: expected a drive with ground truth on a map with classes"):
        Window.about(drive, (240.0, 240.0), (0.0, 0.0))
    with pytest.raises(SkyfixError, match="odometry: expected none, got any"):
        Mosaic(windows, 3, seed=0).odometry("any")
    with pytest.raises(SkyfixError, match="expected 3 drives and 3 scans or more, got 1 and 9"):
        main(["demo"], scans=9)
