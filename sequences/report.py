"""report.html: one run on one page that stands by itself, and its figures as PNG files beside it.

The page holds its pictures (base64) and its style; it asks nothing of any other file or host, so it can be mailed.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import jinja2

from sequences.figures import (
    RunSeries,
    covariance_figure,
    error_figure,
    frames_figure,
    health_figure,
    nees_figure,
    png_bytes,
    series_of,
    trajectories_figure,
)
from sequences.report_tables import cards, method_rows, provenance, settings_rows, stage_rows, verdict
from sequences.run_result import RunResult


@dataclass(frozen=True, slots=True)
class Picture:
    """A rendered figure with its place on the page; `name` is its anchor and its file's stem."""

    name: str
    title: str
    caption: str
    png: bytes

    @property
    def data_uri(self) -> str:
        """The picture as text that an <img> takes as its source."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


def write_report(result: RunResult, out_dir: Path) -> Path:
    """Write report.html and its figures to `out_dir`.

    Parameters
    ----------
    result
        The run. Without ground truth the page says so and gives no errors.
    out_dir
        An existing folder; files of an earlier report are replaced.

    Returns
    -------
    Path of report.html.
    """
    series = series_of(result)
    pictures = _pictures(result, series)
    for picture in pictures:
        (out_dir / f"{picture.name}.png").write_bytes(picture.png)
    page = out_dir / "report.html"
    page.write_text(_render(result, series, pictures), encoding="utf-8")
    return page


def _pictures(result: RunResult, series: RunSeries) -> list[Picture]:
    """Draw what the run has: errors need ground truth, frames need snapshots."""
    pictures = [
        Picture(
            "trajectories",
            "Trajectories",
            "Map frame in metres, north up. The pink square is all that was known of the start.",
            png_bytes(trajectories_figure(result, series)),
        )
    ]
    if series.errors:
        pictures += _error_pictures(series)
    if result.snapshots:
        pictures.append(
            Picture(
                "frames",
                "A few frames",
                "Top: the scan in the vehicle's frame, forward to the right. Middle: the map and the poses. Bottom: "
                "the likelihood of the position, the best over all headings, on the searched part of the map; from "
                "dark to clear it falls by 10 nats.",
                png_bytes(frames_figure(result, series)),
            )
        )
    pictures.append(
        Picture(
            "health",
            "Does the filter know?",
            "What can be told at run time, without any ground truth.",
            png_bytes(health_figure(result, series)),
        )
    )
    return pictures


def _error_pictures(series: RunSeries) -> list[Picture]:
    return [
        Picture(
            "error",
            "Error along the drive",
            "A dot is one scan matched with the map on its own. Odometry drifts; filter and smoother must not.",
            png_bytes(error_figure(series)),
        ),
        Picture(
            "covariance",
            "Claimed uncertainty against error",
            "Signed errors in the true vehicle's frame inside the 1- and 2-sigma bands that were claimed for them.",
            png_bytes(covariance_figure(series)),
        ),
        Picture(
            "nees",
            "Consistency",
            "Left: normalised estimation error squared, and the interval that holds 95 % of a consistent estimator's "
            "values. Right: how often the truth lies in the region that is claimed to hold it with some probability.",
            png_bytes(nees_figure(series)),
        ),
    ]


def _render(result: RunResult, series: RunSeries, pictures: list[Picture]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sequences", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(
        title=result.sequence_name,
        verdict=verdict(result, series),
        cards=cards(result, series),
        provenance=provenance(result),
        methods=method_rows(result),
        pictures=pictures,
        stages=stage_rows(result),
        settings=settings_rows(result),
        log=result.log,
    )
