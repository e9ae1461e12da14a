"""KITTI + aerial: listed starts, the turned crop, and landmarks on the photograph for every quadrant of heading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kitti_layout import DATE, DRIVE, FRAMES, LANDMARKS, VELO_FROM_IMU_YAW, frames, map_xy, write_raw
from made_drive import EmulatedMatcher
from PIL import Image

from fusion import se2
from fusion.errors import SkyfixError
from sequences.evaluate import evaluate_frames
from sequences.frame_set import covering_half_extent_m
from sequences.kitti import KittiDrive
from sequences.kitti_crossview import KittiCrossview, read_list
from sequences.satellite import METRES_PER_PIXEL
from sequences.sequence import ScanError

SIDE_PX = 900
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [0, 255, 255]], dtype=np.uint8)
SEEN_WITHIN_M = 40.0


def offsets() -> np.ndarray:
    """(FRAMES, 3) in [-1, 1], every combination of signs among them."""
    return np.random.default_rng(5).uniform(-1.0, 1.0, (FRAMES, 3)).round(6)


def write_crossview(root: Path) -> Path:
    """Write raw_data/, satmap/ and a list; a landmark is a square of 9 px in its own colour."""
    write_raw(root)
    folder = root / "satmap" / DATE / DRIVE
    folder.mkdir(parents=True)
    lines = []
    for index, frame in enumerate(frames()):
        picture = np.full((SIDE_PX, SIDE_PX, 3), 40, dtype=np.uint8)
        for landmark, colour in zip(LANDMARKS, COLOURS, strict=True):
            east, north = map_xy(landmark, (frame.lat, frame.lon)) / METRES_PER_PIXEL
            row, col = int(np.floor(SIDE_PX / 2 - north)), int(np.floor(SIDE_PX / 2 + east))
            picture[max(row - 4, 0) : row + 5, max(col - 4, 0) : col + 5] = colour
        Image.fromarray(picture).save(folder / f"{index:010d}.png")
        lines.append(f"{DATE}/{DRIVE}/{index:010d}.png " + " ".join(map(str, offsets()[index])))
    (root / "test1.txt").write_text("\n".join(lines) + "\n")
    return root / "test1.txt"


@pytest.fixture(scope="module")
def listed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A list that tests only read."""
    return write_crossview(tmp_path_factory.mktemp("KITTI"))


def test_scale_is_that_of_the_protocol() -> None:
    assert pytest.approx(0.1958, abs=5e-5) == METRES_PER_PIXEL


def test_landmarks_are_where_the_crop_shows_them(listed: Path) -> None:
    """The true pose brings each point of the scan to the pixel of that landmark's colour."""
    frame_set = KittiCrossview(listed)
    assert (frame_set.name, len(frame_set), frame_set.ground_z) == ("test1", FRAMES, -1.73)
    checked = 0
    for index in range(len(frame_set)):
        frame = frame_set.frame(index)
        assert frame.map.classes is None
        assert frame.map.picture.shape == (512, 512, 3)
        xy = se2.transform_points(frame.true_pose, frame_set.scan(index)[:, :2].astype(np.float64))
        for place, colour in zip(xy, COLOURS, strict=True):
            if np.abs(place).max() < SEEN_WITHIN_M:
                row, col = np.floor(frame.map.grid.pixel_from_xy(place)).astype(int)
                assert np.abs(frame.map.picture[row, col].astype(int) - colour).max() <= 2
                checked += 1
    assert checked > 2 * FRAMES


def test_the_truth_lies_where_the_list_says(listed: Path) -> None:
    """Seen from the start's box: 20 m ahead and to the left, 10 degrees counter-clockwise, to a few centimetres."""
    frame_set = KittiCrossview(listed)
    for index, (ahead, left, turn) in enumerate(offsets()):
        frame = frame_set.frame(index)
        vehicle = frame.true_pose + [0.0, 0.0, VELO_FROM_IMU_YAW]  # the axes of the inertial unit, not the Velodyne's
        error = se2.between(vehicle, frame.start + [0.0, 0.0, VELO_FROM_IMU_YAW])
        np.testing.assert_allclose(error[:2], [-20.0 * ahead, -20.0 * left], atol=0.1)
        assert np.degrees(error[2]) == pytest.approx(-10.0 * turn, abs=1e-9)
        assert np.abs(frame.true_pose[:2] - frame.start[:2]).max() <= covering_half_extent_m(20.0, 10.0)


def test_the_crop_is_the_published_one(listed: Path) -> None:
    """The protocol step by step (turn, move, move, turn, cut) with an image library."""
    frame_set = KittiCrossview(listed)
    compared = 0
    for index, (ahead, left, turn) in enumerate(offsets()):
        heading_deg = 90.0 - frames()[index].azimuth
        with Image.open(listed.parent / "satmap" / DATE / DRIVE / f"{index:010d}.png") as image:
            turned = image.rotate(-heading_deg, resample=Image.Resampling.BICUBIC)
        right_m, down_m = 1.08 - 20.0 * ahead, 0.26 + 20.0 * left
        move = (1, 0, right_m / METRES_PER_PIXEL, 0, 1, down_m / METRES_PER_PIXEL)
        moved = turned.transform(turned.size, Image.Transform.AFFINE, move, resample=Image.Resampling.BILINEAR)
        again = moved.rotate(10.0 * turn, resample=Image.Resampling.BICUBIC)
        begin = (SIDE_PX - 512) // 2
        published = np.asarray(again).astype(int)[begin : begin + 512, begin : begin + 512]
        ours = frame_set.frame(index).map.picture.astype(int)
        inside = published.sum(axis=-1) > 0  # its two turns each cut the corners off
        assert inside.mean() > 0.8
        assert np.abs(published - ours)[inside].mean() < 0.5
        for colour in COLOURS:
            spots = [np.argwhere(np.abs(picture - colour).max(axis=-1) < 60) for picture in (published, ours)]
            if min(map(len, spots)) > 60:  # not cut by the edge
                np.testing.assert_allclose(spots[1].mean(axis=0), spots[0].mean(axis=0), atol=0.6)
                compared += 1
    assert compared > FRAMES


def test_a_drive_has_all_its_images_as_one_map(listed: Path) -> None:
    """Landmarks of every scan are where the mosaic shows them; it covers what all the images do."""
    drive = KittiDrive(listed.parent / "raw_data" / DATE / DRIVE)
    assert drive.map.classes is None
    assert drive.ground_truth is not None
    assert drive.map.grid.width_m == pytest.approx(60.0 + SIDE_PX * METRES_PER_PIXEL, abs=3.0)
    for index, pose in enumerate(drive.ground_truth.poses):
        on_map = se2.transform_points(pose, drive.scan(index)[:, :2].astype(np.float64))
        rows, cols = np.floor(drive.map.grid.pixel_from_xy(on_map)).astype(int).T
        np.testing.assert_array_equal(drive.map.picture[rows, cols], COLOURS)


def test_images_that_are_missing_or_of_another_size(tmp_path: Path) -> None:
    write_crossview(tmp_path)
    drive, images = tmp_path / "raw_data" / DATE / DRIVE, tmp_path / "satmap" / DATE / DRIVE
    Image.new("RGB", (300, 300)).save(images / "0000000011.png")
    with pytest.raises(SkyfixError, match=r"satellite images: expected 900 x 900 px, got 300 x 300"):
        KittiDrive(drive)
    (images / "0000000011.png").unlink()
    with pytest.raises(SkyfixError, match=r"0000000011\.png: cannot be read: No such file"):
        KittiDrive(drive)


def test_evaluation_starts_where_the_list_says(listed: Path) -> None:
    frame_set = KittiCrossview(listed)
    matcher = EmulatedMatcher(np.array([frame_set.frame(index).true_pose for index in range(FRAMES)]))
    result = evaluate_frames(frame_set, {"emulated": matcher}, max_frames=100)
    assert (result["skipped_frames"], result["seed"], result["sequence"]) == (0, None, "test1")
    assert result["start"] == {"half_extent_m": 20.0, "half_heading_deg": 10.0}
    prior, matched = result["methods"]["prior"], result["methods"]["emulated"]
    expected = 20.0 * np.hypot(*offsets()[:, :2].T)
    assert prior["position_error_m"]["mean"] == pytest.approx(expected.mean(), abs=0.1)
    assert prior["heading_error_deg"]["mean"] == pytest.approx(10.0 * np.abs(offsets()[:, 2]).mean(), abs=1e-6)
    assert matched["position_error_m"]["max"] < 3.0
    assert all(search.half_extent_m == covering_half_extent_m(20.0, 10.0) for search in matcher.searches)
    assert evaluate_frames(frame_set, {}, max_frames=5)["methods"]["prior"]["frames"] == 5


def test_scans_that_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    path = write_crossview(tmp_path)
    scans = tmp_path / "raw_data" / DATE / DRIVE / "velodyne_points" / "data"
    (scans / "0000000002.bin").write_bytes(bytes(5))
    frame_set = KittiCrossview(path)
    with pytest.raises(ScanError, match=r"scan 0000000002\.bin: expected a multiple of 16 bytes"):
        frame_set.scan(2)
    result = evaluate_frames(frame_set, {})
    assert (result["skipped_frames"], result["methods"]["prior"]["frames"]) == (1, FRAMES - 1)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "expected lines DATE/DRIVE/FRAME.png sx sy theta, got none"),
        ("a/b/c.png 0 0", "line 1: sx sy theta: expected 3 numbers, got 2"),
        ("a/b/c.png 0 0 x", "line 1: sx sy theta: expected 3 numbers, could not convert"),
        ("a/b/c.png 0 0 nan", "line 1: sx sy theta: expected finite numbers"),
        ("a/b/c.png 0 1.5 0", r"line 1: expected sx sy theta in \[-1, 1\], got 0 1.5 0"),
        ("b/c.png 0 0 0", "line 1: expected DATE/DRIVE/FRAME.png sx sy theta, got 'b/c.png 0 0 0'"),
        ("../../c.png 0 0 0", "line 1: expected DATE/DRIVE/FRAME.png"),
    ],
)
def test_lists_that_cannot_be_read(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "list.txt").write_text(line)
    with pytest.raises(SkyfixError, match=message):
        read_list(tmp_path / "list.txt")
