"""AGL-Net's CARLA layout on disk, with planted landmarks and the ground truth as its authors compute it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

SIDE_PX = 1000
FRAMES = 8
PHOTOGRAPH = "0003"
LANDMARKS = np.array([[30.0, 10.0], [-25.0, 40.0], [5.0, -35.0], [-40.0, -20.0]])
"""North and east of the world's origin, metres."""
COLOURS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], dtype=np.uint8)
FOCAL_PX = SIDE_PX / 2 / np.tan(np.radians(10.0))


def measurement(index: int) -> dict[str, float]:
    """x north, y east, theta clockwise from north: by 50 degrees a frame, so every quadrant comes."""
    return {"x": 3.0 * index - 10.0, "y": 8.0 - 2.0 * index, "theta": float(np.radians(50.0 * index + 20.0))}


def seen_from(index: int, place: np.ndarray) -> tuple[float, float]:
    """Metres ahead and to the right of the vehicle of a place (north, east)."""
    at = measurement(index)
    north, east = place - [at["x"], at["y"]]
    cos, sin = np.cos(at["theta"]), np.sin(at["theta"])
    return north * cos + east * sin, east * cos - north * sin


def raw_scan(index: int) -> np.ndarray:
    """(N, 4) float32 in CARLA's own axes of a LiDAR turned by -90 degrees: x left, y ahead, z up; on the ground."""
    rows = []
    for place in LANDMARKS:
        ahead, right = seen_from(index, place)
        rows.append([-right, ahead - 1.3, -2.5, index / 1000.0])
    return np.array(rows, dtype=np.float32)


def write_route(carla: Path, pickled: bool = True, dump: bool = True) -> Path:
    """Write Town01/route_00 and give its folder."""
    route = carla / "Town01" / "route_00"
    for folder in ("lidar", "measurements", "topdown_rgb"):
        (route / folder).mkdir(parents=True)
    for index in range(FRAMES):
        (route / "measurements" / f"{index:04d}.json").write_text(json.dumps({**measurement(index), "speed": 3.0}))
        write_scan(route, index, raw_scan(index), pickled)
    picture = np.full((SIDE_PX, SIDE_PX, 3), 40, dtype=np.uint8)
    for place, colour in zip(LANDMARKS, COLOURS, strict=True):
        ahead, right = seen_from(int(PHOTOGRAPH), place)
        row = int(SIDE_PX / 2 - FOCAL_PX / 1200.0 * ahead)
        col = int(SIDE_PX / 2 + FOCAL_PX / 1200.0 * right)
        picture[row - 2 : row + 3, col - 2 : col + 3] = colour
    Image.fromarray(picture).save(route / "topdown_rgb" / f"{PHOTOGRAPH}.png")
    if dump:
        listed = {f"{index:04d}": ground_truth(index) for index in range(FRAMES)}
        (route / "dump_gt.json").write_text(json.dumps({PHOTOGRAPH: listed}))
    return route


def write_scan(route: Path, index: int, points: np.ndarray, pickled: bool) -> None:
    """As numpy saves the pair (frame, points) of CARLA's sensor, or the points alone."""
    content = points
    if pickled:
        content = np.empty(2, dtype=object)
        content[0], content[1] = index, points
    np.save(route / "lidar" / f"{index:04d}.npy", content, allow_pickle=pickled)


def ground_truth(index: int) -> dict[str, object]:
    """uv_gt and theta_gt through the authors' chain of transforms: LiDAR, vehicle, world, photograph."""
    ego, photograph = measurement(index), measurement(int(PHOTOGRAPH))
    mirrored = np.diag([-1.0, 1.0, -1.0, 1.0])
    ego_from_lidar = np.linalg.inv(_moved(1.3, 0.0, 2.5) @ _turned(np.radians(-90.0)))
    world = _moved(ego["y"], -ego["x"], 0.0) @ _turned(ego["theta"])
    back = _turned(-photograph["theta"]) @ _moved(-photograph["y"], photograph["x"], 0.0)
    chain = _moved(0.0, 0.0, 1200.0) @ back @ world @ ego_from_lidar @ mirrored
    uv, front = _pixel(chain @ [0.0, 0.0, 0.0, 1.0]), _pixel(chain @ [10.0, 0.0, 0.0, 1.0])
    theta = float(np.arctan2(front[1] - uv[1], front[0] - uv[0]))
    return {"t_l2oc": chain.tolist(), "uv_gt": uv.tolist(), "theta_gt": theta}


def _pixel(point: np.ndarray) -> np.ndarray:
    return FOCAL_PX * point[:2] / point[2] + SIDE_PX / 2


def _moved(x: float, y: float, z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def _turned(angle: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return matrix
