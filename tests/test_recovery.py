"""Finding a lost vehicle again: kidnapped, or started anywhere, with an emulated matcher that has decoys."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from made_drive import EmulatedMatcher, MadeDrive, write_made_drive
from numpy.typing import NDArray

from benchmarks.recovery_drives import IncidentMaker, SplicedSequence
from benchmarks.recovery_trials import auroc, right_after
from fusion import se2
from fusion.errors import SkyfixError
from fusion.grid import MapGrid
from fusion.likelihood import PoseLikelihood
from fusion.particle_filter import ParticleFilter
from fusion.pose_filter import UpdateReport
from fusion.prior import UniformPrior
from fusion.two_level import TwoLevelLikelihood
from learned.map_raster import MapRaster
from learned.matcher import SearchRegion
from sequences.anywhere import Candidates, GivenUp, Predicted, map_box
from sequences.anywhere_search import AnywhereSearch
from sequences.drive import load_drive
from sequences.folder import FolderSequence
from sequences.localize import track
from sequences.map_watch import MapWatch
from sequences.run_result import RunResult
from sequences.search import Phase, SearchPlan
from sequences.search_settings import SearchSettings
from sequences.track_settings import TrackSettings

SETTINGS = TrackSettings(
    "spliced", seed=1, particles=1500, snapshots=2, search=SearchSettings(max_half_extent_m=12.0), map_check_every_m=4.0
)
SIDE, TURN, BINS = 3, 5, 24
SIGMA = np.array([0.7, 0.7, np.deg2rad(3.0)])
DECOYS = 3


@dataclass
class EmulatedMapSearch:
    """Knows the truth: Gaussians about it and about a few decoys, which are elsewhere at every scan."""

    truth: NDArray[np.float64]
    grid: MapGrid

    def match(
        self, points: NDArray[np.float32], ground_z: float, near: NDArray[np.float64] | None = None
    ) -> TwoLevelLikelihood:
        index = round(float(points[0, 3]) * 1000)
        rng = np.random.default_rng([11, index])
        box = map_box(self.grid)
        places = np.concatenate([self.truth[[index]] + rng.normal(size=(1, 3)) * SIGMA, box.sample(DECOYS, rng)])
        rows, cols = (int(extent // 3) + 1 for extent in (self.grid.height_m, self.grid.width_m))
        coarse_grid = MapGrid(rows, cols, 3.0, self.grid.x0, self.grid.y0)
        coarse = np.full((rows, cols, BINS), -30.0, np.float32)
        wanted = places if near is None else np.concatenate([places, near])
        cut = np.concatenate([_cells_about(coarse_grid, pose) for pose in wanted])
        cut = np.unique(cut, axis=0)
        fine_grid = MapGrid(rows * SIDE, cols * SIDE, 1.0, self.grid.x0, self.grid.y0)
        index_of = cut[:, None, None, None] * [SIDE, SIDE, TURN] - [0, 0, TURN // 2]
        index_of = index_of + np.stack(
            np.meshgrid(np.arange(SIDE), np.arange(SIDE), np.arange(TURN), indexing="ij"), -1
        )
        xy = fine_grid.xy_from_pixel(index_of[..., :2] + 0.5)
        poses = np.concatenate([xy, index_of[..., 2:] * 2 * np.pi / (BINS * TURN)], axis=-1)
        fine = np.logaddexp.reduce(
            [self._log_gaussian(poses, place) for place in places] + [np.full(xy.shape[:-1], -30.0)]
        )
        return TwoLevelLikelihood.from_scores(coarse, coarse_grid, cut, fine)

    def contrast(
        self, points: NDArray[np.float32], ground_z: float, pose: NDArray[np.float64], reach: NDArray[np.float64]
    ) -> float:
        index = round(float(points[0, 3]) * 1000)
        return 0.0 if np.hypot(*(self.truth[index] - pose)[:2]) < 10.0 else 8.0

    @staticmethod
    def _log_gaussian(poses: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
        offset = poses - place
        offset[..., 2] = se2.wrap(offset[..., 2])
        return -0.5 * ((offset / SIGMA) ** 2).sum(axis=-1)


def _cells_about(grid: MapGrid, pose: NDArray[np.float64]) -> NDArray[np.int64]:
    row, col = np.floor(grid.pixel_from_xy(pose[:2])).astype(int)
    yaw = round(pose[2] * BINS / (2 * np.pi))
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.array([row, col, yaw]) + steps
    cells[:, 2] %= BINS
    return cells[((cells[:, :2] >= 0) & (cells[:, :2] < [grid.rows, grid.cols])).all(axis=1)]


@dataclass
class MapWideMatcher(EmulatedMatcher):
    """The emulated matcher, with a whole-map search."""

    prepared: list[MapRaster] = field(default_factory=list)

    def over_map(self, map_raster: MapRaster) -> EmulatedMapSearch:
        self.prepared.append(map_raster)
        return EmulatedMapSearch(self.truth, map_raster.grid)


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> MadeDrive:
    """Half a circle of some 75 m radius."""
    return write_made_drive(tmp_path_factory.mktemp("long") / "drive", 110, map_half_extent_m=170.0)


def kidnapped(made: MadeDrive) -> SplicedSequence:
    """35 frames, then 40 from some 120 m away."""
    drive = load_drive(FolderSequence(made.path), "wheels")
    return SplicedSequence(drive, [np.arange(35), np.arange(65, 105)])


def errors_of(result: RunResult) -> NDArray[np.float64]:
    assert result.truth is not None
    return np.hypot(*(result.filter.poses - result.truth.poses)[:, :2].T)


def run(sequence: object, made: MadeDrive, matcher: type[EmulatedMatcher], **changed: object) -> RunResult:
    return track(sequence, matcher(made.truth.poses), replace(SETTINGS, **changed))


@pytest.fixture(scope="module")
def recovered(long_drive: MadeDrive) -> RunResult:
    return run(kidnapped(long_drive), long_drive, MapWideMatcher)


def test_a_kidnapped_vehicle_is_found_and_the_score_says_so(recovered: RunResult) -> None:
    errors, scores = errors_of(recovered), np.array([row.lost_score for row in recovered.frame_rows])
    assert errors[10:35].max() < 2.5
    assert errors[35] > 50.0
    assert errors[55:].max() < 2.5
    assert scores[10:35].max() < 0.05
    assert scores[36:45].max() > 0.5
    assert scores[-5:].max() < 0.05
    assert any("on the whole map: this scan fits elsewhere" in line for line in recovered.log)
    assert any("found at" in line for line in recovered.log)


def test_a_place_that_was_just_found_is_doubted_for_the_share_of_the_others(
    long_drive: MadeDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares, doubts = [], []
    share, restart = AnywhereSearch.share, MapWatch.restart

    def shared(search: AnywhereSearch, particles: ParticleFilter) -> float:
        shares.append(0.95 * share(search, particles))
        return shares[-1]

    def restarted(watch: MapWatch, way_m: float, lost: float) -> None:
        doubts.append((lost, 1.0 - shares[-1]))
        restart(watch, way_m, lost)

    monkeypatch.setattr(AnywhereSearch, "share", shared)
    monkeypatch.setattr(MapWatch, "restart", restarted)
    run(kidnapped(long_drive), long_drive, MapWideMatcher)
    assert len(doubts) >= 1
    for doubt, others in doubts:
        assert doubt == others == pytest.approx(0.05, abs=0.03)


def test_the_search_begins_with_the_filter_before_the_scan_that_gave_rise_to_it(
    long_drive: MadeDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search weighs the poses with that scan itself; nothing of it may be in them."""
    weighed: list[tuple[NDArray[np.float64], float]] = []
    begun: list[tuple[Predicted, bool]] = []
    update, search = ParticleFilter.update, AnywhereSearch.update

    def updated(particles: ParticleFilter, likelihood: PoseLikelihood, temperature: float = 1.0) -> UpdateReport:
        weighed.append((particles.particles, particles.lost_score))
        return update(particles, likelihood, temperature)

    def searched(anywhere: AnywhereSearch, predicted: Predicted | None, *rest: Any) -> ParticleFilter:
        assert predicted is not None
        begun.append((predicted, anywhere.is_running))
        return search(anywhere, predicted, *rest)

    monkeypatch.setattr(ParticleFilter, "update", updated)
    monkeypatch.setattr(AnywhereSearch, "update", searched)
    run(kidnapped(long_drive), long_drive, MapWideMatcher)
    first, was_running = begun[0]
    assert not was_running
    assert any(np.array_equal(first.poses, poses) and first.lost_score == lost for poses, lost in weighed)


def test_a_kidnapping_is_tracked_the_same_way_with_the_same_seed(recovered: RunResult, long_drive: MadeDrive) -> None:
    again = run(kidnapped(long_drive), long_drive, MapWideMatcher)
    np.testing.assert_array_equal(recovered.filter.poses, again.filter.poses)
    np.testing.assert_array_equal(recovered.filter.covariances, again.filter.covariances)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_start_anywhere_is_found(long_drive: MadeDrive, seed: int) -> None:
    settings = replace(SETTINGS, odometry="wheels", start_anywhere=True, seed=seed)
    result = track(FolderSequence(long_drive.path), MapWideMatcher(long_drive.truth.poses), settings)
    errors = errors_of(result)
    assert errors[25:].max() < 2.5
    assert result.metrics["prior"]["position_error_m"]["mean"] > 30.0
    assert result.prior.half_heading_rad == np.pi
    assert result.metrics["smoother"]["position_error_m"]["mean"] < 5.0


def test_a_vehicle_that_is_never_lost_is_tracked_as_without_the_watch(long_drive: MadeDrive) -> None:
    sequence = FolderSequence(long_drive.path)
    settings = replace(SETTINGS, odometry="wheels")
    watched = track(sequence, MapWideMatcher(long_drive.truth.poses), settings)
    alone = track(sequence, EmulatedMatcher(long_drive.truth.poses), settings)
    np.testing.assert_array_equal(watched.filter.poses, alone.filter.poses)


def test_a_matcher_that_cannot_says_so_in_one_line_and_goes_on(long_drive: MadeDrive) -> None:
    result = run(kidnapped(long_drive), long_drive, EmulatedMatcher)
    told = [line for line in result.log if "the whole map is not searched" in line]
    assert len(told) == 1
    assert "got emulated, which sees a fixed crop" in told[0]
    assert len(result.frame_rows) == 75
    with pytest.raises(SkyfixError, match="whole-map search: expected a matcher that votes"):
        run(kidnapped(long_drive), long_drive, EmulatedMatcher, start_anywhere=True)


@pytest.mark.parametrize("every_m", [0.0, 4.0])
def test_a_wrong_place_that_was_found_is_given_up_again_without_a_watch_too(
    long_drive: MadeDrive, monkeypatch: pytest.MonkeyPatch, every_m: float
) -> None:
    settle, wrong = AnywhereSearch.settle, []

    def settled(search: AnywhereSearch, particles: ParticleFilter) -> ParticleFilter:
        right = settle(search, particles)
        if wrong:
            return right
        wrong.append(right.particles + [0.0, 60.0, 0.0])
        return ParticleFilter(wrong[0], 0, SETTINGS.filter)

    monkeypatch.setattr(AnywhereSearch, "settle", settled)
    settings = replace(SETTINGS, odometry="wheels", start_anywhere=True, map_check_every_m=every_m)
    found = track(FolderSequence(long_drive.path), MapWideMatcher(long_drive.truth.poses), settings)
    errors = errors_of(found)
    assert errors[:60].max() > 40.0
    assert errors[-20:].max() < 2.5
    assert sum("found at" in line for line in found.log) == 2
    assert sum("this scan fits elsewhere" in line for line in found.log) == 1


def test_settings_of_a_start_anywhere_are_checked() -> None:
    with pytest.raises(SkyfixError, match="start: expected none with start_anywhere"):
        TrackSettings("wheels", start=(0.0, 0.0, 0.0), start_anywhere=True)
    with pytest.raises(SkyfixError, match="winner_share: expected above"):
        SearchSettings(winner_share=1.0)
    with pytest.raises(SkyfixError, match="map_check_every_m: expected 0 or more"):
        TrackSettings("wheels", map_check_every_m=-1.0)


def lost_plan() -> SearchPlan:
    plan = SearchPlan(UniformPrior(np.zeros(3), 20.0, 0.2), TrackSettings("wheels"))
    for score in (0.0, 0.0, 0.0, 0.9, 0.9, 0.9):
        plan.record(REGION, 5.0, score)
    assert plan.phase is Phase.LOST
    return plan


REGION = SearchRegion(np.zeros(3), 10.0, 0.5)


def test_a_wide_search_that_does_not_find_it_soon_gives_way_to_the_whole_map() -> None:
    plan = lost_plan()
    assert [plan.record(REGION, 5.0, 0.9) for _ in range(3)] == [False, False, True]
    assert plan.phase is Phase.ANYWHERE
    assert [plan.record_places(share) for share in (0.95, 0.6, 0.95, 0.95)] == [False, False, False, True]
    assert plan.phase is Phase.TRACK


def test_a_vehicle_that_is_lost_again_soon_is_looked_for_on_the_whole_map() -> None:
    for way_m, expected in ((20.0, Phase.ANYWHERE), (80.0, Phase.LOST)):
        plan = lost_plan()
        for _ in range(3):
            plan.record(REGION, 5.0, 0.0)
        assert plan.phase is Phase.TRACK
        plan.move(np.array([way_m, 0.0, 0.0]))
        for _ in range(3):
            plan.record(REGION, 5.0, 0.9)
        assert plan.phase is expected


def test_without_a_whole_map_a_lost_vehicle_stays_lost() -> None:
    plan = lost_plan()
    plan.without_whole_map()
    for _ in range(10):
        plan.record(REGION, 5.0, 0.9)
    assert plan.phase is Phase.LOST


def test_what_is_known_of_a_vehicle_that_was_given_up_is_a_density_that_it_is_drawn_from() -> None:
    grid = MapGrid(60, 80, 1.0, 0.0, 0.0)
    cloud = np.random.default_rng(0).normal([30.0, 20.0, 1.0], [1.0, 1.0, 0.1], (4000, 3))
    known = GivenUp.by(Predicted.of(ParticleFilter(cloud, 0)), grid)
    assert known.lost == 0.5
    poses = known.sample(200_000, np.random.default_rng(1))
    # Importance sampling of the volume of a box about the cloud: E[1 / density] over it is its volume.
    low, high = np.array([26.0, 16.0, 0.6]), np.array([34.0, 24.0, 1.4])
    inside = ((poses > low) & (poses < high)).all(axis=1)
    assert (inside / np.exp(known.log_density(poses))).mean() == pytest.approx((high - low).prod(), rel=0.1)
    assert known.log_density(np.array([[30.0, 500.0, 0.0]]))[0] < -100.0


def test_candidates_are_the_places_of_a_cloud() -> None:
    rng = np.random.default_rng(0)
    here, there = rng.normal([0.0, 0.0, 0.0], 0.3, (700, 3)), rng.normal([50.0, 0.0, 2.0], 0.3, (300, 3))
    particles = ParticleFilter(np.concatenate([here, there]), 0)
    found = Candidates.of(particles)
    assert found.share == pytest.approx(0.7)
    np.testing.assert_allclose(found.likely()[:2], [[0.0, 0.0, 0.0], [50.0, 0.0, 2.0]], atol=0.1)
    estimate = found.likeliest(particles.estimate(0))
    np.testing.assert_allclose(estimate.pose, 0.0, atol=0.1)
    assert estimate.lost_score == pytest.approx(0.3)
    alone = found.heaviest_alone(particles, 500, np.random.default_rng(1))
    assert alone.shape == (500, 3)
    assert np.abs(alone[:, 0]).max() < 5.0


def test_a_spliced_odometry_stands_still_at_the_jump(long_drive: MadeDrive) -> None:
    drive = load_drive(FolderSequence(long_drive.path), "wheels")
    spliced = SplicedSequence(drive, [np.arange(10, 20), np.arange(60, 70)], blind=range(3, 5))
    moved = spliced.odometry("spliced").poses
    steps = se2.between(moved[:-1], moved[1:])
    expected = se2.between(drive.odometry.poses[:-1], drive.odometry.poses[1:])
    np.testing.assert_allclose(steps[:9], expected[10:19], atol=1e-9)
    np.testing.assert_allclose(steps[9], 0.0, atol=1e-9)
    np.testing.assert_allclose(steps[10:], expected[60:69], atol=1e-9)
    assert (np.diff(spliced.stamps_ns) > 0).all()
    np.testing.assert_array_equal(spliced.scan(12), FolderSequence(long_drive.path).scan(62))
    with pytest.raises(SkyfixError, match="scan 4: withheld"):
        spliced.scan(4)


def test_incidents_are_where_they_are_asked_for(long_drive: MadeDrive) -> None:
    maker = IncidentMaker(load_drive(FolderSequence(long_drive.path), "wheels"))
    rng = np.random.default_rng(0)
    jump = maker.kidnapping(rng, 100.0, 40.0)
    truth = jump.sequence.ground_truth
    assert truth is not None
    assert abs(np.hypot(*(truth.poses[jump.last] - truth.poses[jump.last - 1])[:2]) - 100.0) <= 10.0
    assert 60.0 <= jump.way_m[jump.last] <= 103.0
    gap = maker.outage(rng, 20.0, 60.0, 20.0)
    assert gap.way_m[gap.last] - gap.way_m[gap.first] == pytest.approx(60.0, abs=3.0)
    with pytest.raises(SkyfixError, match="expected 1000 m in one piece, found none"):
        maker.anywhere(rng, 1000.0)


def test_right_again_is_when_the_error_stays_small() -> None:
    way = np.arange(-3.0, 17.0) * 2.0
    errors = np.full(20, 50.0)
    errors[8:] = 1.0
    assert right_after(errors, way, 3, 10.0) == 10.0
    assert right_after(errors[:13], way, 3, 10.0) is None  # not for long enough yet
    errors[10] = 3.0
    assert right_after(errors, way, 3, 10.0) == 16.0
    assert right_after(np.full(20, 50.0), way, 3, 10.0) is None


def test_auroc_is_the_chance_that_a_positive_scores_higher() -> None:
    rng = np.random.default_rng(0)
    scores, positive = rng.integers(0, 6, 200).astype(float), rng.random(200) < 0.3
    pairs = scores[positive][:, None] - scores[~positive]
    assert auroc(scores, positive) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean())
    assert auroc(scores, np.zeros(200, bool)) is None
