"""The demo's drive: real streets, a plausible path, drift that ends far off, scans that repeat."""

from __future__ import annotations

import numpy as np
import pytest

from fusion import se2
from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from learned.map_raster import CLASS_INDEX
from sequences.demo import DemoSequence, helsinki_features
from sequences.emulated_odometry import EmulatedDrift, emulate_odometry
from sequences.osm import Line, MapFeatures
from sequences.route import drive, road_graph, route_through, smooth_path
from sequences.sequence import Sequence


@pytest.fixture(scope="module")
def demo() -> DemoSequence:
    return DemoSequence(0)


def test_demo_is_a_sequence(demo: DemoSequence) -> None:
    sequence: Sequence = demo
    assert sequence.name == "demo"
    assert sequence.scans_simulated
    assert sequence.odometry_names == ("emulated",)
    assert sequence.stamps_ns.dtype == np.int64
    assert (np.diff(sequence.stamps_ns) > 0).all()
    assert sequence.ground_z == pytest.approx(-1.73)


def test_drive_is_two_kilometres_of_plausible_motion(demo: DemoSequence) -> None:
    truth = demo.ground_truth
    steps = se2.between(truth.poses[:-1], truth.poses[1:])
    assert 1900.0 < np.hypot(steps[:, 0], steps[:, 1]).sum() < 2100.0
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 0.81
    assert np.abs(steps[:, 1]).max() < 0.05
    assert np.rad2deg(np.abs(steps[:, 2])).max() < 8.0
    left, right = steps[steps[:, 2] > 0, 2].sum(), steps[steps[:, 2] < 0, 2].sum()
    assert left > np.pi
    assert right < -np.pi


def test_emulated_odometry_ends_more_than_fifteen_metres_off(demo: DemoSequence) -> None:
    odometry = demo.odometry("emulated")
    placed = se2.compose(demo.ground_truth.poses[0], odometry.poses)
    error = np.hypot(*(placed - demo.ground_truth.poses)[:, :2].T)
    assert odometry.poses[0] == pytest.approx([0.0, 0.0, 0.0])
    assert error[-1] > 15.0
    assert error[:100].max() < 3.0
    assert np.array_equal(odometry.poses, demo.odometry("emulated").poses)


def test_unknown_odometry_is_named(demo: DemoSequence) -> None:
    with pytest.raises(SkyfixError, match="odometry: expected one of emulated, got wheels"):
        demo.odometry("wheels")


def test_drive_is_on_the_map_and_nothing_stands_in_its_way(demo: DemoSequence) -> None:
    poses = demo.ground_truth.poses
    rows, cols = np.floor(demo.map.grid.pixel_from_xy(poses[:, :2])).astype(int).T
    assert demo.map.classes is not None
    assert not np.any(demo.map.classes[rows, cols] == CLASS_INDEX["building"])
    assert demo.world.is_free(poses[:, :2], 1.0).all()
    near_road = np.zeros(len(poses), dtype=bool)
    for shift in range(-8, 9):
        near_road |= demo.map.classes[rows + shift, cols] == CLASS_INDEX["road"]
        near_road |= demo.map.classes[rows, cols + shift] == CLASS_INDEX["road"]
    assert near_road.mean() > 0.97


def test_scans_repeat_and_show_the_streets(demo: DemoSequence) -> None:
    scan = demo.scan(100)
    assert scan.shape[1] == 4
    assert len(scan) > 30000
    assert np.array_equal(scan, demo.scan(100))
    assert not np.array_equal(scan, demo.scan(101))
    close = np.hypot(scan[:, 0], scan[:, 1]) < 5.0
    assert np.quantile(scan[close, 2], 0.2) == pytest.approx(demo.ground_z, abs=0.15)


def test_scans_agree_with_the_map(demo: DemoSequence) -> None:
    """Tall returns fall on or next to mapped buildings far more often at the true pose than at a wrong one."""
    grid, classes = demo.map.grid, demo.map.classes
    assert classes is not None

    def share_on_buildings(error: list[float]) -> float:
        shares = []
        for index in range(200, len(demo.stamps_ns), 400):
            scan = demo.scan(index)
            tall = scan[scan[:, 2] > demo.ground_z + 1.8]
            pose = se2.compose(demo.ground_truth.poses[index], np.array(error))
            rows, cols = (
                np.floor(grid.pixel_from_xy(se2.transform_points(pose, tall[:, :2].astype(float)))).astype(int).T
            )
            inside = (rows >= 0) & (cols >= 0) & (rows < grid.rows) & (cols < grid.cols)
            building = classes == CLASS_INDEX["building"]
            edge = building & ~np.roll(building, 2, 0) | building & ~np.roll(building, -2, 0)
            edge |= building & ~np.roll(building, 2, 1) | building & ~np.roll(building, -2, 1)
            shares.append(np.mean(edge[rows[inside], cols[inside]]))
        return float(np.mean(shares))

    true = share_on_buildings([0.0, 0.0, 0.0])
    assert true > 0.1
    for error in ([6.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0], [0.0, 0.0, 0.5]):
        assert share_on_buildings(error) < 0.75 * true


def test_extract_lies_in_helsinki() -> None:
    features = helsinki_features()
    centre = np.median([area.rings[0][0] for area in features.areas], axis=0)
    assert np.hypot(*centre) < 300.0
    assert len(features.areas) > 500


def test_route_respects_one_way_streets_and_passes_dead_ends_by() -> None:
    def road(points: list[list[float]], one_way: bool = False) -> Line:
        return Line("road", np.array(points), 6.0, detail="residential", one_way=one_way)

    town = MapFeatures(
        (),
        (
            road([[0, 0], [100, 0]], one_way=True),
            road([[100, 0], [100, 50], [0, 50], [0, 0]]),
            road([[100, 50], [150, 50]]),
        ),
    )
    graph = road_graph(town)
    assert route_through(graph, [(0, 0), (100, 0)]).tolist() == [[0, 0], [100, 0]]
    assert route_through(graph, [(100, 0), (0, 0)]).tolist() == [[100, 0], [100, 50], [0, 50], [0, 0]]
    assert [150.0, 50.0] not in route_through(graph, [(100, 0), (150, 50), (0, 50)]).tolist()
    with pytest.raises(SkyfixError, match="route: expected at least 500 m, got 100 m"):
        smooth_path(route_through(graph, [(0, 0), (100, 0)]), 500.0)
    with pytest.raises(SkyfixError, match="route: expected an extract with through roads"):
        road_graph(MapFeatures((), ()))


def test_path_keeps_right_and_slows_down_in_a_corner() -> None:
    corner = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 100.0]])
    path = smooth_path(corner, 190.0, right_of_centre_m=1.6)
    straight = path[(path[:, 0] > 20.0) & (path[:, 0] < 80.0)]
    assert straight[:, 1] == pytest.approx(-1.6, abs=0.02)
    trajectory = drive(path, speed_mps=8.0)
    speed = 10.0 * np.hypot(*np.diff(trajectory.poses[:, :2], axis=0).T)
    assert speed[20] == pytest.approx(8.0, abs=0.05)
    assert 2.0 < speed.min() < 6.0
    assert np.abs(np.diff(speed)).max() * 10.0 < 2.5


def test_drift_of_pure_scale_error_is_proportional_to_the_distance() -> None:
    truth = Trajectory(np.arange(101) * 10**8, np.column_stack([np.arange(101.0), np.zeros(101), np.zeros(101)]))
    odometry = emulate_odometry(truth, 0, EmulatedDrift(0.02, 0.0, 0.0, 0.0))
    assert odometry.poses[:, 0] == pytest.approx(1.02 * np.arange(101.0))
    assert odometry.poses[:, 1:] == pytest.approx(0.0)
