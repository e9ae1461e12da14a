"""The figures of a report, each made from a run without touching the disk."""

from sequences.figures.consistency import covariance_figure, nees_figure
from sequences.figures.errors import error_figure
from sequences.figures.frames import frames_figure
from sequences.figures.health import health_figure
from sequences.figures.series import RunSeries, series_of
from sequences.figures.style import png_bytes
from sequences.figures.trajectories import trajectories_figure

__all__ = [
    "RunSeries",
    "covariance_figure",
    "error_figure",
    "frames_figure",
    "health_figure",
    "nees_figure",
    "png_bytes",
    "series_of",
    "trajectories_figure",
]
