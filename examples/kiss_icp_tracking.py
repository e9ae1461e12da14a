"""Track a drive with KISS-ICP as odometry and the shipped matcher on its map, the start known to 20 m and 11 degrees.

    pip install 'skyfix[kiss-icp]'
    python examples/kiss_icp_tracking.py SEQUENCE

SEQUENCE is a folder with map.json and LiDAR scans (see the README), at 5 Hz or more; its odometry is not used, and its
ground truth only to start from and to compare with. KISS-ICP: Vizzo et al., "KISS-ICP: In Defense of Point-to-Point
ICP", RA-L 2023.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from fusion import Tracker, TrackerSettings, UniformPrior, se2
from learned.matcher import SearchRegion, error_correlation_length_m, load_matcher
from sequences.folder import FolderSequence

MEASURE_EVERY_M = 4.0


def main(folder: Path) -> None:
    """Track, and say every few metres how far off the tracker and KISS-ICP alone are."""
    sequence, matcher = FolderSequence(folder), load_matcher("rotmatch")
    assert sequence.ground_truth is not None
    truth = sequence.ground_truth.interpolate(sequence.stamps_ns, 10**9)
    guess = truth[0] + [8.0, -6.0, np.deg2rad(5.0)]

    config = KISSConfig()
    config.data.deskew = False  # these scans are motion-compensated already
    config.mapping.voxel_size = 1.0
    odometry = KissICP(config)
    settings = TrackerSettings(correlation_length_m=error_correlation_length_m(matcher, sequence.map))
    tracker = Tracker.from_prior(UniformPrior(guess, half_extent_m=20.0, half_heading_rad=0.2), settings=settings)

    way_m, measured_at_m, before, measurements, off, alone = 0.0, -np.inf, np.zeros(3), 0, np.nan, np.nan
    for frame, stamp_ns in enumerate(sequence.stamps_ns.tolist()):
        points = sequence.scan(frame)
        odometry.register_frame(points[:, :3].astype(np.float64), np.zeros(0))
        turn = odometry.last_pose[:3, :3]
        here = np.array([*odometry.last_pose[:2, 3], np.arctan2(turn[1, 0], turn[0, 0])])
        tracker.add_odometry(stamp_ns, here)
        way_m, before = way_m + float(np.hypot(*(here - before)[:2])), here
        if way_m - measured_at_m < MEASURE_EVERY_M:
            continue

        predicted = tracker.estimate()
        reach_m = float(np.clip(3.5 * np.sqrt(predicted.covariance[:2, :2].trace()), 12.0, 24.0))
        reach_rad = float(np.clip(3.5 * np.sqrt(predicted.covariance[2, 2]), 0.1, 0.3))
        region = SearchRegion(predicted.pose, reach_m, reach_rad)
        tracker.add_likelihood(stamp_ns, matcher.match(points, sequence.ground_z, sequence.map, region))
        measured_at_m, measurements = way_m, measurements + 1

        estimate = tracker.estimate()
        off = float(np.linalg.norm((estimate.pose - truth[frame])[:2]))
        alone = float(np.linalg.norm((se2.compose(guess, here) - truth[frame])[:2]))
        sigma = np.sqrt(estimate.covariance[:2, :2].trace())
        print(f"{way_m:6.1f} m   tracker off by {off:5.2f} m (sigma {sigma:.2f} m)   KISS-ICP alone {alone:5.2f} m")
    print(f"{measurements} of {len(truth)} scans measured: tracker ends {off:.2f} m off, KISS-ICP alone {alone:.2f} m")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/kiss_icp_tracking.py SEQUENCE")
    main(Path(sys.argv[1]))
