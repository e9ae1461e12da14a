"""Retrieval: harmonics turn with the scan, an index finds its own places, files come back."""

import math
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
import torch
from made_town import RINGS, TOWN, embedding_of, made_points, small_rotmatch, town
from torch import Tensor

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.particle_filter import ParticleFilter
from learned.bev import bev_counts, log_density
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.network import picture_tensor
from learned.place_embedding import PlaceEmbedding, order_factors, similarities
from learned.place_index import HEADINGS, PlaceIndex, Retrieved
from learned.place_vote import best_votes, vote_at
from learned.retrieval import Retriever, map_features
from learned.ring_harmonics import at_headings
from learned.rotmatch import RotMatch
from learned.voting import vote
from sequences.lidar import LidarModel, simulate_scan
from sequences.world import world_from_raster


@pytest.fixture(scope="module")
def matcher() -> RotMatch:
    return small_rotmatch()


@pytest.fixture(scope="module")
def index(matcher: RotMatch) -> PlaceIndex:
    return Retriever(matcher, embedding_of(matcher)).build(town())


def test_a_quarter_turn_of_the_image_turns_the_harmonics() -> None:
    """Order m times exp(-i m a), exactly: a quarter turn moves cells to cells."""
    image = torch.randn(1, 2, RINGS.size, RINGS.size, generator=torch.Generator().manual_seed(0))
    basis = RINGS.basis()
    plain, turned = RINGS.of(image, basis), RINGS.of(torch.rot90(image, 1, dims=(2, 3)), basis)
    phase = torch.exp(-0.5j * math.pi * torch.arange(RINGS.orders + 1))
    torch.testing.assert_close(turned, plain * phase, atol=2e-3, rtol=1e-3)


def test_scores_peak_at_the_heading() -> None:
    """The map's image is the scan's, turned to its heading: counter-clockwise."""
    image = torch.randn(1, 3, RINGS.size, RINGS.size, generator=torch.Generator().manual_seed(3))
    basis = RINGS.basis()
    scan, place = RINGS.of(image, basis)[0], RINGS.of(torch.rot90(image, 1, dims=(2, 3)), basis)[0]
    products = (scan.conj() * place).sum(0) * order_factors(RINGS.orders + 1)
    assert int(at_headings(products, 72).argmax()) == 18  # 90 degrees


def looked_up(index: PlaceIndex, place: int, turn: int, k: int, shortlist: int = 40) -> Retrieved:
    """A scan that saw just what the map shows at a place, the vehicle turned by `turn` quarters, looked up."""
    orders = torch.arange(RINGS.orders + 1)
    embedding = index.embeddings[place] * torch.exp(0.5j * math.pi * turn * orders)[:, None]
    # Turning the vehicle to the left turns what it sees to the right.
    scan = torch.rot90(seen_at(index, place), -turn, dims=(1, 2)).contiguous()
    return index.query(embedding, scan, k, shortlist)


def seen_at(index: PlaceIndex, place: int, right: int = 0, down: int = 0) -> Tensor:
    """The map's features within 20 m of a place's middle, or of so many cells beside it."""
    per_cell = round(index.grid.metres_per_pixel / index.feature_m)
    row, col = index.cells[place] * per_cell + per_cell // 2 + [down, right]
    padded = torch.nn.functional.pad(index.features.float() / 127.0, (20, 20, 20, 20))
    return padded[:, row : row + 40, col : col + 40].contiguous()


def test_a_place_is_found_by_what_it_looks_like_whatever_the_heading(index: PlaceIndex) -> None:
    """A scan that saw just what the map shows there gets its tile first, and its place and heading right."""
    rng = np.random.default_rng(2)
    for number, place in enumerate(rng.choice(len(index.cells), 12, replace=False)):
        found = looked_up(index, int(place), number % 4, 3)
        xy = index.grid.xy_from_pixel(index.cells[place] + 0.5)
        assert np.abs(found.centres[0] - xy).max() <= 32.0
        np.testing.assert_allclose(found.poses[0, :2], xy)
        assert math.cos(found.poses[0, 2] - number % 4 * math.pi / 2) > 1 - 1e-6
        assert (np.diff(found.scores) <= 0).all()
        assert len({tuple(centre) for centre in found.centres.tolist()}) == 3


def test_the_search_is_exact(index: PlaceIndex) -> None:
    """Cosines are those of each place turned by hand; voting on every place gives the same as voting on the best."""
    orders = torch.arange(RINGS.orders + 1)
    scan, factors = index.embeddings[7], order_factors(RINGS.orders + 1)
    found = index.similarities(scan)
    for place, bin_ in ((0, 0), (7, 0), (30, 11), (31, 60)):
        turned = scan * torch.exp(-1j * orders * (bin_ * 2 * math.pi / HEADINGS))[:, None]
        by_hand = float(((turned.conj() * index.embeddings[place]).sum(1).real * factors).sum())
        assert found[place, bin_] == pytest.approx(by_hand, abs=1e-5)
    few, all_of_them = (looked_up(index, 7, 1, 1, shortlist) for shortlist in (5, len(index.cells)))
    np.testing.assert_array_equal(few.poses[0], all_of_them.poses[0])
    assert few.scores[0] == pytest.approx(all_of_them.scores[0], rel=1e-5)


def test_a_pose_is_found_to_the_features_cell(index: PlaceIndex) -> None:
    """The vehicle stands beside the middle of a place: the pose is its own, not the place's."""
    rng = np.random.default_rng(3)
    for place in rng.choice(len(index.cells), 6, replace=False):
        right, down = rng.integers(-3, 4, 2)
        found = index.query(index.embeddings[place], seen_at(index, int(place), int(right), int(down)), 1)
        middle = index.grid.xy_from_pixel(index.cells[place] + 0.5)
        np.testing.assert_allclose(found.poses[0], [*(middle + [right, -down]), 0.0], atol=1e-6)


def test_places_are_weighed_in_three_rounds(index: PlaceIndex, monkeypatch: pytest.MonkeyPatch) -> None:
    """By 20 times the cosine and the coarse vote: less its mean over headings, and as it is for the closest few; the
    best place of each tile by the vote on the features' own cells."""
    monkeypatch.setattr("learned.place_index._CLOSELY", 20)
    index = replace(index, temperature=2.0)
    scan = seen_at(index, 7)
    found = index.query(index.embeddings[7], scan, 1).place_scores
    alike = 20.0 * index.similarities(index.embeddings[7]).max(axis=1, keepdims=True)
    per_cell = round(index.grid.metres_per_pixel / index.feature_m)
    summed = scan.unfold(1, 2, 2).unfold(2, 2, 2).sum(dim=(3, 4))
    finer = vote_at(index.coarse, summed, index.cells * per_cell // 2, per_cell // 2, 3 * HEADINGS) / index.temperature
    votes = finer[:, ::3]
    weighed = votes - votes.mean(axis=1, keepdims=True) + alike
    closest, others = np.split(np.argsort(-weighed.max(axis=1), kind="stable"), [20])
    assert len(others) > 10
    closely = np.maximum(np.maximum(finer[:, ::3], finer[:, 1::3]), np.roll(finer[:, 2::3], 1, axis=1)) + alike
    two = weighed + (closely[closest].max(axis=1).min() - weighed[others].max())
    two[closest] = closely[closest]
    leads = np.zeros(len(two), np.bool_)
    for tile in np.unique(index.cells // index.tile_cells, axis=0):
        within = np.flatnonzero((index.cells // index.tile_cells == tile).all(axis=1))
        leads[within[np.argmax(two[within].max(axis=1))]] = True
    assert leads.sum() == index.tiles < 80
    lifted = (found - two)[~leads]
    np.testing.assert_allclose(lifted, lifted[0, 0], rtol=1e-3, atol=2e-3)
    for place in np.flatnonzero(leads):
        yaws = torch.tensor(np.radians(np.arange(-3.0, 4.0)) + two[place].argmax() * (2 * math.pi / HEADINGS))
        corner = index.cells[place] * per_cell
        map_features = torch.nn.functional.pad(index.features.float() / 127.0, (20, 28, 20, 28))
        square = map_features[:, corner[0] : corner[0] + 47, corner[1] : corner[1] + 47]
        sharp = float(vote(square, scan, yaws).max()) / index.temperature
        assert found[place].max() == pytest.approx(sharp, rel=1e-3, abs=1e-3)
    assert found[~leads].max() == pytest.approx(found[leads].max(axis=1).min(), rel=1e-4)


def test_votes_at_places_are_those_of_the_whole_map() -> None:
    generator = torch.Generator().manual_seed(8)
    features, scan = (torch.randn(3, *size, generator=generator) for size in ((40, 44), (12, 12)))
    yaws = torch.arange(24, dtype=torch.float64) * (2 * math.pi / 24)
    everywhere = vote(features, scan, yaws).numpy()  # position (r, c) is the corner (r + 6, c + 6) of the map
    corners = np.array([[6, 6], [10, 20], [25, 29]])
    found = vote_at(features, scan, corners, 4, 24)
    for (row, col), votes in zip(corners - 6, found, strict=True):
        best = everywhere[:, row : row + 4, col : col + 4].max(axis=(1, 2))
        np.testing.assert_allclose(votes, best, rtol=1e-4, atol=1e-3)
    own = (yaws[[3, 9, 20]][:, None] + torch.tensor([-0.02, 0.0, 0.05])).numpy()
    best = best_votes(features, scan, corners, 4, own)
    for number, (row, col) in enumerate(corners - 6):
        votes = vote(features, scan, torch.from_numpy(own[number])).numpy()[:, row : row + 4, col : col + 4]
        heading, down, right = np.unravel_index(votes.argmax(), votes.shape)
        assert best.votes[number] == pytest.approx(votes.max(), rel=1e-4)
        assert (*(best.corners[number] - corners[number]), best.headings[number]) == (down, right, heading)
    with pytest.raises(SkyfixError, match=r"scan features: expected \(3, n, n\), n even, got \(2, 12, 12\)"):
        vote_at(features, scan[:2], corners, 4, 24)


def test_an_embedding_is_as_like_itself_at_every_heading() -> None:
    generator = torch.Generator().manual_seed(5)
    scan = torch.randn(RINGS.orders + 1, 5, generator=generator, dtype=torch.complex64)
    phase = torch.exp(1j * torch.arange(RINGS.orders + 1) * (2 * math.pi * 7 / 72))[:, None]
    plain, turned = (similarities(each, scan[None], 72)[0] for each in (scan, scan * phase))
    torch.testing.assert_close(torch.roll(plain, 7), turned, atol=1e-3, rtol=1e-4)


def test_places_are_near_roads_and_not_in_houses(index: PlaceIndex) -> None:
    raster = town()
    row, col = raster.grid.pixel_from_xy(index.grid.xy_from_pixel(index.cells + 0.5)).astype(int).T
    assert raster.classes is not None
    assert not (raster.classes[row, col] == CLASS_INDEX["building"]).any()
    near_cross = np.minimum(np.abs(row - 198), np.abs(col - 238)) * 0.5
    assert near_cross.max() <= 4.0 + 4.5  # half a road's width, and what counts as near


def test_map_features_are_those_of_windows(matcher: RotMatch) -> None:
    """The first window is what the network gives for the crop about it, cut to its middle."""
    with torch.inference_mode():
        features, grid = map_features(matcher.net, town())
        crop = town().crop(MapGrid(624, 624, 0.5, TOWN.x0 - 28.0, TOWN.y0 + TOWN.height_m + 28.0 - 312.0))
        alone = matcher.net.map_features(picture_tensor(crop.picture)[None])[0]
    assert (grid.x0, grid.y0 + grid.height_m) == (TOWN.x0, TOWN.y0 + TOWN.height_m)
    assert grid.metres_per_pixel == 1.0
    torch.testing.assert_close(features, alone[:, 28:284, 28:284])


def test_an_index_comes_back_and_answers_alike(index: PlaceIndex, tmp_path: Path) -> None:
    index.save(tmp_path / "town.npz")
    back = PlaceIndex.load(tmp_path / "town.npz")
    assert (back.grid, back.tile_cells, back.fingerprint) == (index.grid, index.tile_cells, index.fingerprint)
    np.testing.assert_array_equal(back.cells, index.cells)
    assert (back.feature_m, back.temperature) == (index.feature_m, index.temperature)
    torch.testing.assert_close(back.features, index.features, rtol=0, atol=0)
    answers = looked_up(back, 3, 2, 4), looked_up(index, 3, 2, 4)
    np.testing.assert_allclose(answers[0].poses[0], answers[1].poses[0])


def test_an_index_that_cannot_be_written_leaves_the_one_before(
    index: PlaceIndex, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "town.npz"
    index.save(path)
    before = path.read_bytes()

    def full(file: BinaryIO, **arrays: object) -> None:
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(SkyfixError, match=r"town.npz: cannot be written: No space left on device"):
        index.save(path)
    assert path.read_bytes() == before


def test_an_embedding_comes_back(matcher: RotMatch, tmp_path: Path) -> None:
    one = embedding_of(matcher)
    one.save(tmp_path / "places.safetensors")
    back = PlaceEmbedding.load(tmp_path / "places.safetensors")
    assert (back.network, back.harmonics) == (one.network, one.harmonics)
    torch.testing.assert_close(back.scan_weights, one.scan_weights, atol=2e-3, rtol=2e-3)


def test_scans_are_looked_up_and_the_same_twice(matcher: RotMatch, index: PlaceIndex) -> None:
    retriever = Retriever(matcher, embedding_of(matcher))
    first, again = (retriever.query(index, made_points(), -1.7, 5) for _ in range(2))
    np.testing.assert_array_equal(first.poses, again.poses)
    np.testing.assert_array_equal(first.scores, again.scores)
    counts = torch.from_numpy(log_density(bev_counts(made_points(), -1.7, matcher.net.settings.bev)))[None].float()
    with torch.inference_mode():
        seen = matcher.net.scan_features(counts)[0]
        scan = embedding_of(matcher).of_scans(RINGS.of(torch.nn.functional.avg_pool2d(seen[None], 2), RINGS.basis()))[0]
    np.testing.assert_allclose(first.scores, index.query(scan, seen, 5).scores, rtol=1e-4)


def test_a_filter_starts_from_an_answer(index: PlaceIndex) -> None:
    """The answer is a density over the map's places that integrates to 1; the seed decides on what is drawn."""
    found = looked_up(index, 20, 1, 5)
    likelihood = index.likelihood(found)
    step = 2 * math.pi / HEADINGS
    row, col, turn = np.meshgrid(*(np.arange(n) for n in (index.grid.rows, index.grid.cols, HEADINGS)), indexing="ij")
    xy = index.grid.xy_from_pixel(np.stack([row, col], axis=-1).reshape(-1, 2) + 0.5)
    density = np.exp(likelihood.draw_log_density(np.column_stack([xy, turn.reshape(-1) * step])))
    assert density.sum() * index.grid.metres_per_pixel**2 * step == pytest.approx(1.0, abs=1e-3)
    particles = likelihood.sample(2000, np.random.default_rng(0))
    np.testing.assert_array_equal(particles, likelihood.sample(2000, np.random.default_rng(0)))
    cells = {tuple(cell) for cell in index.cells.tolist()}
    drawn = np.floor(index.grid.pixel_from_xy(particles[:, :2]) - 1e-9).astype(int)
    assert np.mean([tuple(cell) in cells for cell in drawn.tolist()]) > 0.999
    best = np.abs(particles[:, :2] - found.poses[0, :2]).max(axis=1) <= 4.0  # the best place's own cell
    assert best.mean() > 5.0 / len(cells)
    assert len(ParticleFilter(particles, 0).particles) == 2000


def test_the_shipped_embedding_finds_tiles_of_a_simulated_town() -> None:
    """8 scans of a town that nobody trained on, 25 tiles at least: 5 of 8 among the first 3 by chance has 0.1 %."""
    grid = MapGrid(720, 720, 0.5, 0.0, 0.0)
    rng = np.random.default_rng(5)
    classes = np.full((720, 720), CLASS_INDEX["grass"], np.uint8)
    for _ in range(160):
        row, col = rng.integers(0, 700, 2)
        classes[row : row + rng.integers(16, 50), col : col + rng.integers(16, 50)] = CLASS_INDEX["building"]
    streets = rng.permutation(np.arange(60, 700, 130)) + rng.integers(-30, 30, 5)
    for street in streets:
        classes[street - 7 : street + 7] = CLASS_INDEX["road"]
        classes[:, street - 17 : street - 3] = CLASS_INDEX["road"]
    raster = MapRaster.from_classes(grid, classes)
    world, model = world_from_raster(raster, 3), LidarModel(azimuths=600)
    retriever = Retriever(RotMatch.shipped())
    index = retriever.build(raster)
    assert 25 <= index.tiles <= 36
    right = 0
    for number in range(8):
        along, street = rng.uniform(80.0, 280.0), 360.0 - streets[number % 5] * 0.5
        pose = np.array([along, street - 1.5, 0.0 if number % 2 else math.pi])
        points = simulate_scan(world, pose, model, np.random.default_rng(number))
        found = retriever.query(index, points, -model.mount_height_m, 3, shortlist=64)
        right += bool((np.abs(found.centres - pose[:2]) <= 32.0).all(axis=1).any())
    assert right >= 5
