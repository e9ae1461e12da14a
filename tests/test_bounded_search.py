"""A matcher whose network sees one crop is never asked for more, and a start beyond it is refused before the run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from made_drive import EmulatedMatcher, MadeDrive
from made_translocnet import TINY
from numpy.typing import NDArray

import learned.matcher
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from fusion.prior import UniformPrior
from learned.geometric import GeometricMatcher
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion, largest_half_extent_m
from learned.rotmatch import RotMatch
from learned.translocnet import TransLocNet
from learned.translocnet_matcher import TransLocNetMatcher
from sequences.cli import main
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.search import Phase, SearchPlan
from sequences.track_settings import TrackSettings

LARGEST_M = 21.0


@dataclass
class CroppedMatcher(EmulatedMatcher):
    """Sees 21 m about the middle of its search, as TransLocNet its crop."""

    name: str = "cropped"

    @property
    def largest_half_extent_m(self) -> float:
        return LARGEST_M

    def match(
        self, points: NDArray[np.float32], ground_z: float, map_raster: MapRaster, search: SearchRegion
    ) -> LikelihoodVolume:
        if search.half_extent_m > LARGEST_M:
            raise SkyfixError(f"search: expected a half extent of at most {LARGEST_M:g} m")
        return EmulatedMatcher.match(self, points, ground_z, map_raster, search)


def test_matchers_say_how_much_they_search() -> None:
    torch.manual_seed(0)
    cropped = TransLocNetMatcher(TransLocNet(TINY))
    assert largest_half_extent_m(cropped) == 16.0
    grid = MapGrid(200, 200, 0.5, 0.0, 0.0)
    city = MapRaster(grid, None, np.zeros((200, 200, 3), np.uint8))
    counts = np.zeros((4, TINY.bev.size, TINY.bev.size), np.float32)
    middle = np.array([50.0, 50.0, 0.0])
    cropped.match_counts(counts, city, SearchRegion(middle, 16.0, 0.2))
    with pytest.raises(SkyfixError, match="at most 16 m"):
        cropped.match_counts(counts, city, SearchRegion(middle, 16.1, 0.2))
    for votes in (GeometricMatcher(), RotMatch.shipped()):
        assert largest_half_extent_m(votes) == np.inf


@pytest.mark.parametrize("half_heading_deg", [10.0, 180.0])
def test_no_phase_searches_more(half_heading_deg: float) -> None:
    prior = UniformPrior(np.zeros(3), 62.0, np.deg2rad(half_heading_deg))
    bounded, free = SearchPlan(prior, TrackSettings("wheels"), 64.0), SearchPlan(prior, TrackSettings("wheels"))
    unsure = Estimate(0, np.zeros(3), np.diag([900.0, 900.0, 1.0]), None, 100.0, 0.0, 0.0)
    assert bounded.region(None).half_extent_m == 64.0
    for _ in range(6):
        for plan in (bounded, free):
            plan.move(np.array([5.0, 0.0, 0.0]))
        wide = free.region(unsure)
        assert wide.half_extent_m > 64.0
        assert bounded.region(unsure).half_extent_m == 64.0
        np.testing.assert_array_equal(bounded.region(unsure).centre, wide.centre)
    small = SearchPlan(UniformPrior(np.zeros(3), 10.0, 0.1), TrackSettings("wheels"), 10.0)
    for phase in (Phase.START, Phase.TRACK, Phase.LOST):
        small.phase = phase
        assert small.region(unsure).half_extent_m == 10.0


def test_a_drive_is_tracked_to_its_end_within_it(made_drive: MadeDrive) -> None:
    """Its first search alone, 20 m and a margin of 2 m, would be more."""
    settings = TrackSettings("wheels", seed=3, particles=1000, half_heading_deg=180.0)
    matcher = CroppedMatcher(made_drive.truth.poses)
    result = track(FolderSequence(made_drive.path), matcher, settings)
    assert result.metrics["filter"]["position_error_m"]["median"] < 1.0
    assert [search.half_extent_m for search in matcher.searches[:3]] == [LARGEST_M] * 3
    assert len(matcher.searches) > 10


def test_a_start_beyond_it_is_one_line_before_the_run(
    made_drive: MadeDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher = CroppedMatcher(made_drive.truth.poses)
    monkeypatch.setattr(learned.matcher, "load_matcher", lambda *_: matcher)
    arguments = ["track", str(made_drive.path), "--out", str(tmp_path / "out"), "--half-extent", "22"]
    monkeypatch.setattr(sys, "argv", ["skyfix", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    expected = "start: expected a half extent of at most 21 m, the largest search of cropped, got 22"
    assert capsys.readouterr().err == f"skyfix: error: {expected}\n"
    assert matcher.searches == []
    assert not (tmp_path / "out").exists()
