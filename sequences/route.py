"""A drive over real streets: shortest ways through waypoints on the road graph, rounded corners, a plausible speed.

The graph joins road polylines at shared points (in OpenStreetMap ways that meet share a node) and respects one-way
streets. The path keeps to the right of the centreline; corners are rounded by a Gaussian along the way, and speed
is limited by lateral acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from fusion.errors import SkyfixError
from fusion.trajectory import Trajectory
from sequences.osm import MapFeatures
from sequences.world_roads import beside, resampled

_STEP_M = 0.25
_NO_THROUGH = frozenset({"service", "track", "busway"})


def road_graph(features: MapFeatures) -> nx.DiGraph:
    """Directed graph of through roads; nodes are (x, y) rounded to a centimetre, edges carry `length` in metres."""
    graph = nx.DiGraph()
    for road in features.roads():
        if road.detail in _NO_THROUGH:
            continue
        nodes = [(round(float(x), 2), round(float(y), 2)) for x, y in road.points]
        for start, end in pairwise(nodes):
            length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
            graph.add_edge(start, end, length=length)
            if not road.one_way:
                graph.add_edge(end, start, length=length)
    if not len(graph):
        raise SkyfixError("route: expected an extract with through roads, got none")
    largest = max(nx.strongly_connected_components(graph), key=len)
    return graph.subgraph(largest)


def route_through(graph: nx.DiGraph, waypoints: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    """Polyline (N, 2) of shortest ways between the junctions nearest to the waypoints, metres.

    Where the way would go into a street and straight back out, it passes by instead.
    """
    nodes = list(graph.nodes)
    positions = np.array(nodes)
    stops = [nodes[int(np.argmin(np.hypot(*(positions - waypoint).T)))] for waypoint in waypoints]
    points = [stops[0]]
    for start, end in pairwise(stops):
        for node in nx.shortest_path(graph, start, end, weight="length")[1:]:
            if len(points) >= 2 and points[-2] == node:
                points.pop()
            else:
                points.append(node)
    return np.array(points, dtype=np.float64)


def smooth_path(
    points: NDArray[np.float64], length_m: float, right_of_centre_m: float = 1.6, rounding_m: float = 4.0
) -> NDArray[np.float64]:
    """Poses (M, 3) every quarter of a metre along a polyline's first `length_m` metres, corners rounded.

    Raises
    ------
    SkyfixError
        If the polyline is shorter.
    """
    dense, _ = resampled(points, _STEP_M)
    if len(dense) * _STEP_M < length_m:
        raise SkyfixError(f"route: expected at least {length_m:.0f} m, got {len(dense) * _STEP_M:.0f} m")
    dense = dense[: round(length_m / _STEP_M)]
    rounded = gaussian_filter1d(dense, rounding_m / _STEP_M, axis=0, mode="nearest")
    step = np.gradient(rounded, axis=0)
    lane = beside(rounded, np.arctan2(step[:, 1], step[:, 0]), -right_of_centre_m)
    lane = gaussian_filter1d(lane, 1.5 / _STEP_M, axis=0, mode="nearest")
    moved = np.concatenate([[True], np.hypot(*np.diff(lane, axis=0).T) > 0.02])
    lane = lane[moved]
    direction = np.gradient(lane, axis=0)
    return np.column_stack([lane, np.arctan2(direction[:, 1], direction[:, 0])])


def drive(
    path: NDArray[np.float64],
    speed_mps: float = 8.0,
    rate_hz: float = 10.0,
    lateral_acceleration: float = 2.0,
    acceleration: float = 1.5,
) -> Trajectory:
    """Drive along poses (M, 3): stamped poses at a fixed rate, slower where the path bends."""
    legs = np.hypot(*np.diff(path[:, :2], axis=0).T)
    stations = np.concatenate([[0.0], np.cumsum(legs)])
    yaw = np.unwrap(path[:, 2])
    bend = np.abs(np.gradient(yaw, stations)) + 1e-6
    speed = np.minimum(speed_mps, np.sqrt(lateral_acceleration / bend))
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 2.0 * acceleration * legs[i - 1]))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2.0 * acceleration * legs[i]))
    time = np.concatenate([[0.0], np.cumsum(2.0 * legs / (speed[1:] + speed[:-1]))])
    ticks = np.arange(int(time[-1] * rate_hz) + 1)
    at = np.interp(ticks / rate_hz, time, stations)
    poses = np.column_stack([np.interp(at, stations, column) for column in (path[:, 0], path[:, 1], yaw)])
    return Trajectory((ticks * round(1e9 / rate_hz)).astype(np.int64), poses, frame_id="map")
