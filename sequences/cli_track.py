"""The commands `skyfix demo`, `track` and `view`; `sequences.cli` lists them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from fusion.errors import SkyfixError
from sequences.cli_options import (
    BackendOption,
    HalfExtentOption,
    HalfHeadingOption,
    HeadingUnknownOption,
    MatcherOption,
    OutOption,
    OverwriteOption,
    PickleOption,
    QuietOption,
    SeedOption,
    StartAnywhereOption,
    WatchMapOption,
)

if TYPE_CHECKING:
    from sequences.sequence import Sequence
    from sequences.track_settings import TrackSettings


def demo(
    out: OutOption = None,
    seed: SeedOption = 0,
    matcher: MatcherOption = "rotmatch",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """The whole story with no data: about 2 km through Helsinki's streets, scans simulated, odometry that drifts."""
    from sequences.demo import DemoSequence
    from sequences.track_settings import TrackSettings

    sequence = DemoSequence(seed)
    _run(sequence, matcher, TrackSettings(default_odometry(sequence), seed=seed), out, overwrite, quiet)


def track(
    sequence: Annotated[
        Path,
        typer.Argument(
            help="Folder with map.json, odometry/*.tum, scans/, or a drive of KITTI or CARLA (see the README).",
            metavar="SEQUENCE",
        ),
    ],
    odometry: Annotated[
        str | None,
        typer.Option(help="One of SEQUENCE/odometry/*.tum. Default: the first that is not emulated.", metavar="NAME"),
    ] = None,
    out: OutOption = None,
    seed: SeedOption = 0,
    matcher: MatcherOption = "rotmatch",
    backend: BackendOption = None,
    start: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Where the drive starts: metres, metres, degrees counter-clockwise from east, map frame. "
            "Default: the true first pose plus a random offset within the start's box (needs ground truth).",
            metavar="X Y YAW",
        ),
    ] = None,
    start_anywhere: StartAnywhereOption = False,
    half_extent: HalfExtentOption = 20.0,
    half_heading_deg: HalfHeadingOption = 10.0,
    heading_unknown: HeadingUnknownOption = False,
    measure_every_m: Annotated[
        float, typer.Option(help="Match a scan with the map every so many metres of odometry.", metavar="M")
    ] = 4.0,
    measure_every_frames: Annotated[
        int | None, typer.Option(help="Match every so many frames instead.", metavar="N")
    ] = None,
    correlation_length_m: Annotated[
        float | None,
        typer.Option(help="How far the matcher's errors stay alike, metres. Default: the matcher's own.", metavar="M"),
    ] = None,
    watch_map_every: WatchMapOption = 0.0,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Correct the odometry by what an earlier run with it has found, clock, mounting, scale and noise. "
            "Default: the filter takes it as it comes; the smoother finds its errors by itself.",
            metavar="RUN",
        ),
    ] = None,
    map_error_m: Annotated[
        float, typer.Option(help="How far off the map draws things, standard deviation, metres.", metavar="M")
    ] = 0.4,
    particles: Annotated[int, typer.Option(help="How many particles the filter has.", metavar="N")] = 10_000,
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Change any setting that a run's config.yaml lists, as in filter.resampler=stratified or "
            "limits.gap_s=2; may be repeated.",
            metavar="KEY=VALUE",
        ),
    ] = None,
    allow_pickle: PickleOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Track one drive: particle filter and factor graph beside odometry, single shots and the prior.

    Writes a run directory (metrics.json, report.html, trajectories) and prints the errors, when there is ground truth.
    """
    from sequences.dotted_keys import changed
    from sequences.registry import OpenOptions, open_sequence
    from sequences.run_files import doubts_of, read_calibration
    from sequences.track_settings import SETTABLE, TrackSettings

    opened = open_sequence(sequence, OpenOptions(seed, allow_pickle))
    for doubt in doubts_of(calibration) if calibration is not None else ():
        typer.echo(f"warning: --calibration {calibration}: this run is doubtful: {doubt}", err=True)
    settings = TrackSettings(
        odometry=odometry or default_odometry(opened),
        seed=seed,
        particles=particles,
        half_extent_m=half_extent,
        half_heading_deg=180.0 if heading_unknown else half_heading_deg,
        start=start,
        start_anywhere=start_anywhere,
        measure_every_m=measure_every_m,
        measure_every_frames=measure_every_frames,
        correlation_length_m=correlation_length_m,
        map_error_m=map_error_m,
        map_check_every_m=watch_map_every,
        calibration=None if calibration is None else read_calibration(calibration),
    )
    _run(opened, matcher, changed(settings, override or (), SETTABLE), out, overwrite, quiet, backend)


def view(run: Annotated[Path, typer.Argument(help="Run directory.", metavar="RUN")]) -> None:
    """Print the table of a run again, and where its report is."""
    from sequences.run_files import read_metrics

    _show(read_metrics(run), run / "report.html")


def default_odometry(sequence: Sequence) -> str:
    """The first odometry that is not emulated, or else the first.

    Raises
    ------
    SkyfixError
        If the sequence has none.
    """
    from sequences.sequence import odometry_is_emulated

    if not sequence.odometry_names:
        raise SkyfixError(f"{sequence.name}: has no odometry: expected odometry/NAME.tum")
    return min(sequence.odometry_names, key=odometry_is_emulated)


def _run(
    sequence: Sequence,
    matcher_name: str,
    settings: TrackSettings,
    out: Path | None,
    overwrite: bool,
    quiet: bool,
    backend: str | None = None,
) -> None:
    from learned.matcher import load_matcher
    from sequences.localize import track as track_drive
    from sequences.progress import ConsoleProgress
    from sequences.run_directory import write_run
    from sequences.run_files import check_target

    out = out or Path("runs") / f"{sequence.name}-{settings.odometry}-seed{settings.seed}"
    check_target(out, overwrite)
    matcher = load_matcher(matcher_name, backend)
    with ConsoleProgress(Console(stderr=True, quiet=quiet), sequence.name) as progress:
        result = track_drive(sequence, matcher, settings, progress)
    _show(result.metrics, write_run(result, out, overwrite))


def _show(metrics: dict[str, object], report: Path) -> None:
    from sequences.tables import closing_lines, run_table, run_title

    console = Console(highlight=False)
    if "filter" in metrics:
        console.print(run_table(metrics))
    else:
        console.print(run_title(metrics), soft_wrap=True)
    for line in closing_lines(metrics):
        console.print(line, soft_wrap=True)
    console.print(f"report: {report}", soft_wrap=True)
