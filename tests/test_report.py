"""The report says what the run's numbers say, stands by itself, and works with whatever a run lacks."""

from __future__ import annotations

import base64
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_run import SIGMA, made_run

from fusion.trajectory import Trajectory
from sequences.figures import frames_figure, series_of, trajectories_figure
from sequences.figures.frames import bev_picture, covariance_ellipse
from sequences.figures.map_drawing import round_length
from sequences.report import write_report
from sequences.report_tables import method_rows, provenance, stage_rows, verdict
from sequences.track_settings import TrackSettings

NAME = "<b>drive</b> & co"
WITH_TRUTH = ("error", "covariance", "nees")
ALWAYS = ("trajectories", "frames", "health")
VOID_TAGS = {"meta", "link", "img", "br", "hr", "input"}


class Page(HTMLParser):
    """Reads a page: its text, its sections, every attribute; checks that tags nest."""

    def __init__(self, page: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.sections: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "section":
            self.sections.append(dict(attrs)["id"] or "")
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert write_report(made_run(name=NAME), folder) == folder / "report.html"
    return folder


@pytest.fixture(scope="module")
def page(run_folder: Path) -> Page:
    return Page(run_folder / "report.html")


def test_page_has_every_section_in_order(page: Page) -> None:
    pictures = ["trajectories", "error", "covariance", "nees", "frames", "health"]
    assert page.sections == ["provenance", "methods", *pictures, "timing", "log", "settings"]
    assert page.open == []


def test_page_needs_no_other_file_or_host(page: Page, run_folder: Path) -> None:
    sources = [value for _, name, value in page.attributes if name in ("src", "href", "srcset", "data", "action")]
    assert len(sources) == len(WITH_TRUTH) + len(ALWAYS)
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert {tag for tag, _, _ in page.attributes}.isdisjoint({"script", "link", "iframe", "object"})
    text = (run_folder / "report.html").read_text(encoding="utf-8")
    assert "url(" not in text
    assert "@import" not in text
    assert "<script" not in text


@pytest.mark.parametrize("name", [*ALWAYS, *WITH_TRUTH])
def test_pictures_beside_the_page_are_those_in_it(name: str, page: Page, run_folder: Path) -> None:
    png = (run_folder / f"{name}.png").read_bytes()
    embedded = [
        value.partition(",")[2] for tag, attribute, value in page.attributes if (tag, attribute) == ("img", "src")
    ]
    assert base64.b64encode(png).decode() in embedded
    picture = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    height, width = picture.shape[:2]
    assert 800 <= width <= 2000
    assert 400 <= height <= 2000
    inked = (picture < 250).any(axis=2)
    assert 0.01 < inked.mean() < 0.99
    # The drawing reaches into every third of the picture: no panel is blank or squeezed into a corner.
    assert all(part.any() for rows in np.array_split(inked, 3) for part in np.array_split(rows, 3, axis=1))


def test_text_from_outside_is_escaped(page: Page, run_folder: Path) -> None:
    assert "<b>drive</b>" not in (run_folder / "report.html").read_text(encoding="utf-8")
    assert NAME in page.text
    assert "<i>second line</i>" in page.text


def test_page_gives_the_metrics(page: Page) -> None:
    metrics = made_run().metrics
    for method in ("prior", "odometry", "single_shot", "filter", "smoother"):
        assert f"{metrics[method]['position_error_m']['mean']:.2f}" in page.text
        assert f"{metrics[method]['heading_error_deg']['max']:.2f}" in page.text
    assert f"{metrics['smoother']['nees']['mean']:.2f}" in page.text
    for entry in fields(TrackSettings):
        assert entry.name in page.text


def test_verdict_states_mean_error_length_and_drift() -> None:
    result = made_run()
    mean = result.metrics["filter"]["position_error_m"]["mean"]
    drift = result.metrics["drift"]["odometry_final_error_m"]
    said = verdict(result, series_of(result))
    assert [float(number) for number in re.findall(r"\d+\.\d+", said)] == [round(mean, 2), round(drift, 1)]
    assert f"{result.length_m:.0f} m" in said


def test_simulation_and_emulation_are_stated_only_where_true() -> None:
    made_up = " ".join(provenance(made_run()))
    assert "simulated" in made_up
    assert "emulated:" in made_up
    real = " ".join(provenance(replace(made_run(), scans_simulated=False, odometry_source="lidar_gicp")))
    assert "simulated" not in real
    assert "emulated" not in real


def test_without_truth_there_are_no_errors(tmp_path: Path) -> None:
    page = Page(write_report(made_run(with_truth=False), tmp_path))
    assert set(page.sections).isdisjoint(WITH_TRUTH)
    assert set(ALWAYS) <= set(page.sections)
    assert "no ground truth" in page.text
    assert "mean position error" not in page.text
    assert not any((tmp_path / f"{name}.png").exists() for name in WITH_TRUTH)


def test_one_frame_and_no_snapshots(tmp_path: Path) -> None:
    page = Page(write_report(made_run(frames=1, snapshots=0), tmp_path))
    assert "frames" not in page.sections
    assert {"trajectories", "error", "nees", "health"} <= set(page.sections)


def test_signed_errors_and_sigmas_are_on_the_vehicle_axes() -> None:
    result = made_run(frames=8)
    assert result.truth is not None
    north = np.tile([50.0, 40.0, np.pi / 2], (8, 1))
    north[:, 1] += np.arange(8)
    covariance = np.tile(np.diag([4.0, 9.0, 0.01]), (8, 1, 1))
    ahead_and_left = north + np.array([-0.5, 2.0, 0.1])
    stamps = result.stamps_ns
    series = series_of(
        replace(
            result, truth=Trajectory(stamps, north), filter=Trajectory(stamps, ahead_and_left, covariance), snapshots=[]
        )
    )
    np.testing.assert_allclose(series.errors["filter"].signed, np.tile([2.0, 0.5, 0.1], (8, 1)), atol=1e-12)
    np.testing.assert_allclose(series.claims["filter"].sigma, np.tile([3.0, 2.0, 0.1], (8, 1)), atol=1e-12)
    np.testing.assert_allclose(series.claims["filter"].nees, 0.25 / 4 + 4.0 / 9 + 1.0)
    np.testing.assert_allclose(series.distance_m, np.arange(8), atol=1e-12)


def test_sigma_is_that_of_the_errors_drawn_from_it() -> None:
    series = series_of(made_run(frames=400))
    signed, claim = series.errors["filter"].signed, series.claims["filter"]
    np.testing.assert_allclose(claim.sigma, np.tile(SIGMA, (400, 1)))
    # chi-square(3) has variance 6: the mean of 400 lies within 4 standard errors of 3.
    assert abs(claim.nees.mean() - 3.0) < 4.0 * np.sqrt(6.0 / 400)
    assert abs((signed / SIGMA).std() - 1.0) < 0.1


def test_snapshots_are_placed_by_their_scan_index() -> None:
    result = made_run()
    shifted = replace(
        result,
        frame_rows=[replace(row, index=row.index + 1000) for row in result.frame_rows],
        snapshots=[replace(snapshot, index=snapshot.index + 1000) for snapshot in result.snapshots],
    )
    series = series_of(shifted)
    titles = [axes.get_title() for axes in frames_figure(shifted, series).axes[: len(shifted.snapshots)]]
    expected = [f"frame {s.index}, {series.distance_m[s.index - 1000]:.0f} m" for s in shifted.snapshots]
    assert titles == expected


def test_ellipse_holds_the_stated_probability() -> None:
    rng = np.random.default_rng(3)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    centre = np.array([10.0, -3.0, 0.0])
    ellipse = covariance_ellipse(centre, covariance, level=0.8)
    points = rng.multivariate_normal(centre[:2], covariance, size=4000)
    angle = np.deg2rad(ellipse.angle)
    along = (points - centre[:2]) @ np.array([np.cos(angle), np.sin(angle)])
    across = (points - centre[:2]) @ np.array([-np.sin(angle), np.cos(angle)])
    inside = (2 * along / ellipse.width) ** 2 + (2 * across / ellipse.height) ** 2 <= 1.0
    assert abs(inside.mean() - 0.8) < 4.0 * np.sqrt(0.8 * 0.2 / 4000)


def test_stage_times_are_over_the_frames_that_had_the_stage() -> None:
    result = made_run()
    rows = {row.name: row for row in stage_rows(result)}
    assert rows["match"].frames == sum(row.measured for row in result.frame_rows)
    assert rows["match"].mean_ms == pytest.approx(41.0)
    assert rows["predict"].frames == len(result.frame_rows)
    assert rows["smooth"].mean_ms == pytest.approx(0.5)
    assert sum(row.share for row in rows.values()) == pytest.approx(1.0)
    assert [row.share for row in stage_rows(result)] == sorted((row.share for row in rows.values()), reverse=True)


def test_methods_without_a_claim_have_no_consistency() -> None:
    rows = {row.label: row for row in method_rows(made_run())}
    assert rows["odometry alone"].cells[-3:-1] == ["–", "–"]
    assert rows["filter"].cells[-2].endswith("%")
    assert len({len(row.cells) for row in rows.values()}) == 1


@pytest.mark.parametrize(
    ("target", "expected"), [(1.0, 1.0), (0.99, 0.5), (4.99, 2.0), (5.0, 5.0), (73.0, 50.0), (200.0, 200.0)]
)
def test_scale_bars_are_round(target: float, expected: float) -> None:
    assert round_length(target) == expected


def test_a_scan_that_hits_nothing_is_blank_paper() -> None:
    assert (bev_picture(np.zeros((3, 8, 8), dtype=np.float32)) == 255).all()


def test_the_worst_moment_is_one_that_the_truth_covers() -> None:
    whole = made_run(frames=120)
    assert whole.truth is not None
    part = replace(whole, truth=whole.truth.within(int(whole.stamps_ns[20]), int(whole.stamps_ns[79])))
    series = series_of(part)
    figure = trajectories_figure(part, series)
    (axes,) = [each for each in figure.axes if "Worst after a quarter" in each.get_title(loc="left")]
    errors, settled = series.errors["filter"].position_m, series.distance_m[20:80] >= 0.25 * series.distance_m[-1]
    assert (len(errors), settled[0], settled[-1]) == (60, False, True)
    worst = np.where(settled, errors, 0.0)
    assert f"{worst.max():.2f} m" in axes.get_title(loc="left")
    centre = np.mean([axes.get_xlim(), axes.get_ylim()], axis=1)
    np.testing.assert_allclose(centre, whole.filter.poses[20 + int(worst.argmax()), :2])
