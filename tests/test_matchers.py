"""The matchers on scans simulated where the truth is known, and RotMatch's checkpoints."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import LikelihoodVolume
from learned.bev import BevSettings, bev_counts
from learned.calibration import fit_temperature, match_samples, mean_nll
from learned.geometric import GeometricMatcher
from learned.map_raster import CLASS_INDEX, MapRaster
from learned.matcher import SearchRegion, error_correlation_length_m, load_matcher, matching_window
from learned.rotmatch import Calibration, RotMatch, RotMatchNet, RotMatchSettings
from learned.samples import Sample

SMALL = RotMatchSettings(4, (4, 4, 8, 8))


def street_of_walls(pose: np.ndarray) -> tuple[MapRaster, np.ndarray]:
    """Houses of different sizes along a street, and an exact scan of their facades and of the ground from a pose."""
    grid = MapGrid(400, 400, 0.5, -100.0, -100.0)
    classes = np.zeros((400, 400), np.uint8)
    classes[198:202] = CLASS_INDEX["road"]
    outlines = []
    for x0, x1, y0, y1 in [(-60, -41, 8, 20), (-30, -22, 10, 24), (-8, 9, 7, 15), (18, 40, 9, 30), (52, 60, 8, 20)]:
        for low, high in ((y0, y1), (-y1 - 2, -y0 - 2)):
            row, col = grid.pixel_from_xy(np.array([[x0, high], [x1, low]])).astype(int).T
            classes[row[0] : row[1], col[0] : col[1]] = CLASS_INDEX["building"]
            along, across = np.arange(x0, x1, 0.2), np.arange(low, high, 0.2)
            outlines += [np.stack([along, np.full_like(along, y)], 1) for y in (low, high)]
            outlines += [np.stack([np.full_like(across, x), across], 1) for x in (x0, x1)]
    facade = np.concatenate(outlines)
    heights = np.linspace(-1.7, 2.0, 12)
    walls = np.column_stack([np.repeat(facade, len(heights), axis=0), np.tile(heights, len(facade))])
    x, y = np.meshgrid(np.arange(-70, 70, 0.4), np.arange(-6, 6, 0.4))
    street = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.7)])
    points = np.concatenate([walls, street])
    body = se2.transform_points(se2.inverse(pose), points[:, :2])
    scan = np.column_stack([body, points[:, 2], np.zeros(len(points))]).astype(np.float32)
    return MapRaster.from_classes(grid, classes), scan


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 130.0, -95.0])
def test_geometric_matcher_finds_the_pose(yaw_deg: float) -> None:
    pose = np.array([3.3, -1.2, math.radians(yaw_deg)])
    city, scan = street_of_walls(pose)
    search = SearchRegion(pose + [11.0, -8.0, 0.1], 15.0, math.radians(10))
    volume = GeometricMatcher().match(scan, -1.7, city, search)
    found = volume.modes(1).means[0]
    assert np.hypot(*(found - pose)[:2]) < 0.5
    assert abs(se2.wrap(found[2] - pose[2])) < math.radians(1.0)
    assert volume.log_density(pose[None])[0] > -math.log(30.0**2 * math.radians(20)) + 2.0


def test_geometric_matcher_needs_classes() -> None:
    city, scan = street_of_walls(np.zeros(3))
    photo = MapRaster(city.grid, None, city.picture)
    with pytest.raises(SkyfixError, match="expected a map with classes"):
        GeometricMatcher().match(scan, -1.7, photo, SearchRegion(np.zeros(3), 10.0))


@pytest.mark.parametrize("matcher", [GeometricMatcher(), RotMatch(RotMatchNet(SMALL))], ids=["geometric", "rotmatch"])
def test_volume_covers_the_search_and_no_other_headings(matcher: GeometricMatcher | RotMatch) -> None:
    city, scan = street_of_walls(np.zeros(3))
    search = SearchRegion(np.array([20.3, 10.7, 3.1]), 12.0, math.radians(8))
    volume = matcher.match(scan, -1.7, city, search)
    corners = search.centre[:2] + 12.0 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    assert volume.grid.contains(corners).all()
    assert volume.grid.width_m < 2 * 12.0 + 18.0
    bins = np.flatnonzero(volume.bin_peaks > volume.floor) * 2 * math.pi / volume.log_prob.shape[2]
    assert len(bins) == pytest.approx(16, abs=1)
    assert np.abs(se2.wrap(bins - 3.1)).max() < math.radians(8.01)


def test_window_is_snapped_to_the_maps_pixels() -> None:
    city, _ = street_of_walls(np.zeros(3))
    window = matching_window(city, SearchRegion(np.array([1.23, -4.56, 0.0]), 10.0), 40.0, 0.5, multiple_of=16)
    assert window.rows % 16 == 0
    city.grid.offset_of(window)
    assert np.abs(window.centre_xy - [1.23, -4.56]).max() <= 0.25 + 1e-9


def test_temperature_of_a_known_miscalibration_is_found() -> None:
    """Truths drawn from a density are calibrated at 1; of the same density sharpened by 3 they ask for 3 back."""
    grid = MapGrid(40, 40, 0.5, 0.0, 0.0)
    x, y = grid.centres()
    yaw = np.arange(36) * 2 * np.pi / 36
    squared = (x[None, :, None] - 9) ** 2 + (y[:, None, None] - 11) ** 2
    volume = LikelihoodVolume.from_scores(-squared / 18.0 + 2.0 * np.cos(yaw), grid)
    truths = volume.sample(200, np.random.default_rng(0))
    sharp = [volume.tempered(1 / 3)] * len(truths)
    assert fit_temperature(sharp, truths, outliers=0.0) == pytest.approx(3.0, rel=0.15)
    assert mean_nll(sharp, truths, 3.0) < mean_nll(sharp, truths, 1.0)
    with pytest.raises(SkyfixError, match="got 0 and 0"):
        fit_temperature([], np.zeros((0, 3)))


def test_samples_are_matched_in_their_own_frame() -> None:
    pose = np.array([0.0, 0.0, 0.4])
    city, scan = street_of_walls(pose)
    assert city.classes is not None
    counts = np.minimum(bev_counts(scan, -1.7, BevSettings()), 255).astype(np.uint8)
    row, col = city.grid.pixel_from_xy(pose[:2])
    sample = Sample(counts, city.classes, float(row), float(col), 0.4)
    volumes, truths = match_samples(GeometricMatcher(), [sample], 10.0, math.radians(10), seed=3)
    assert np.hypot(*(volumes[0].modes(1).means[0] - truths[0])[:2]) < 0.5


def test_checkpoint_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(4)
    matcher = RotMatch(RotMatchNet(SMALL), Calibration(1.7, 9.0, bare_map_correlation_length_m=33.0))
    matcher.save(tmp_path / "net.safetensors", {"seed": 4})
    again = load_matcher(str(tmp_path / "net.safetensors"))
    city, scan = street_of_walls(np.zeros(3))
    search = SearchRegion(np.zeros(3), 10.0, 0.1)
    first, second = (m.match(scan, -1.7, city, search) for m in (matcher, again))
    np.testing.assert_array_equal(first.log_prob, second.log_prob)
    assert again.error_correlation_length_m == 9.0
    roads = MapRaster.from_classes(city.grid, np.full_like(city.classes, CLASS_INDEX["road"]))
    photograph = MapRaster(city.grid, None, roads.picture)
    shown = {"houses": city, "roads alone": roads, "a photograph": photograph}
    lengths = {name: error_correlation_length_m(again, shown[name]) for name in shown}
    assert lengths == {"houses": 9.0, "roads alone": 33.0, "a photograph": 9.0}
    assert json.loads((tmp_path / "net.json").read_text())["seed"] == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda facts: facts.update(architecture="other-2"), "expected architecture rotmatch-1, got other-2"),
        (lambda facts: facts["settings"].update(channels=6), "weights do not fit"),
        (lambda facts: facts.pop("calibration"), "expected a readable checkpoint"),
        (lambda facts: facts["calibration"].update(confidence_slope="steep"), "expected a readable checkpoint"),
        (lambda facts: facts["settings"].update(channels=-8), r"checkpoint net\.safetensors: its settings make no"),
        (
            lambda facts: facts["settings"]["bev"].update(half_extent_m=0),
            r"half_extent_m of at least a pixel, got 0\.0 m",
        ),
    ],
)
def test_checkpoints_that_do_not_match_the_code_are_refused(tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "net.safetensors"
    RotMatch(RotMatchNet(SMALL)).save(path, {})
    facts = json.loads(path.with_suffix(".json").read_text())
    change(facts)
    path.with_suffix(".json").write_text(json.dumps(facts))
    with pytest.raises(SkyfixError, match=message) as caught:
        RotMatch.load(path)
    assert "\n" not in str(caught.value)


def test_an_architecture_that_is_no_name_is_told(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    RotMatch(RotMatchNet(SMALL)).save(path, {})
    facts = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps({**facts, "architecture": ["rotmatch-1"]}))
    with pytest.raises(SkyfixError, match=r"expected architecture .*rotmatch-1.*, got \['rotmatch-1'\]"):
        load_matcher(str(path))


def test_unknown_matchers_are_named() -> None:
    with pytest.raises(SkyfixError, match="got 'nonsense'"):
        load_matcher("nonsense")
    with pytest.raises(SkyfixError, match="no such file"):
        load_matcher("missing.safetensors")


def test_a_longer_reach_uses_the_same_weights_and_sees_farther() -> None:
    torch.manual_seed(4)
    near = RotMatchNet(SMALL)
    far = near.reaching(56.0)
    assert far.settings.bev.size == 224
    for (name, a), (other, b) in zip(near.state_dict().items(), far.state_dict().items(), strict=True):
        assert name == other
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    city, scan = street_of_walls(np.zeros(3))
    volume = RotMatch(far).match(scan, -1.7, city, SearchRegion(np.zeros(3), 10.0, 0.1))
    assert volume.grid.contains(np.array([9.9, -9.9]))
