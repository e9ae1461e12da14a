"""The `skyfix` command: a thin layer over the library. What it prints and writes is made elsewhere.

Bad input is one line on standard error, `skyfix: error: ...`, and exit code 2. The heavy modules are imported by the
commands that need them, so that `--help` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from fusion.errors import SkyfixError
from sequences.cli_ablate import ablate
from sequences.cli_options import (
    BackendOption,
    CacheOption,
    ExtractsOption,
    HalfExtentOption,
    HalfHeadingOption,
    HalfHeadingsOption,
    HeadingUnknownOption,
    JsonOption,
    MatcherOption,
    MaxFramesOption,
    OutOption,
    OverwriteOption,
    PickleOption,
    QuietOption,
    SeedOption,
    StartAnywhereOption,
    WatchMapOption,
    training_line,
)

if TYPE_CHECKING:
    from sequences.sequence import Sequence
    from sequences.track_settings import TrackSettings

app = typer.Typer(
    name="skyfix",
    help="Drift-free vehicle tracking: scans matched with a map, fused with odometry.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command(epilog="Example: `skyfix demo --out runs/first`")
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


@app.command(
    epilog="Examples:\n\n"
    "`skyfix track drives/kitti_13 --odometry lidar_gicp`\n\n"
    "`skyfix track drives/mine --start 12.5 -80 90 --half-extent 30 --heading-unknown --out runs/mine`\n\n"
    "`skyfix track drives/mine --start-anywhere`"
)
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
    map_error_m: Annotated[
        float, typer.Option(help="How far off the map draws things, standard deviation, metres.", metavar="M")
    ] = 0.4,
    particles: Annotated[int, typer.Option(help="How many particles the filter has.", metavar="N")] = 10_000,
    allow_pickle: PickleOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Track one drive: particle filter and factor graph beside odometry, single shots and the prior.

    Writes a run directory (metrics.json, report.html, trajectories) and prints the errors, when there is ground truth.
    """
    from sequences.registry import OpenOptions, open_sequence
    from sequences.track_settings import TrackSettings

    opened = open_sequence(sequence, OpenOptions(seed, allow_pickle))
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
    )
    _run(opened, matcher, settings, out, overwrite, quiet, backend)


@app.command(
    epilog="Examples:\n\n"
    "`skyfix evaluate demo drives/kitti_360 --matcher geometric --json shots.json`\n\n"
    "`skyfix evaluate drives/mine --matcher rotmatch --matcher runs/hybrid/hybrid.safetensors "
    "--half-heading-deg 10 --half-heading-deg 180 --markdown table.md`"
)
def evaluate(
    sequences: Annotated[
        list[Path], typer.Argument(help="Drives with ground truth, lists of frames.", metavar="SEQUENCE")
    ],
    matcher: Annotated[
        list[str] | None,
        typer.Option(
            help="As for track; give it several times to compare. Default: rotmatch and geometric.", metavar="NAME|FILE"
        ),
    ] = None,
    half_extent: HalfExtentOption = 20.0,
    half_heading_deg: HalfHeadingsOption = None,
    heading_unknown: HeadingUnknownOption = False,
    max_frames: MaxFramesOption = 200,
    seed: SeedOption = 0,
    allow_pickle: PickleOption = False,
    json_file: JsonOption = None,
    markdown_file: Annotated[
        Path | None,
        typer.Option("--markdown", help="Also write the table, with a legend, to this file.", metavar="FILE"),
    ] = None,
) -> None:
    """Score single shots: each scan by itself from a start that is off, beside the prior's own score.

    Frames of a list (KITTI + aerial) start where the list says, whatever the options.
    """
    from learned.matcher import load_matcher
    from sequences.evaluate import evaluate_frames, evaluate_single_shot
    from sequences.evaluation_tables import markdown_page, markdown_table, matcher_labels
    from sequences.frame_set import FrameSet
    from sequences.registry import OpenOptions, open_any
    from sequences.shot_protocol import ShotProtocol

    headings = list(half_heading_deg or ([] if heading_unknown else [10.0])) + ([180.0] if heading_unknown else [])
    protocols = [ShotProtocol(half_extent, heading, max_frames, seed) for heading in dict.fromkeys(headings)]
    labels = matcher_labels(matcher or ["rotmatch", "geometric"])
    loaded = {label: load_matcher(name) for label, name in labels.items()}
    evaluations = []
    for path in sequences:
        opened = open_any(path, OpenOptions(seed, allow_pickle))
        if isinstance(opened, FrameSet):
            evaluations.append(evaluate_frames(opened, loaded, max_frames))
        else:
            evaluations += [evaluate_single_shot(opened, loaded, protocol) for protocol in protocols]
    typer.echo(markdown_table(evaluations), nl=False)
    _write_json(json_file, evaluations)
    _write_text(markdown_file, markdown_page(evaluations, labels))


@app.command(epilog="Example: `skyfix convert KITTI/raw_data/2011_09_26/2011_09_26_drive_0013_sync drives/kitti_13`")
def convert(
    source: Annotated[Path, typer.Argument(help="Any drive that track opens.", metavar="SRC")],
    target: Annotated[Path, typer.Argument(help="New or empty folder to write.", metavar="DIR")],
    seed: SeedOption = 0,
    allow_pickle: PickleOption = False,
) -> None:
    """Write a drive in the folder format: map, scans, ground truth and every odometry."""
    from sequences.folder import write_folder
    from sequences.registry import OpenOptions, open_sequence

    opened = open_sequence(source, OpenOptions(seed, allow_pickle))
    write_folder(target, opened)
    typer.echo(f"{target}: {len(opened.stamps_ns)} scans of {opened.name}")


@app.command(
    epilog="Examples:\n\n"
    "`skyfix train rotmatch.yaml --data osm --out runs/training`\n\n"
    "`skyfix train rotmatch.yaml --data osm --set training.batch=16 --minutes 90 --cache samples`\n\n"
    "`torchrun --nproc-per-node 2 -m sequences.cli train rotmatch.yaml --data osm`"
)
def train(
    config: Annotated[Path, typer.Argument(help="YAML file with the training's settings.", metavar="CONFIG")],
    data: ExtractsOption = Path(),
    out: Annotated[Path, typer.Option(help="Gets the checkpoint, the loss curve and the cache.", metavar="DIR")] = Path(
        "runs/training"
    ),
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="Replace a setting of CONFIG, as in training.steps=500; may be repeated.", metavar="KEY=VALUE"
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            help="Time a few steps and set the number of steps to take about so long in all; a resumed run keeps its.",
            metavar="M",
        ),
    ] = None,
    cache: CacheOption = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Also write the losses as TensorBoard event files into OUT.")
    ] = False,
    initial: Annotated[
        Path | None,
        typer.Option(
            help="Start from the weights of this checkpoint, of the same architecture: fine-tuning.",
            metavar="CHECKPOINT",
        ),
    ] = None,
) -> None:
    """Train a network on scans simulated in OpenStreetMap extracts; goes on where it was stopped.

    CONFIG says which network and how. Under torchrun, all its processes train one network together.
    """
    from sequences.train_command import TrainOptions, train_from_config

    options = TrainOptions(tuple(override or ()), minutes, cache, tensorboard, initial)
    checkpoint = train_from_config(config, data, out, training_line, options)
    if os.environ.get("RANK", "0") == "0":  # of the processes that torchrun starts, the first speaks
        typer.echo(f"checkpoint: {checkpoint}")


@app.command(
    epilog="Examples:\n\n"
    "`skyfix export rotmatch --out exported`\n\n"
    "`skyfix export runs/training/rotmatch.safetensors --out exported --int8 drives/kitti_13`"
)
def export(
    checkpoint: Annotated[
        str, typer.Argument(help="rotmatch (shipped) or a .safetensors file of it.", metavar="CHECKPOINT")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write.", metavar="DIR")],
    int8: Annotated[
        Path | None,
        typer.Option(
            help="Also write 8-bit graphs, with ranges taken from this drive with ground truth, or from the demo.",
            metavar="SEQUENCE|demo",
        ),
    ] = None,
    frames: Annotated[int, typer.Option(help="Scans of the drive to take ranges from.", metavar="N")] = 16,
    seed: SeedOption = 0,
) -> None:
    """Write RotMatch's encoders as ONNX graphs, for `--matcher DIR` with a quicker runtime than torch."""
    from learned.export import export as write_export
    from learned.matcher import load_matcher
    from learned.rotmatch import RotMatch
    from sequences.matched_images import matched_images
    from sequences.registry import OpenOptions, open_sequence

    matcher = load_matcher(checkpoint, "torch")
    images = []
    if int8 is not None and isinstance(matcher, RotMatch):
        images = matched_images(open_sequence(int8, OpenOptions(seed)), matcher, frames)
    typer.echo(f"export: {write_export(matcher, out, images)}")


app.command(
    epilog="Examples:\n\n"
    "`skyfix ablate learned/configs/ablation_hybrid.yaml --data osm --out runs/ablation --minutes 20 --seeds 0,1,2`\n\n"
    "`skyfix ablate learned/configs/sensitivity_hybrid.yaml --data osm --evaluate drives/mine`"
)(ablate)


@app.command(epilog="Example: `skyfix view runs/demo-emulated-seed0`")
def view(run: Annotated[Path, typer.Argument(help="Run directory.", metavar="RUN")]) -> None:
    """Print the table of a run again, and where its report is."""
    from sequences.run_files import read_metrics

    _show(read_metrics(run), run / "report.html")


@app.command(epilog="Example: `skyfix benchmark filter_step --json timings.json`")
def benchmark(
    name: Annotated[
        str | None,
        typer.Argument(
            help="filter_step, grid_filter, inference, smoother or translocnet. Default: all.", metavar="NAME"
        ),
    ] = None,
    runs: Annotated[int, typer.Option(help="Timed runs of each implementation.", metavar="N")] = 15,
    json_file: JsonOption = None,
) -> None:
    """Time skyfix beside peers (numpy, torch, filterpy, scipy) that do the same work on the same made-up input.

    The last column is the time in units of skyfix's own: above 1, skyfix is the quicker.
    `make benchmark` holds it all to one thread. With --json, plots of the filter's step are written beside FILE.
    """
    from benchmarks import markdown_table, run_benchmarks, thread_statement
    from benchmarks.filter_packages import missing_packages
    from benchmarks.plots import write_plots

    rows = run_benchmarks(name, runs, lambda line: print(line, file=sys.stderr))
    for package in missing_packages() if any(row["benchmark"] == "filter_step" for row in rows) else ():
        print(f"not measured: {package} is not installed (pip install 'skyfix[benchmark]')", file=sys.stderr)
    typer.echo(f"{thread_statement()}\n\n{markdown_table(rows)}", nl=False)
    _write_json(json_file, rows)
    if json_file is not None:
        for plot in write_plots(rows, json_file):
            print(f"plot: {plot}", file=sys.stderr)


@app.callback(invoke_without_command=True)
def _root(show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if show_version:
        typer.echo(f"skyfix {version('skyfix')}")
        raise typer.Exit


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


def _write_json(path: Path | None, content: object) -> None:
    _write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _write_text(path: Path | None, content: str) -> None:
    if path is None:
        return
    try:
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be written: {error.strerror}") from error


def main() -> None:
    """Run the command line; the console script `skyfix`."""
    try:
        app()
    except SkyfixError as error:
        print(f"skyfix: error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
