"""AGL-Net's CARLA routes: axes, signs, the authors' own ground truth, and scans that are pickles."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from carla_layout import (
    COLOURS,
    FRAMES,
    LANDMARKS,
    PHOTOGRAPH,
    SIDE_PX,
    ground_truth,
    raw_scan,
    write_route,
    write_scan,
)

from fusion import se2
from fusion.errors import SkyfixError
from sequences.carla import CarlaRoute, metres_per_pixel
from sequences.sequence import ScanError


def test_scale_is_that_of_the_published_photographs() -> None:
    assert 1.0 / metres_per_pixel(5000) == pytest.approx(11.8, abs=0.02)


@pytest.mark.parametrize("pickled", [True, False])
@pytest.mark.parametrize("dump", [True, False])
def test_landmarks_are_where_the_photograph_shows_them(tmp_path: Path, pickled: bool, dump: bool) -> None:
    sequence = CarlaRoute(write_route(tmp_path, pickled, dump), allow_pickle=pickled)
    assert (sequence.name, sequence.ground_z) == (f"Town01_route_00_{PHOTOGRAPH}", -2.5)
    assert len(sequence.stamps_ns) == FRAMES
    truth = sequence.ground_truth
    assert truth is not None
    assert len({int(quadrant) for quadrant in np.floor(truth.poses[:, 2] / (np.pi / 2))}) == 4
    for index, pose in enumerate(truth.poses):
        on_map = se2.transform_points(pose, sequence.scan(index)[:, :2].astype(np.float64))
        rows, cols = np.floor(sequence.map.grid.pixel_from_xy(on_map)).astype(int).T
        np.testing.assert_array_equal(sequence.map.picture[rows, cols], COLOURS)
    np.testing.assert_allclose(sequence.scan(0)[:, 2], -2.5)
    assert len(on_map) == len(LANDMARKS)


def test_the_photographing_vehicle_is_in_the_middle_heading_up(tmp_path: Path) -> None:
    sequence = CarlaRoute(write_route(tmp_path), allow_pickle=True)
    assert sequence.ground_truth is not None
    pose = sequence.ground_truth.poses[int(PHOTOGRAPH)]
    np.testing.assert_allclose(pose, [0.0, 1.3, np.pi / 2], atol=1e-9)


def test_poses_agree_with_the_authors_ground_truth(tmp_path: Path) -> None:
    """uv_gt is the pixel of the LiDAR, 2.5 m nearer to the camera than the ground; theta = atan2(dv, du)."""
    sequence = CarlaRoute(write_route(tmp_path), allow_pickle=True)
    assert sequence.ground_truth is not None
    scale = metres_per_pixel(SIDE_PX, 1200.0 - 2.5)
    for index, (x, y, yaw) in enumerate(sequence.ground_truth.poses):
        listed = ground_truth(index)
        np.testing.assert_allclose(np.array(listed["uv_gt"]), SIDE_PX / 2 + np.array([x, -y]) / scale, atol=1e-6)
        assert se2.wrap(float(str(listed["theta_gt"])) + yaw) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("key", "value"), [("uv_gt", [0.0, 0.0]), ("theta_gt", 3.0), ("uv_gt", None), ("theta_gt", "x")]
)
def test_a_dump_that_disagrees_is_refused(tmp_path: Path, key: str, value: object) -> None:
    route = write_route(tmp_path)
    dump = json.loads((route / "dump_gt.json").read_text())
    dump[PHOTOGRAPH]["0005"][key] = value
    (route / "dump_gt.json").write_text(json.dumps(dump))
    with pytest.raises(SkyfixError, match=r"dump_gt\.json: 0005: expected uv_gt.* theta_gt"):
        CarlaRoute(route, allow_pickle=True)


def test_the_dump_says_which_scans_are_on_a_photograph(tmp_path: Path) -> None:
    route = write_route(tmp_path)
    dump = json.loads((route / "dump_gt.json").read_text())
    dump[PHOTOGRAPH] = {name: dump[PHOTOGRAPH][name] for name in ("0006", "0001")}
    (route / "dump_gt.json").write_text(json.dumps(dump))
    sequence = CarlaRoute(route / "topdown_rgb" / f"{PHOTOGRAPH}.png", allow_pickle=True)
    np.testing.assert_array_equal(sequence.stamps_ns, np.array([1, 6]) * 500_000_000)
    np.testing.assert_array_equal(sequence.scan(1)[:, 1], raw_scan(6)[:, 0])
    (route / "topdown_rgb" / f"{PHOTOGRAPH}.png").rename(route / "topdown_rgb" / "0002.png")
    with pytest.raises(SkyfixError, match=r"expected scans on 0002, got 0003"):
        CarlaRoute(route / "topdown_rgb" / "0002.png", allow_pickle=True)


class Trap:
    """Unpickling this makes a folder."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.target),)


def test_pickles_are_not_run_unless_allowed(tmp_path: Path) -> None:
    route = write_route(tmp_path)
    trap = np.empty(1, dtype=object)
    trap[0] = Trap(tmp_path / "sprung")
    np.save(route / "lidar" / "0000.npy", trap, allow_pickle=True)
    with pytest.raises(SkyfixError, match=r"0000\.npy: expected a plain array, got pickled objects.*--allow-pickle"):
        CarlaRoute(route)
    write_scan(route, 0, raw_scan(0), pickled=False)
    np.save(route / "lidar" / "0001.npy", trap, allow_pickle=True)
    with pytest.raises(ScanError, match=r"scan 0001\.npy: cannot be read"):
        CarlaRoute(route).scan(1)
    assert not (tmp_path / "sprung").exists()
    with pytest.raises(ScanError, match=r"scan 0001\.npy"):
        CarlaRoute(route, allow_pickle=True).scan(1)
    assert (tmp_path / "sprung").exists()  # so the trap would have sprung


def test_broken_scans_are_errors_of_that_scan(tmp_path: Path) -> None:
    route = write_route(tmp_path)
    write_scan(route, 1, raw_scan(1)[:, :3], pickled=True)
    write_scan(route, 2, np.full((5, 4), np.nan, dtype=np.float32), pickled=True)
    whole = (route / "lidar" / "0004.npy").read_bytes()
    (route / "lidar" / "0004.npy").write_bytes(whole[:-40])
    (route / "lidar" / "0005.npy").unlink()
    sequence = CarlaRoute(route, allow_pickle=True)
    for index, reason in [
        (1, r"expected \(N, 4\) points"),
        (2, "finite"),
        (4, "cannot be read"),
        (5, "cannot be read"),
    ]:
        with pytest.raises(ScanError, match=rf"scan 000{index}\.npy: .*{reason}") as caught:
            sequence.scan(index)
        assert "\n" not in str(caught.value)
    assert len(sequence.scan(3)) == len(LANDMARKS)
