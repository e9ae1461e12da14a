"""Everything that a tracked drive depends on besides the sequence and the matcher. It is written out with every run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace

from fusion.errors import SkyfixError
from fusion.factor_graph import OdometryDrift, SmootherSettings
from fusion.odometry import OdometryNoise
from fusion.odometry_errors import OdometryCalibration
from fusion.odometry_limits import OdometryLimits
from fusion.particle_filter import ParticleFilterSettings
from sequences.search_settings import SearchSettings


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """Settings of `localize.track`; every number that a person may want to change. Checked when made.

    Attributes
    ----------
    odometry
        Name of the odometry that the sequence offers.
    seed
        Of the start, the particles and the simulated scans. Same seed, same result.
    particles
        Number of particles.
    half_extent_m, half_heading_deg
        The start is known to within a square of this half side and to within this heading. 180 means that it is
        unknown.
    start
        Centre of that box, x and y in metres and yaw in degrees in the map frame. None: the true first pose plus an
        offset drawn uniformly from the box, which needs ground truth.
    start_anywhere
        Nothing is known of the start, not even the heading: it is looked for on the whole map.
    measure_every_m
        A scan is matched with the map when the odometry has moved this far since the last one that was.
    measure_every_frames
        When given, every so many frames instead.
    correlation_length_m
        Distance over which a matcher's errors resemble each other. None: the matcher's own.
    map_error_m
        Standard deviation, east and north alike, of where the map draws things against where they are. Neighbouring
        measurements share it, so no number of them averages it out: it is added to the covariances that are reported.
        OpenStreetMap is traced from aerial images that are a few decimetres off.
    map_check_every_m
        While the vehicle is tracked, a scan is compared with the whole map every so many metres (see `map_watch`),
        where the matcher can; with 0 only for a while after it was found on the whole map. It decides on nothing but
        whether the vehicle is lost, and is the only way to notice that it was carried to a place that looks alike;
        where many places do, it raises false alarms.
    snapshots
        Measured frames kept for the report.
    search, filter, smoother
        Where scans are looked for; the particle filter, whose outlier probability the start's search has too; the
        smoother, whose drift is found from the drive and is none here.
    noise
        The odometry's noise, standard deviations that grow with the root of the distance.
    limits
        What the odometry can be believed to have done; gaps and jumps cost certainty. Fitted to the odometry's own rate
        and speeds, see `OdometryLimits.fitted`.
    calibration
        The odometry's errors, known from an earlier drive; the filter gets it corrected and its noise as it was found.
        The smoother finds them by itself. None: the odometry as it comes.
    """

    odometry: str
    seed: int = 0
    particles: int = 10_000
    half_extent_m: float = 20.0
    half_heading_deg: float = 10.0
    start: tuple[float, float, float] | None = None
    start_anywhere: bool = False
    measure_every_m: float = 4.0
    measure_every_frames: int | None = None
    correlation_length_m: float | None = None
    map_error_m: float = 0.4
    map_check_every_m: float = 0.0
    snapshots: int = 6
    search: SearchSettings = field(default_factory=SearchSettings)
    filter: ParticleFilterSettings = field(default_factory=ParticleFilterSettings)
    smoother: SmootherSettings = field(default_factory=SmootherSettings)
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    limits: OdometryLimits = field(default_factory=OdometryLimits)
    calibration: OdometryCalibration | None = None

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise SkyfixError(f"{entry.name}: expected a finite number, got {value}")
        for name in ("particles", "half_extent_m", "half_heading_deg"):
            if getattr(self, name) <= 0:
                raise SkyfixError(f"{name}: expected more than 0, got {getattr(self, name)}")
        if self.half_heading_deg > 180.0:
            raise SkyfixError(f"half_heading_deg: expected at most 180, got {self.half_heading_deg:g}")
        if self.measure_every_frames is not None and self.measure_every_frames < 1:
            raise SkyfixError(f"measure_every_frames: expected 1 or more, got {self.measure_every_frames}")
        for name in ("measure_every_m", "map_error_m", "correlation_length_m", "map_check_every_m", "snapshots"):
            if (getattr(self, name) or 0) < 0:
                raise SkyfixError(f"{name}: expected 0 or more, got {getattr(self, name):g}")
        if self.start is not None and len(self.start) != 3:
            raise SkyfixError(f"start: expected x, y (m) and yaw (degrees), got {len(self.start)} numbers")
        if self.start_anywhere and self.start is not None:
            raise SkyfixError(f"start: expected none with start_anywhere, got {self.start}")
        if self.seed < 0:
            raise SkyfixError(f"seed: expected 0 or more, got {self.seed}")
        if self.smoother.drift is not None:
            raise SkyfixError("smoother drift: expected none, it is found from the drive")
        replace(self.smoother, drift=OdometryDrift())  # is checked

    @property
    def heading_unknown(self) -> bool:
        """Whether the start's heading is anything."""
        return self.start_anywhere or self.half_heading_deg >= 180.0

    @property
    def half_heading_rad(self) -> float:
        """Half width of the start's headings, radians."""
        return math.radians(self.half_heading_deg)


SETTABLE = tuple(entry.name for entry in fields(TrackSettings) if entry.name not in ("odometry", "seed", "calibration"))
"""Fields that `--set` changes; the others have options of their own."""
