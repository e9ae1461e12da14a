"""What the filter knew about itself at each frame: effective particles, evidence of the measurements, lost score."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sequences.figures.series import FloatArray, RunSeries, trajectories_of
from sequences.figures.style import INK, METHODS, legend, log_axis, new_figure, plot_method, tidy
from sequences.run_result import FrameRow, RunResult


def health_figure(result: RunResult, series: RunSeries) -> Figure:
    """Draw claimed standard deviation, effective sample size, evidence and lost score over the distance travelled."""
    figure = new_figure(12.0, 8.2)
    sigma, size, evidence, lost = figure.subplots(4, 1, sharex=True)
    _draw_sigma(sigma, result, series)
    rows = result.frame_rows
    colour = METHODS["filter"].colour
    distance_m = _distance(series, rows)
    particles = result.settings.particles
    share = [row.effective_sample_size / particles for row in rows]
    size.plot(distance_m, share, ".-", ms=1.5, lw=0.7, color=colour)
    size.set_ylim(0.0, 1.05)
    tidy(size, title=f"Effective sample size, share of {particles:,} particles", y="share")

    measured = [row for row in rows if row.log_evidence is not None]
    evidence.plot(_distance(series, measured), [row.log_evidence for row in measured], ".", ms=4, color=colour)
    tidy(evidence, title="Evidence: density that each measurement gave to the prediction", y="ln (1 / m² rad)")

    lost.plot(distance_m, [row.lost_score for row in rows], ".-", ms=1.5, lw=1.1, color=METHODS["odometry"].colour)
    lost.set_ylim(-0.04, 1.05)
    threshold = result.settings.search.lost_threshold
    lost.axhline(threshold, color=INK, lw=0.8, ls=":")
    tidy(lost, title=f"Lost score (dotted: {threshold:g}, above which the search widens)", x="distance travelled (m)")
    _mark_skipped(lost, series, rows)
    return figure


def _draw_sigma(axes: Axes, result: RunResult, series: RunSeries) -> None:
    for name, trajectory in trajectories_of(result).items():
        if trajectory.covariances is not None:
            worst = np.sqrt(np.linalg.eigvalsh(trajectory.covariances[:, :2, :2])[:, -1])
            plot_method(axes, name, series.distance_at(trajectory.stamp_ns), worst)
    log_axis(axes)
    tidy(axes, title="Claimed standard deviation of the position, along its worst direction", y="m, log")
    legend(axes, where="upper right", columns=2)


def _distance(series: RunSeries, rows: list[FrameRow]) -> FloatArray:
    return series.distance_at(np.array([row.stamp_ns for row in rows], dtype=np.int64))


def _mark_skipped(axes: Axes, series: RunSeries, rows: list[FrameRow]) -> None:
    skipped = [row for row in rows if row.skipped_reason]
    if skipped:
        axes.plot(_distance(series, skipped), np.zeros(len(skipped)), "x", ms=6, color=INK, label="scan not usable")
        axes.legend(fontsize=8, frameon=False)
