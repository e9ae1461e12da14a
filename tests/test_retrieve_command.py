"""What `skyfix retrieve` counts, and an index file of another map is refused."""

from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_drive import FRAMES, MadeDrive, write_made_drive
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from learned.bev import BevSettings
from learned.map_raster import MapRaster
from learned.place_embedding import PlaceEmbedding
from learned.place_index import PlaceIndex, Retrieved
from learned.retrieval import Retriever, fingerprint_of, map_digest
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings
from sequences.cli_retrieve import retrieve
from sequences.registry import open_sequence
from sequences.retrieval import index_of, look_up, places_csv, summary_of, summary_table


@pytest.fixture(scope="module")
def retriever() -> Retriever:
    """Of a network and an embedding that know nothing."""
    torch.manual_seed(0)
    matcher = RotMatch(RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8), BevSettings(20.0))))
    rings = RingHarmonics((4.0, 8.0, 16.0), orders=4, cell_m=2.0, reach_m=20.0)
    weights = torch.randn(5, 12, 3, dtype=torch.complex64)
    return Retriever(matcher, PlaceEmbedding(weights, weights, *torch.zeros(2, 12), fingerprint_of(matcher.net), rings))


def test_on_a_map_of_few_tiles_the_right_one_is_among_them(
    made_drive: MadeDrive, retriever: Retriever, tmp_path: Path
) -> None:
    """120 m hold 4 tiles: any answer has the right one within 5; an index that was kept scores alike."""
    opened, kept = open_sequence(made_drive.path), tmp_path / "map.npz"

    def scored(frames: int) -> dict[str, Any]:
        index = index_of(opened, retriever, kept)
        return summary_of(opened, index, look_up(opened, retriever, index, frames, 20))

    scores = [scored(7) for _ in range(2)]
    assert kept.exists()
    assert (scores[0]["tiles"], scores[0]["frames"]) == (4, 7)
    assert scores[0]["recall"]["5"] == scores[0]["recall"]["100"] == 1.0
    assert scores[0]["tiles"] == scores[1]["tiles"]
    assert scores[0]["recall"]["1"] == pytest.approx(scores[1]["recall"]["1"], abs=1 / 7)  # embeddings kept as halves
    assert scored(10 * FRAMES)["frames"] == FRAMES
    table = summary_table(scores[0])
    assert "7 real scans looked up among 4 tiles" in table
    assert "| prior | 25 % | 100 % | 100 % | 100 % | 100 % |" in table


@dataclass
class SecondBest:
    """Answers with the tile east of the right one, then the right one; knows the truth by the order it is asked in."""

    truths: NDArray[np.float64]
    asked: int = 0

    def query(self, index: PlaceIndex, points: object, ground_z: float, k: int, shortlist: int) -> Retrieved:
        right = self.truths[self.asked, :2] + [20.0, -31.0]
        self.asked += 1
        centres = np.array([right + [64.0, 0.0], right])
        return Retrieved(centres, np.zeros((2, 3)), np.array([1.0, 0.0]), np.zeros((1, 1), np.float32))


def test_the_rank_counted_is_that_of_the_tile_that_holds_the_truth(made_drive: MadeDrive, retriever: Retriever) -> None:
    opened = open_sequence(made_drive.path)
    index = index_of(opened, retriever, None)
    answers = look_up(opened, SecondBest(made_drive.truth.poses), index, 10 * FRAMES)
    assert summary_of(opened, index, answers)["recall"] == {"1": 0.0, "5": 1.0, "10": 1.0, "50": 1.0, "100": 1.0}


def test_an_index_of_another_map_is_refused(made_drive: MadeDrive, retriever: Retriever, tmp_path: Path) -> None:
    opened, kept = open_sequence(made_drive.path), tmp_path / "map.npz"
    index_of(opened, retriever, kept)
    other = open_sequence(write_made_drive(tmp_path / "other", map_half_extent_m=70.0).path)
    with pytest.raises(SkyfixError, match=r"index map.npz: expected one of the map of other, got one of another map"):
        index_of(other, retriever, kept)
    raster = opened.map
    assert raster.classes is not None
    classes = raster.classes.copy()
    assert map_digest(MapRaster.from_classes(raster.grid, classes)) == map_digest(raster)
    classes[0, 0] += 1
    assert map_digest(MapRaster.from_classes(raster.grid, classes)) != map_digest(raster)


def test_places_are_written_without_ground_truth(retriever: Retriever, tmp_path: Path) -> None:
    """The best pose of each tile, the best tile first, for every scan; and there is nothing to score."""
    drive = write_made_drive(tmp_path / "drive")
    (drive.path / "ground_truth.tum").unlink()
    opened = open_sequence(drive.path)
    index = index_of(opened, retriever, None)
    answers = look_up(opened, retriever, index, 5, 20)
    rows = np.genfromtxt(StringIO(places_csv(answers, 3)), delimiter=",", names=True)
    assert len(rows) == 5 * 3
    np.testing.assert_array_equal(rows["rank"].reshape(5, 3), np.tile([1, 2, 3], (5, 1)))
    assert (np.diff(rows["score_nats"].reshape(5, 3), axis=1) <= 0.0).all()
    frames = rows["frame"].astype(int)
    np.testing.assert_allclose(rows["stamp_s"], opened.stamps_ns[frames] * 1e-9, atol=1e-9)
    pose = np.column_stack([rows["x_m"], rows["y_m"], np.deg2rad(rows["heading_deg"])])
    np.testing.assert_allclose(pose, np.concatenate([answer.poses[:3] for answer in answers]), atol=0.006)
    assert summary_of(opened, index, answers)["recall"] is None
    assert "right tile" not in summary_table(summary_of(opened, index, answers))


def test_the_command_asks_for_somewhere_to_put_its_answers(tmp_path: Path) -> None:
    drive = write_made_drive(tmp_path / "drive")
    (drive.path / "ground_truth.tum").unlink()
    with pytest.raises(SkyfixError, match=r"drive: expected ground truth to score places against, or --places FILE"):
        retrieve(drive.path)
    with pytest.raises(SkyfixError, match=r"top: expected 1 to 100 places, got 0"):
        retrieve(drive.path, top=0)
