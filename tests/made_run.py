"""A made-up run with known errors, for tests of what is drawn and written of a run: no tracking happens here."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from fusion import se2
from fusion.grid import MapGrid
from fusion.odometry_doubts import OdometryDoubts
from fusion.odometry_errors import OdometryCalibration
from fusion.prior import UniformPrior
from fusion.trajectory import Trajectory
from learned.map_raster import CLASS_INDEX, MapRaster
from sequences.metrics import drift, summarise
from sequences.run_result import FrameRow, RunResult, Snapshot
from sequences.start import prior_answers
from sequences.track_settings import TrackSettings

CALIBRATION = OdometryCalibration(clock_offset_s=0.1, mount_yaw_rad=-0.005, log_scale=0.01)

SIGMA = np.array([0.30, 0.30, np.deg2rad(0.8)])
"""Standard deviations that the filter claims, and that its errors have."""


def made_map() -> MapRaster:
    """160 m x 120 m: a ring road through blocks of houses."""
    grid = MapGrid(rows=240, cols=320, metres_per_pixel=0.5, x0=-20.0, y0=-10.0)
    classes = np.zeros((240, 320), dtype=np.uint8)
    classes[20:220, 20:300] = CLASS_INDEX["road"]
    classes[36:204, 36:284] = CLASS_INDEX["grass"]
    for row in (50, 110, 160):
        for col in range(50, 250, 50):
            classes[row : row + 24, col : col + 34] = CLASS_INDEX["building"]
    return MapRaster.from_classes(grid, classes)


def made_run(frames: int = 120, *, with_truth: bool = True, snapshots: int = 6, name: str = "made_up") -> RunResult:
    """Drive the ring road once; the odometry drifts, the filter errs as it claims, every fourth frame is measured."""
    rng = np.random.default_rng(7)
    stamps = np.arange(frames, dtype=np.int64) * 500_000_000
    angle = np.linspace(0.0, 1.5 * np.pi, frames)
    truth_poses = np.stack([60 + 66 * np.cos(angle), 50 + 46 * np.sin(angle), angle + np.pi / 2], axis=-1)
    truth = Trajectory(stamps, truth_poses)
    prior = UniformPrior(truth_poses[0] + [4.0, -6.0, 0.05], half_extent_m=20.0, half_heading_rad=np.deg2rad(10.0))
    covariances = np.repeat(np.diag(SIGMA**2)[None], frames, axis=0)
    odometry = Trajectory(stamps, _drifted(prior.mean, truth.poses))
    tracked = Trajectory(stamps, truth_poses + rng.normal(size=(frames, 3)) * SIGMA, covariances)
    smoothed = Trajectory(stamps, truth_poses + 0.6 * rng.normal(size=(frames, 3)) * SIGMA, 0.36 * covariances)
    matched = np.arange(0, frames, 4)
    single = Trajectory(stamps[matched], truth_poses[matched] + rng.normal(size=(len(matched), 3)) * [2.0, 2.0, 0.05])
    rows = [_row(i, int(stamps[i]), measured=i % 4 == 0, rng=rng) for i in range(frames)]
    methods = {"odometry": odometry, "single_shot": single, "filter": tracked, "smoother": smoothed}
    settings = TrackSettings(odometry="wheels_emulated")
    methods["prior"] = prior_answers(truth, settings)
    summaries = {
        method: summarise(truth.interpolate(trajectory.stamp_ns), trajectory.poses, trajectory.covariances)
        for method, trajectory in methods.items()
    }
    raster = made_map()
    chosen = matched[np.linspace(0, len(matched) - 1, min(snapshots, len(matched))).astype(int)] if snapshots else []
    return RunResult(
        sequence_name=name,
        matcher_name="geometric",
        settings=settings,
        prior=prior,
        stamps_ns=stamps,
        truth=truth if with_truth else None,
        odometry=odometry,
        single_shot=single,
        filter=tracked,
        smoother=smoothed,
        frame_rows=rows,
        snapshots=[_snapshot(int(i), raster, truth.poses[i], tracked.poses[i], with_truth=with_truth) for i in chosen],
        metrics={
            **({**summaries, "drift": drift(truth, smoothed, odometry)} if with_truth else {}),
            "odometry_calibration": asdict(CALIBRATION),
            "filter_calibration": asdict(CALIBRATION),
            "seconds_per_frame": {"predict": 4e-4, "scan": 7e-4, "match": 1e-2, "update": 3e-4, "smooth": 5e-4},
            "realtime_factor": 3.2,
            "trust": {"evidence_gain_nats": 4.2, "lost_share": 0.0, "doubts": []},
        },
        map=raster,
        scans_simulated=True,
        odometry_source="wheels_emulated",
        length_m=truth.length_m,
        odometry_calibration=CALIBRATION,
        filter_calibration=CALIBRATION,
        odometry_doubts=OdometryDoubts.none(),
        log=["frame 9 (4.5 s): not measured: scan 8: expected points, got none", "<i>second line</i>"],
    )


def _drifted(start: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Chain the true increments, each too long by 4 % and turned by a little."""
    increments = se2.between(truth[:-1], truth[1:]) * [1.04, 1.0, 1.0] + [0.0, 0.0, 0.001]
    poses = [start]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment))
    return np.stack(poses)


def _row(index: int, stamp_ns: int, *, measured: bool, rng: np.random.Generator) -> FrameRow:
    return FrameRow(
        index=index,
        stamp_ns=stamp_ns,
        measured=measured,
        skipped_reason="scan 8: expected points, got none" if index == 9 else "",
        log_evidence=float(rng.normal(-1.0, 1.0)) if measured else None,
        effective_sample_size=float(rng.uniform(3000, 9000)),
        lost_score=float(np.exp(-index / 5)),
        temperature=2.0 if measured else None,
        search_half_extent_m=12.0 if measured else None,
        search_half_heading_rad=0.1 if measured else None,
        milliseconds={"predict": 0.4, **({"scan": 3.0, "match": 41.0, "update": 1.2} if measured else {})},
    )


def _snapshot(index: int, raster: MapRaster, truth: np.ndarray, estimate: np.ndarray, *, with_truth: bool) -> Snapshot:
    window = raster.grid.window(estimate[:2], 32.0)
    heat_grid = raster.grid.window(estimate[:2], 14.0)
    x, y = heat_grid.centres()
    squared = (x[None] - truth[0]) ** 2 / 1.5 + (y[:, None] - truth[1]) ** 2 / 0.8
    heat = np.maximum(-0.5 * squared, -12.0).astype(np.float32)
    bev = np.zeros((2, 128, 128), dtype=np.float32)
    bev[0, 40:44, 10:120] = 3.0
    bev[1, 80:, 20:100] = 1.0
    return Snapshot(
        index=index,
        bev=bev,
        map_crop=raster.crop(window),
        heat=heat,
        heat_grid=heat_grid,
        truth=truth if with_truth else None,
        estimate=estimate,
        best=truth + np.array([1.0, -0.5, 0.03]),
    )
