"""Error profiles: how far off the answers of published networks are, as distributions that errors can be drawn from.

Papers give a mean, a median, a few recalls. A profile is a distribution that has them: the pose of the vehicle seen
from the network's answer is, axis by axis (forward, left, heading), Gaussian and cut off at the search box; a share of
the frames has the wide standard deviations of the tail. What the papers leave open is said at each profile.

Whatever is drawn from a profile is EMULATED: no network ran, and every table has to say so. Profiles' names do.

Sources: TransLocNet, arXiv 2512.10419, and the lists of HighlyAccurate (Shi, Li, CVPR 2022) on KITTI with satellite
images; FG2, Xia, Alahi, CVPR 2025; OrienterNet, Sarlin et al., CVPR 2023.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fusion.arrays import FloatArray
from fusion.errors import SkyfixError

_KITTI_HALF_M = 20.0
_KITTI_HALF_RAD = math.radians(10.0)


@dataclass(frozen=True, slots=True)
class PublishedFigures:
    """What a paper says of the errors; None or empty where it does not. Recalls are fractions by threshold."""

    mean_m: float | None = None
    median_m: float | None = None
    lateral_recall: Mapping[int, float] = field(default_factory=dict)
    longitudinal_recall: Mapping[int, float] = field(default_factory=dict)
    heading_mean_deg: float | None = None
    heading_recall: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ErrorProfile:
    """Distribution of the errors of single-shot localization.

    Parameters
    ----------
    name : str
        Begins with "emulated".
    core, tail : (longitudinal m, lateral m, heading rad)
        Standard deviations of an ordinary and of a bad frame, before they are cut off at the box; infinite for a
        uniform error.
    tail_share : float
        Share of bad frames, in [0, 1).
    published : PublishedFigures
        What the above was fitted to.
    half_extent_m, half_heading_rad : float
        The search box about the answer; no error is larger, along any axis.
    heading_is_seen : bool
        False for a network whose heading is that of its search box: its answer has the box's heading errors and its
        likelihood does not depend on heading at all, for a search box is no evidence.
    false_mode_share : float
        Share of frames, in [0, 0.5), whose strongest mode is a false one, uniform over the box, and the truth a
        weaker mode. Such frames come on top of the tail; published figures are met with a share of 0.

    Raises
    ------
    SkyfixError
        When a value is out of range or the name does not say "emulated".
    """

    name: str
    core: tuple[float, float, float]
    tail: tuple[float, float, float]
    tail_share: float
    published: PublishedFigures = field(default_factory=PublishedFigures)
    half_extent_m: float = _KITTI_HALF_M
    half_heading_rad: float = _KITTI_HALF_RAD
    heading_is_seen: bool = True
    false_mode_share: float = 0.0

    def __post_init__(self) -> None:
        if not self.name.startswith("emulated"):
            raise SkyfixError(f"profile name: expected one that begins with 'emulated', got {self.name!r}")
        if not all(sigma > 0.0 for sigma in (*self.core, *self.tail)):
            raise SkyfixError(f"profile: expected standard deviations > 0, got {self.core} and {self.tail}")
        if not 0.0 <= self.tail_share < 1.0:
            raise SkyfixError(f"tail_share: expected in [0, 1), got {self.tail_share}")
        if not 0.0 <= self.false_mode_share < 0.5:
            raise SkyfixError(f"false_mode_share: expected in [0, 0.5), got {self.false_mode_share}")
        if not (math.isfinite(self.half_extent_m) and self.half_extent_m > 0.0):
            raise SkyfixError(f"half_extent_m: expected > 0, got {self.half_extent_m}")
        if not 0.0 < self.half_heading_rad <= math.pi:
            raise SkyfixError(f"half_heading_rad: expected in (0, pi], got {self.half_heading_rad}")

    @property
    def half_box(self) -> FloatArray:
        """Half sides (3,) of the box that errors stay in: metres, metres, radians."""
        return np.array([self.half_extent_m, self.half_extent_m, self.half_heading_rad])


TRANSLOCNET_KITTI = ErrorProfile(
    name="emulated TransLocNet, KITTI + satellite",
    core=(2.5, 2.5, math.inf),
    tail=(10.0, 10.0, math.inf),
    tail_share=0.4101,
    heading_is_seen=False,
    published=PublishedFigures(mean_m=6.47, heading_mean_deg=5.07, heading_recall={1: 0.0981, 3: 0.3009, 5: 0.4977}),
)
"""The paper's KITTI row, start within +-20 m and +-10 degrees. Of the position only the mean is published: the
standard deviations are assumed, the share of the tail then follows. Its heading recalls are those of the search box,
10/30/50 %, so the heading is taken to be the box's."""

FG2_KITTI_SAME_AREA = ErrorProfile(
    name="emulated FG2, KITTI + satellite, same area",
    core=(0.4174, 0.4174, math.inf),
    tail=(4.039, 4.039, math.inf),
    tail_share=0.05,
    heading_is_seen=False,
    published=PublishedFigures(mean_m=0.75, median_m=0.51),
)
"""Mean and median fix the standard deviations once the tail's share is assumed. No heading is given here: none is
seen."""

ORIENTERNET_KITTI_SEQUENTIAL = ErrorProfile(
    name="emulated OrienterNet with a sequence of frames, KITTI + OpenStreetMap",
    core=(1.3454, 0.7095, math.radians(0.6995)),
    tail=(33.12, 8.292, math.radians(4.703)),
    tail_share=0.02995,
    published=PublishedFigures(
        longitudinal_recall={1: 0.526, 3: 0.956, 5: 0.974},
        lateral_recall={1: 0.819, 3: 0.974, 5: 0.987},
        heading_recall={1: 0.827, 3: 0.986, 5: 0.991},
    ),
)
"""Answers that already fuse the last frames, with true motion between them: their errors are correlated, and emulating
them as independent is generous. All nine recalls are met to within 0.7 points."""
