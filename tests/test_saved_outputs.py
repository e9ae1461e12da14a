"""Saved outputs: a peak comes out at the pose it was planted at, whatever the axes, rows and headings mean."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from learned.saved_outputs import (
    ORIENTERNET,
    SavedConvention,
    load_field,
    load_volume,
    maps_from_field,
    volume_from_array,
)

GRID = MapGrid(12, 18, 0.5, -4.0, 7.0)
BINS = 36
QUADRANTS = [math.radians(degrees) for degrees in (30.0, 130.0, -150.0, -40.0)]
CONVENTIONS = [
    SavedConvention("".join(axes), rows, zero, turns, first, values)
    for axes, (rows, zero, turns, first, values) in itertools.product(
        itertools.permutations("HWK"),
        [
            ("down", "east", "counter_clockwise", 0.0, "log"),
            ("down", "north", "clockwise", 0.0, "log"),
            ("up", "south", "clockwise", -math.pi, "probability"),
            ("up", "west", "counter_clockwise", 0.3, "probability"),
        ],
    )
]


def heading_of(yaw: float, convention: SavedConvention) -> float:
    """A yaw in the convention's own terms, from its words: where zero points and which way it grows."""
    zero = {"east": 0.0, "north": math.pi / 2, "west": math.pi, "south": -math.pi / 2}[convention.heading_zero]
    return (yaw - zero) if convention.heading_turns == "counter_clockwise" else (zero - yaw)


def arranged(array: np.ndarray, convention: SavedConvention) -> np.ndarray:
    """(rows from the north, cols, K) as the convention stores it."""
    stored = array if convention.rows == "down" else array[::-1]
    return np.ascontiguousarray(stored.transpose(["HWK".index(axis) for axis in convention.axes]))


def planted(pose: np.ndarray, convention: SavedConvention) -> np.ndarray:
    """A bump about a pose as a program of that convention would save it."""
    x, y = GRID.centres()
    heading = convention.first_heading_rad + np.arange(BINS) * 2 * np.pi / BINS
    turn = np.cos(heading - heading_of(pose[2], convention))
    square = (x[None, :, None] - pose[0]) ** 2 + (y[:, None, None] - pose[1]) ** 2
    log_values = 30.0 * (turn - 1) - square
    return arranged(np.exp(log_values) if convention.values == "probability" else log_values, convention)


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_a_volume_peaks_where_it_was_planted(convention: SavedConvention) -> None:
    for yaw, (x, y) in zip(QUADRANTS, [(-2.3, 8.1), (3.9, 8.2), (-1.2, 11.9), (4.1, 12.2)], strict=True):
        volume = volume_from_array(planted(np.array([x, y, yaw]), convention), GRID, convention)
        row, col, yaw_bin = np.unravel_index(int(volume.log_prob.argmax()), volume.log_prob.shape)
        xs, ys = volume.grid.centres()
        assert abs(xs[col] - x) <= 0.25 + 1e-9
        assert abs(ys[row] - y) <= 0.25 + 1e-9
        assert abs(se2.wrap(yaw_bin * 2 * np.pi / BINS - yaw)) <= np.pi / BINS + 1e-6
        assert np.exp(volume.log_prob, dtype=np.float64).sum() * volume.cell_volume == pytest.approx(1.0, rel=1e-4)


@given(yaw=st.floats(-math.pi, math.pi), index=st.integers(0, len(CONVENTIONS) - 1))
def test_headings_that_fall_between_bins_keep_their_mean(yaw: float, index: int) -> None:
    convention = CONVENTIONS[index]
    volume = volume_from_array(planted(np.array([0.25, 10.25, yaw]), convention), GRID, convention)
    mass = np.exp(volume.log_prob, dtype=np.float64).sum(axis=(0, 1))
    mean = se2.circular_mean(np.arange(BINS) * 2 * np.pi / BINS, mass)
    assert abs(se2.wrap(mean - yaw)) < math.radians(0.5)


def test_orienternet_says_heading_from_north_clockwise() -> None:
    """Row 2, column 5, bin 9 of 36: 90 degrees clockwise from north, which is east."""
    log_values = np.full((12, 18, 36), -20.0)
    log_values[2, 5, 9] = 0.0
    volume = volume_from_array(log_values, GRID, ORIENTERNET)
    assert np.unravel_index(int(volume.log_prob.argmax()), volume.log_prob.shape) == (2, 5, 0)
    pose = volume.modes(1).means[0]
    np.testing.assert_allclose(pose[:2], GRID.xy_from_pixel((2.5, 5.5)), atol=1e-3)


@pytest.mark.parametrize("convention", CONVENTIONS[:8] + CONVENTIONS[-8:], ids=str)
def test_a_field_of_headings_peaks_where_it_was_planted(convention: SavedConvention) -> None:
    x, y = GRID.centres()
    for yaw, (px, py) in zip(QUADRANTS, [(-2.3, 8.1), (3.9, 8.2), (-1.2, 11.9), (4.1, 12.2)], strict=True):
        square = (x[None, :] - px) ** 2 + (y[:, None] - py) ** 2
        # A bin's own offset plays no part: a field says the angle itself.
        angle = heading_of(yaw, convention)
        field = np.broadcast_to([3 * math.cos(angle), 3 * math.sin(angle)], (12, 18, 2))
        location = np.exp(-square) if convention.values == "probability" else -square
        plan = location if convention.rows == "down" else location[::-1]
        flat = plan if convention.axes.replace("K", "") == "HW" else plan.T
        maps = maps_from_field(flat, arranged(field, convention), GRID, convention, 5.0, 72)
        pose = maps.modes(1).means[0]
        assert np.hypot(*(pose[:2] - (px, py))) < 0.3
        assert abs(se2.wrap(pose[2] - yaw)) < math.radians(2.5)
        volume = maps.to_volume()
        assert np.exp(volume.log_prob, dtype=np.float64).sum() * volume.cell_volume == pytest.approx(1.0, rel=1e-3)


def test_a_field_without_direction_says_nothing_of_heading() -> None:
    field = np.zeros((12, 18, 2))
    maps = maps_from_field(np.zeros((12, 18)), field, GRID, SavedConvention(), 5.0, 24)
    np.testing.assert_allclose(maps.orientation, -math.log(2 * math.pi), atol=1e-5)


def test_the_spread_of_a_field_is_the_one_asked_for() -> None:
    field = np.broadcast_to([1.0, 0.0], (12, 18, 2))
    maps = maps_from_field(np.zeros((12, 18)), field, GRID, SavedConvention(), 10.0, 360)
    yaw = np.arange(360) * 2 * np.pi / 360
    mass = np.exp(maps.orientation[:, 4, 4].astype(np.float64)) * 2 * np.pi / 360
    assert math.degrees(math.sqrt((mass * se2.wrap(yaw) ** 2).sum())) == pytest.approx(10.0, rel=0.05)


def test_masked_cells_are_not_evaluated() -> None:
    log_values = np.zeros((12, 18, 36))
    log_values[:, :9] = -np.inf
    volume = volume_from_array(log_values, GRID, ORIENTERNET)
    assert (volume.log_prob[:, :9] == volume.floor).all()
    assert volume.log_prob[:, 9:].min() == pytest.approx(-math.log(12 * 9 * 0.25 * 2 * math.pi), rel=1e-5)


def test_files_round_trip(tmp_path: Path) -> None:
    pose = np.array([1.1, 9.3, -2.0])
    array = planted(pose, ORIENTERNET).astype(np.float32)
    expected = volume_from_array(array, GRID, ORIENTERNET)
    np.save(tmp_path / "one.npy", array[None])
    np.savez(tmp_path / "one.npz", log_probs=array)
    np.savez_compressed(tmp_path / "many.npz", log_probs=array, other=np.zeros(3))
    for name, key in (("one.npy", None), ("one.npz", None), ("one.npz", "log_probs"), ("many.npz", "log_probs")):
        volume = load_volume(tmp_path / name, GRID, ORIENTERNET, key)
        np.testing.assert_array_equal(volume.log_prob, expected.log_prob)
    np.savez(tmp_path / "field.npz", location=np.zeros((12, 18)), heading=np.ones((2, 12, 18)))
    maps = load_field(tmp_path / "field.npz", GRID, SavedConvention("KHW"), 5.0)
    assert abs(maps.modes(1).means[0][2] - math.pi / 4) < 0.05


class Payload:
    """An object that a pickle would run code for."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (print, ("unpickled",))


def test_pickled_arrays_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "evil.npy", np.array([Payload()], dtype=object), allow_pickle=True)
    with pytest.raises(SkyfixError, match=r"evil\.npy: expected a readable"):
        load_volume(tmp_path / "evil.npy", GRID, ORIENTERNET)
    assert capsys.readouterr().out == ""


GOOD = np.zeros((12, 18, 36))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((18, 12, 36)), r"expected \(12, 18, K\), got \(18, 12, 36\)"),
        (np.zeros((12, 18)), r"expected \(12, 18, K\) numbers, got \(12, 18\)"),
        (np.full((12, 18, 36), "a"), r"expected \(12, 18, K\) numbers"),
        (np.full((12, 18, 36), np.nan), "expected no NaN"),
        (np.full((12, 18, 36), np.inf), r"no \+inf"),
        (np.full((12, 18, 36), -np.inf), "expected a cell with a probability above zero"),
        (np.zeros((12, 18, 0)), r"expected \(12, 18, K\), got \(12, 18, 0\)"),
    ],
)
def test_bad_volumes_give_one_line(array: np.ndarray, message: str) -> None:
    with pytest.raises(SkyfixError, match=message) as caught:
        volume_from_array(array, GRID, ORIENTERNET)
    assert "\n" not in str(caught.value)


def test_bad_probabilities_fields_and_conventions_give_one_line() -> None:
    plain = SavedConvention()
    field = np.ones((12, 18, 2))
    probability = SavedConvention(values="probability")
    cases = [
        (lambda: volume_from_array(GOOD - 1, GRID, probability), "at least 0"),
        (lambda: volume_from_array(GOOD, GRID, probability), "above zero"),
        (lambda: maps_from_field(np.zeros((18, 12)), field, GRID, plain, 5.0), "expected"),
        (lambda: maps_from_field(np.zeros(12), field, GRID, plain, 5.0), "saved location"),
        (lambda: maps_from_field(np.zeros((12, 18)), field[..., :1], GRID, plain, 5.0), r"\(cos, sin\)"),
        (lambda: maps_from_field(np.zeros((12, 18)), field * np.nan, GRID, plain, 5.0), "finite"),
        (lambda: maps_from_field(np.full((12, 18), -np.inf), field, GRID, plain, 5.0), "above zero"),
        (lambda: maps_from_field(np.zeros((12, 18)), field, GRID, plain, 0.0), "heading spread"),
        (lambda: SavedConvention("HHK"), "axes H, W and K"),
        (lambda: SavedConvention(heading_zero="up"), "one of east, north, west, south"),
        (lambda: SavedConvention(first_heading_rad=math.nan), "finite first heading"),
    ]
    for build, message in cases:
        with pytest.raises(SkyfixError, match=message) as caught:
            build()
        assert "\n" not in str(caught.value)


def test_bad_files_give_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.npy").write_text("not an array")
    np.savez(tmp_path / "two.npz", a=GOOD, b=GOOD)
    np.save(tmp_path / "single.npy", GOOD)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "two.npz").read_bytes()[:200])
    cases = [("missing.npy", None), ("text.npy", None), ("two.npz", None), ("two.npz", "c"), ("single.npy", "a")]
    for name, key in [*cases, ("cut.npz", "a")]:
        with pytest.raises(SkyfixError, match=name) as caught:
            load_volume(tmp_path / name, GRID, ORIENTERNET, key)
        assert "\n" not in str(caught.value)
