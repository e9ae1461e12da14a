"""The table of how far errors repeat, by the map's kind: with a matcher whose errors are known."""

import math
from functools import cached_property

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks import error_correlation as benchmark
from benchmarks.drawn_drives import DrawnDrive
from fusion.likelihood import LikelihoodVolume
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from sequences.metrics import distance_along

LENGTH_M = {True: 6.0, False: 25.0}
"""Over how much errors repeat on maps with buildings, and without."""
SIGMA_M = {True: 0.3, False: 2.0}


class Numbered(DrawnDrive):
    """The demo's streets; a scan is nothing but its number. The maps must not be shifted."""

    def __init__(self, number: int, map_offset_m: float | None = None) -> None:
        assert map_offset_m == 0.0
        super().__init__(number, map_offset_m)

    def scan(self, index: int) -> NDArray[np.float32]:
        return np.array([[0.0, 0.0, 0.0, index]], np.float32)


class Repeating:
    """Errs by as much as is drawn for the frame, on the axes of the map."""

    name, error_correlation_length_m = "repeating", 0.0

    def __init__(self) -> None:
        self._truth = Numbered(0, 0.0).ground_truth.poses

    @cached_property
    def _errors(self) -> dict[bool, NDArray[np.float64]]:
        """Gauss-Markov along the way, by whether the map shows buildings."""
        rng = np.random.default_rng(5)
        steps = np.diff(distance_along(self._truth), prepend=0.0)
        found = {}
        for kind, length in LENGTH_M.items():
            error = np.zeros((len(steps), 3))
            for at, rho in enumerate(np.exp(-steps / length)):
                error[at] = rho * error[at - 1] + np.sqrt(1.0 - rho**2) * rng.normal(size=3)
            found[kind] = error * [SIGMA_M[kind], SIGMA_M[kind], 0.05]
        return found

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        frame = int(points[0, 3])
        x, y, heading = self._truth[frame] + self._errors[map_raster.shows_buildings][frame]
        grid = map_raster.grid.window((x, y), 4.0)
        across, along = grid.centres()
        yaw = np.arange(360) * 2.0 * np.pi / 360
        off = (across[None, :, None] - x) ** 2 + (along[:, None, None] - y) ** 2
        turned = 1.0 - np.cos(yaw - heading)
        return LikelihoodVolume.from_scores(-0.5 * off / 0.3**2 - turned / 0.02**2, grid)


def test_lengths_are_found_for_maps_of_either_kind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(benchmark, "load_matcher", lambda name: Repeating())
    monkeypatch.setattr(benchmark, "DrawnDrive", Numbered)
    benchmark.main(worlds=1, every_m=4.0)
    lines = capsys.readouterr().out.splitlines()
    assert "497 simulated scans in 1 worlds, repeating" in lines
    rows = {cells[1].strip(): cells for line in lines if len(cells := line.split("|")) == 6}
    assert float(rows["prior only"][2]) == pytest.approx(math.sqrt(2.0 / np.pi) * 12.0, rel=0.05)  # half of a square
    assert float(rows["prior only"][4]) == 0.0
    assert float(rows["OpenStreetMap"][2]) == pytest.approx(1.18 * 0.3, rel=0.05)  # a Rayleigh's median
    assert float(rows["carriageways alone"][2]) == pytest.approx(1.18 * 2.0, rel=0.1)
    assert float(rows["OpenStreetMap"][4]) == pytest.approx(6.0, abs=1.0)
    assert float(rows["carriageways alone"][4]) == pytest.approx(25.0, abs=6.0)
    assert rows["aerial image"][2:] == rows["OpenStreetMap"][2:]
