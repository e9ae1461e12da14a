"""The online half of a tracked drive: odometry moves the particles, scans matched with the map weigh them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from fusion.arrays import FloatArray
from fusion.consistency import correlated_error_temperature
from fusion.errors import SkyfixError
from fusion.estimate import Estimate
from fusion.graph.patch import LikelihoodPatch
from fusion.odometry import OdometryIncrement, accumulate
from fusion.particle_filter import ParticleFilter
from fusion.prior import UniformPrior
from fusion.two_level import TwoLevelLikelihood
from learned.answers import match_scan
from learned.matcher import MapMatcher, error_correlation_length_m, largest_half_extent_m
from sequences.anywhere import Predicted
from sequences.anywhere_search import AnywhereSearch
from sequences.drive import Drive
from sequences.map_watch import MapWatch
from sequences.measurement import Measurement
from sequences.run_result import FrameRow, Snapshot
from sequences.search import Phase, SearchPlan
from sequences.sequence import ScanError
from sequences.snapshots import take_snapshot
from sequences.start_cloud import MOST_MEASUREMENTS, StartCloud
from sequences.stopwatch import Stopwatch
from sequences.track_settings import TrackSettings
from sequences.trajectory_io import format_seconds

STAGES = ("scan", "match", "predict", "update")
_FILTER_STREAM = 1


class FilterPass:
    """Runs the filter over a drive, one frame a call of `step`.

    Attributes
    ----------
    estimates, rows, patches
        One entry for every frame so far; the patches of the likelihoods, for the smoother, are None at frames without
        a measurement.
    best
        Frame number -> the measurement's own best pose (3,), at the measured frames.
    snapshots
        A few measured frames, spread evenly over the way.
    log
        What a person may want to know afterwards.

    Parameters
    ----------
    drive
        The frames.
    increments
        Odometry from each frame to the next.
    matcher, prior, settings
        The measurement model, the start, everything else.

    Raises
    ------
    SkyfixError
        If the start is larger than what the matcher searches, or is anywhere and it cannot search the whole map.
    """

    def __init__(
        self,
        drive: Drive,
        increments: list[OdometryIncrement],
        matcher: MapMatcher,
        prior: UniformPrior,
        settings: TrackSettings,
    ) -> None:
        self.estimates: list[Estimate] = []
        self.rows: list[FrameRow] = []
        self.patches: list[LikelihoodPatch | None] = []
        self.best: dict[int, FloatArray] = {}
        self.snapshots: list[Snapshot] = []
        self.log: list[str] = []
        self._drive, self._increments, self._matcher = drive, increments, matcher
        self._way_m = sum(float(np.hypot(*increment.delta[:2])) for increment in increments)
        self._prior, self._settings = prior, settings
        given = settings.correlation_length_m
        self._correlation_m = error_correlation_length_m(matcher, drive.sequence.map) if given is None else given
        self._filter: ParticleFilter | None = None
        self._travelled_m = 0.0
        self._measured_at_m = 0.0
        self._unknown_m2 = 0.0  # variance of the motion since then
        self._since_measured: list[OdometryIncrement] = []
        self._rng = np.random.default_rng([settings.seed, _FILTER_STREAM])
        self._start_cloud = StartCloud(prior, settings.particles, settings.filter.outlier_probability, self._rng)
        largest_m = largest_half_extent_m(matcher)
        if prior.half_extent_m > largest_m and not settings.start_anywhere:
            raise SkyfixError(
                f"start: expected a half extent of at most {largest_m:g} m, the largest search of {matcher.name}, "
                f"got {prior.half_extent_m:g}"
            )
        self._plan = SearchPlan(prior, settings, largest_m)
        self._watch = MapWatch(settings.map_check_every_m, drive.sequence.map.grid.area_m2)
        self._anywhere = AnywhereSearch(matcher, drive.sequence.map, drive.sequence.ground_z, settings, self._rng)
        if settings.start_anywhere:
            self._anywhere.prepare()

    def step(self, frame: int) -> FrameRow:
        """Process one frame; frames come in order from 0.

        Raises
        ------
        ScanError
            If the first scan cannot be used; a later one is skipped, with the reason in its row and the log.
        """
        watch, reason, evidence = Stopwatch(), "", None
        measurement: Measurement | None
        if self._filter is None:
            measurement = self._measure(frame, None, watch)
            with watch("update"):
                self._filter, evidence = self._start(measurement)
        else:
            with watch("predict"):
                self._move(self._filter, frame)
            measurement, reason = self._measure_if_due(self._filter, frame, watch)
            if measurement is not None:
                predicted = Predicted.of(self._filter)
                with watch("update"):
                    evidence = self._update(self._filter, frame, measurement)
                with watch("match"):
                    self._look_around(self._filter, predicted, frame, measurement)
        estimate = self._estimate(self._filter, frame)
        self._keep(frame, estimate, measurement)
        self.rows.append(
            FrameRow(
                index=int(self._drive.indices[frame]),
                stamp_ns=self._stamp(frame),
                measured=measurement is not None,
                skipped_reason=reason,
                log_evidence=evidence,
                effective_sample_size=estimate.effective_sample_size,
                lost_score=estimate.lost_score,
                temperature=None if measurement is None else measurement.temperature,
                search_half_extent_m=None if measurement is None else measurement.search.half_extent_m,
                search_half_heading_rad=None if measurement is None else measurement.search.half_heading_rad,
                milliseconds=watch.milliseconds,
            )
        )
        return self.rows[-1]

    def _estimate(self, particles: ParticleFilter, frame: int) -> Estimate:
        """The filter's, or that of the likeliest place on the map; as lost as the whole map says, if that is more."""
        if self._anywhere.is_running:
            return self._anywhere.estimate(particles, self._stamp(frame))
        estimate = particles.estimate(self._stamp(frame))
        return replace(estimate, lost_score=max(estimate.lost_score, self._watch.lost))

    def _move(self, particles: ParticleFilter, frame: int) -> None:
        increment = self._increments[frame - 1]
        particles.predict(increment)
        self._plan.move(increment.delta)
        self._travelled_m += float(np.hypot(*increment.delta[:2]))
        self._since_measured.append(increment)
        self._unknown_m2 += 0.5 * float(np.trace(increment.covariance[:2, :2]))

    def _due(self) -> bool:
        if self._settings.measure_every_frames is not None:
            return len(self._since_measured) >= self._settings.measure_every_frames
        every_m = self._settings.measure_every_m
        if self._plan.phase is Phase.ANYWHERE:
            every_m = max(every_m, self._settings.search.whole_map_every_m)
        return self._since_measured_m >= every_m

    @property
    def _since_measured_m(self) -> float:
        """How far the vehicle may have come since the last measurement, by an odometry that may not have watched."""
        return max(self._travelled_m - self._measured_at_m, math.sqrt(self._unknown_m2))

    def _measure_if_due(
        self, particles: ParticleFilter, frame: int, watch: Stopwatch
    ) -> tuple[Measurement | None, str]:
        """The measurement, or None and (when one was due) why there is none."""
        if not self._due():
            return None, ""
        prediction = particles.estimate(self._stamp(frame))
        is_anywhere = self._plan.phase is Phase.ANYWHERE
        if not (is_anywhere or self._drive.sequence.map.grid.contains(prediction.pose[:2])):
            reason = "the prediction lies outside the map"
        else:
            try:
                return self._measure(frame, prediction, watch), ""
            except ScanError as error:
                reason = str(error)
        self._note(frame, f"not measured: {reason}")
        return None, reason

    def _measure(self, frame: int, prediction: Estimate | None, watch: Stopwatch) -> Measurement:
        sequence = self._drive.sequence
        with watch("scan"):
            points = sequence.scan(int(self._drive.indices[frame]))
        if self._plan.phase is Phase.ANYWHERE:
            with watch("match"):
                everywhere = self._anywhere.match(points, self._filter)
            return Measurement(points, self._anywhere.region(), everywhere, self._temperature())
        search = self._plan.region(prediction)
        with watch("match"):
            likelihood = match_scan(self._matcher, points, sequence.ground_z, sequence.map, search)
        return Measurement(points, search, likelihood, self._temperature())

    def _temperature(self) -> float:
        """1 for the first measurement of a drive or a search, more when little way lies between two of them."""
        is_first = self._filter is None or (self._plan.phase is Phase.ANYWHERE and not self._anywhere.is_running)
        if is_first or self._correlation_m == 0.0:
            return 1.0
        return correlated_error_temperature(self._since_measured_m, self._correlation_m)

    def _start(self, measurement: Measurement) -> tuple[ParticleFilter, float]:
        """The filter after the first measurement, and the ln density that it gave to the start's box."""
        in_box = self._prior.sample(self._settings.particles, self._rng)
        density = measurement.likelihood.log_density(in_box)
        evidence = float(logsumexp(density) - np.log(len(density)))
        if isinstance(measurement.likelihood, TwoLevelLikelihood):
            return self._anywhere.update(None, measurement.likelihood, measurement.temperature, None), evidence
        return self._filter_from_start(measurement, None), evidence

    def _filter_from_start(self, measurement: Measurement, motion: OdometryIncrement | None) -> ParticleFilter:
        """A filter with the posterior of all measurements since the start."""
        flattened = measurement.likelihood.tempered(measurement.temperature)
        cloud, log_weights = self._start_cloud.add(flattened, motion)
        return ParticleFilter(cloud, self._rng, self._settings.filter, log_weights)

    def _update(self, particles: ParticleFilter, frame: int, measurement: Measurement) -> float:
        if isinstance(measurement.likelihood, TwoLevelLikelihood):
            density = measurement.likelihood.log_density(particles.particles)
            self._update_anywhere(Predicted.of(particles), frame, measurement.likelihood, measurement.temperature)
            return float(logsumexp(density + particles.log_weights))
        report = particles.update(measurement.likelihood, measurement.temperature)
        if self._plan.record(measurement.search, report.log_evidence, report.lost_score):
            self._note(frame, f"searching for {self._plan.phase.value}")
            self._prepare_whole_map(frame)
        if self._plan.phase is Phase.START and len(self._start_cloud) < MOST_MEASUREMENTS:
            self._filter = self._filter_from_start(measurement, accumulate(self._since_measured))
        elif report.injected:
            self._note(frame, f"evidence collapsed: {report.injected} particles drawn anew from the measurement")
        return report.log_evidence

    def _update_anywhere(
        self, predicted: Predicted, frame: int, likelihood: TwoLevelLikelihood, temperature: float
    ) -> None:
        """Weigh all places on the map; track the one that wins."""
        particles = self._anywhere.update(predicted, likelihood, temperature, accumulate(self._since_measured))
        share = self._anywhere.share(particles)
        if self._plan.record_places(share):
            particles = self._anywhere.settle(particles)
            self._watch.restart(self._travelled_m, 1.0 - share)
            x, y, _ = particles.estimate(self._stamp(frame)).pose
            self._note(frame, f"found at ({x:.1f}, {y:.1f})")
        self._filter = particles

    def _look_around(
        self, particles: ParticleFilter, predicted: Predicted, frame: int, measurement: Measurement
    ) -> None:
        """Now and then, ask the whole map whether the vehicle is where the filter has it; if not, search all of it.

        The search begins with this scan, and so with the filter as it was before it.
        """
        is_due = self._plan.phase is Phase.LOST or self._watch.is_due(self._travelled_m)
        if not (is_due and self._plan.follows_filter and self._prepare_whole_map(frame)):
            return
        contrast = self._anywhere.contrast(measurement.points, particles.estimate(self._stamp(frame)))
        if self._watch.record(self._travelled_m, contrast) > self._settings.search.lost_threshold:
            self._plan.give_up()
            self._note(frame, f"searching for {self._plan.phase.value}: this scan fits elsewhere")
            everywhere = self._anywhere.match(measurement.points, particles)
            self._update_anywhere(predicted, frame, everywhere, 1.0)

    def _prepare_whole_map(self, frame: int) -> bool:
        """Have the map ready to be searched; when the matcher cannot, say so once and search about the filter."""
        if self._plan.has_whole_map:
            try:
                self._anywhere.prepare()
            except SkyfixError as error:
                self._plan.without_whole_map()
                self._note(frame, f"the whole map is not searched: {error}")
        return self._plan.has_whole_map

    def _keep(self, frame: int, estimate: Estimate, measurement: Measurement | None) -> None:
        self.estimates.append(estimate)
        self.patches.append(None if measurement is None else measurement.patch(estimate))
        if measurement is None:
            return
        self.best[frame] = measurement.best_pose()
        self._measured_at_m, self._since_measured, self._unknown_m2 = self._travelled_m, [], 0.0
        kept, wanted = len(self.snapshots), self._settings.snapshots
        if kept < wanted and self._travelled_m >= kept * self._way_m / wanted:
            sequence = self._drive.sequence
            self.snapshots.append(
                take_snapshot(
                    int(self._drive.indices[frame]),
                    measurement,
                    sequence.map,
                    sequence.ground_z,
                    estimate.pose,
                    self._drive.true_pose(frame),
                )
            )

    def _stamp(self, frame: int) -> int:
        return int(self._drive.stamps_ns[frame])

    def _note(self, frame: int, text: str) -> None:
        self.log.append(f"frame {self._drive.indices[frame]} ({format_seconds(self._stamp(frame))} s): {text}")
