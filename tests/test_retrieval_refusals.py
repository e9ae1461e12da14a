"""Retrieval asked for what cannot be, and given files that are none: one clear line each."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_town import TOWN, embedding_of, made_points, small_rotmatch, town
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from learned.bev import BevSettings
from learned.geometric import GeometricMatcher
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.matcher import SearchRegion
from learned.place_embedding import PlaceEmbedding
from learned.place_index import PlaceIndex
from learned.retrieval import Retriever, TileSettings
from learned.ring_harmonics import RingHarmonics
from learned.rotmatch import RotMatch, RotMatchNet, RotMatchSettings


@pytest.fixture(scope="module")
def matcher() -> RotMatch:
    return small_rotmatch()


@pytest.fixture(scope="module")
def index(matcher: RotMatch) -> PlaceIndex:
    return Retriever(matcher, embedding_of(matcher)).build(town())


@pytest.mark.parametrize(("k", "shortlist"), [(0, 72), (3, 0), (2.5, 72), (3, math.nan), ("3", 72), (None, 72)])
def test_nothing_asked_for(index: PlaceIndex, k: int, shortlist: int) -> None:
    with pytest.raises(SkyfixError, match=f"expected whole k and shortlist of 1 or more, got {k} and {shortlist}"):
        index.query(index.embeddings[0], torch.zeros(4, 40, 40), k, shortlist)


def test_bad_input_is_one_line(matcher: RotMatch, index: PlaceIndex, tmp_path: Path) -> None:
    with pytest.raises(SkyfixError, match=r"scan embedding: expected \(7, 5\), got \(3, 5\)"):
        index.similarities(torch.zeros(3, 5, dtype=torch.complex64))
    with pytest.raises(SkyfixError, match=r"index none.npz: expected a file that PlaceIndex.save wrote"):
        PlaceIndex.load(tmp_path / "none.npz")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    with pytest.raises(SkyfixError, match=r"place embedding broken.safetensors: expected a readable file"):
        PlaceEmbedding.load(tmp_path / "broken.safetensors")
    with pytest.raises(SkyfixError, match="expected rising radii"):
        RingHarmonics((8.0, 4.0))
    with pytest.raises(SkyfixError, match="tiles: expected a multiple of a positive step_m"):
        TileSettings(step_m=7.0)
    with pytest.raises(SkyfixError, match="tiles: expected a step_m of a multiple of 2 m, got 1 m"):
        Retriever(matcher, embedding_of(matcher)).build(town(), TileSettings(step_m=1.0))
    with pytest.raises(SkyfixError, match="index: expected one of weights and embedding"):
        Retriever(matcher, embedding_of(matcher)).query(replace(index, fingerprint="others"), made_points(), -1.7)
    mine = embedding_of(matcher)
    retrained = replace(mine, map_weights=2.0 * mine.map_weights)
    with pytest.raises(SkyfixError, match="index: expected one of weights and embedding"):
        Retriever(matcher, retrained).query(index, made_points(), -1.7)
    torch.manual_seed(9)
    other = RotMatch(RotMatchNet(RotMatchSettings(4, (4, 4, 8, 8), BevSettings(20.0))))
    with pytest.raises(SkyfixError, match="place embedding: expected one of the features of weights"):
        Retriever(other, embedding_of(matcher))
    houses = np.full((TOWN.rows, TOWN.cols), CLASS_INDEX["building"], np.uint8)
    with pytest.raises(SkyfixError, match="expected a map with somewhere to drive"):
        Retriever(matcher, embedding_of(matcher)).build(MapRaster.from_classes(TOWN, houses))


def damaged(raw: bytes, number: int) -> bytes:
    """A file cut short, with bytes changed anywhere, in the archive's headers or in its directory."""
    rng = np.random.default_rng(number)
    if number % 4 == 0:
        return raw[: rng.integers(0, len(raw))]
    bytes_ = bytearray(raw)
    heads = [found.start() for found in re.finditer(rb"PK|NUMPY", raw)]
    first = (int(rng.integers(0, len(raw))), int(rng.choice(heads)), len(raw) - 800)[number % 4 - 1]
    for at in first + rng.integers(0, 800 if number % 4 == 3 else 120, 4):
        bytes_[min(at, len(raw) - 1)] = rng.integers(256)
    return bytes(bytes_)


def test_damaged_indices_are_one_line(index: PlaceIndex, tmp_path: Path) -> None:
    path = tmp_path / "town.npz"
    index.save(path)
    raw, lines = path.read_bytes(), []
    for number in range(400):
        path.write_bytes(damaged(raw, number))
        try:
            PlaceIndex.load(path)  # a byte that is read over, a date, does no harm
        except SkyfixError as error:
            lines.append(str(error))
    assert len(lines) > 300
    for line in lines:
        assert re.fullmatch(r"index town\.npz: expected a file that PlaceIndex\.save wrote, got: .+", line)


def test_other_files_are_no_index(tmp_path: Path) -> None:
    (tmp_path / "empty.npz").touch()
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "other.npz", grid=np.zeros(5))
    for name in ("empty.npz", "array.npy", "other.npz", "."):
        with pytest.raises(SkyfixError, match=r"index .*: expected a file that PlaceIndex.save wrote, got: ."):
            PlaceIndex.load(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("cells", np.array([[999, 0]]), "cells .* not all within"),
        ("cells", np.zeros((0, 2), np.int64), "cells .* not all within"),
        ("embeddings", np.zeros((2, 7, 5, 2), np.float16), "embeddings .* of .* places"),
        ("features", np.zeros((4, 8, 8), np.float16), "features .* float16"),
        ("feature_m", np.array(0.0), "features on 0.0 m for cells of 8.0 m"),
        ("feature_m", np.array(3.0), "features on 3.0 m for cells of 8.0 m"),
        ("tile_cells", np.array(0), "tiles of 0 cells"),
        ("temperature", np.array(np.nan), "a temperature of nan"),
    ],
)
def test_an_index_whose_parts_do_not_fit_is_refused(
    index: PlaceIndex, tmp_path: Path, name: str, value: NDArray[np.generic], what: str
) -> None:
    index.save(tmp_path / "town.npz")
    with np.load(tmp_path / "town.npz") as data:
        parts = dict(data)
    np.savez(tmp_path / "town.npz", **{**parts, name: value})
    with pytest.raises(SkyfixError, match=f"PlaceIndex.save wrote, got: .*{what}"):
        PlaceIndex.load(tmp_path / "town.npz")


@pytest.mark.parametrize(
    "sizes",
    [(math.nan, 8.0), (math.inf, 8.0), (64.0, math.nan), (math.inf, math.inf), (1e30, 8.0), (-64.0, -8.0)],
)
def test_tiles_without_a_size_are_refused(sizes: tuple[float, float]) -> None:
    with pytest.raises(SkyfixError, match="tiles: expected a multiple of a positive step_m, got TileSettings"):
        TileSettings(*sizes)
    with pytest.raises(SkyfixError, match="tiles: expected"):
        TileSettings(road_within_m=math.nan)


@pytest.mark.parametrize("step_m", [1e-300, 1e-12])
def test_places_nearer_than_the_votes_cells_are_refused(matcher: RotMatch, step_m: float) -> None:
    with pytest.raises(SkyfixError, match="tiles: expected a step_m of a multiple of 2 m"):
        Retriever(matcher, embedding_of(matcher)).build(town(), TileSettings(step_m, step_m))


@pytest.mark.parametrize("ground_z", [math.nan, math.inf, -math.inf])
def test_a_ground_that_is_nowhere_is_refused(matcher: RotMatch, index: PlaceIndex, ground_z: float) -> None:
    message = f"ground_z: expected a finite height in metres, got {ground_z}"
    with pytest.raises(SkyfixError, match=message):
        Retriever(matcher, embedding_of(matcher)).query(index, made_points(), ground_z)
    search = SearchRegion(np.array([0.0, 60.0, 0.0]), 10.0)
    for one in (matcher, GeometricMatcher()):
        with pytest.raises(SkyfixError, match=message):
            one.match(made_points(), ground_z, town(), search)


def test_an_embedding_is_known_by_all_that_it_is_made_of(matcher: RotMatch, tmp_path: Path) -> None:
    mine = embedding_of(matcher)
    mine.save(tmp_path / "mine.safetensors")
    assert PlaceEmbedding.load(tmp_path / "mine.safetensors").fingerprint == mine.fingerprint
    others = [
        replace(mine, scan_weights=2.0 * mine.scan_weights),
        replace(mine, map_weights=2.0 * mine.map_weights),
        replace(mine, scan_mean=mine.scan_mean + 1.0),
        replace(mine, map_mean=mine.map_mean + 1.0),
        replace(mine, network="another"),
    ]
    assert len({mine.fingerprint, *(other.fingerprint for other in others)}) == 6
