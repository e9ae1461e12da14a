"""The `skyfix` command: a thin layer over the library. What it prints and writes is made elsewhere.

Bad input is one line on standard error, `skyfix: error: ...`, and exit code 2. The heavy modules are imported by the
commands that need them, so that `--help` answers at once.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from fusion.errors import SkyfixError
from sequences.cli_ablate import ablate
from sequences.cli_bag import bag
from sequences.cli_check import check
from sequences.cli_emulate import emulate
from sequences.cli_evaluate import evaluate
from sequences.cli_map import draw_map
from sequences.cli_options import JsonOption, PickleOption, SeedOption, write_json
from sequences.cli_retrieve import retrieve, train_places
from sequences.cli_sweep import sweep
from sequences.cli_track import demo, track, view
from sequences.cli_train import export, train

app = typer.Typer(
    name="skyfix",
    help="Drift-free vehicle tracking: scans matched with a map, fused with odometry.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.command(epilog="Example: `skyfix demo --out runs/first`")(demo)
app.command(epilog="Example: `skyfix check drives/mine --picture mine.png`")(check)
app.command(
    epilog="Examples:\n\n"
    "`skyfix track drives/kitti_13 --odometry lidar_gicp`\n\n"
    "`skyfix track drives/mine --start 12.5 -80 90 --half-extent 30 --heading-unknown --out runs/mine`\n\n"
    "`skyfix track drives/mine --start-anywhere`\n\n"
    "`skyfix track drives/mine --matcher my_network.py:MyNetwork`\n\n"
    "`skyfix track drives/mine --set filter.adaptive.most=50000 --set noise.lateral_m_per_sqrt_m=0.02`"
)(track)
app.command(epilog="Example: `skyfix view runs/demo-emulated-seed0`")(view)
app.command(
    epilog="Examples:\n\n"
    "`skyfix sweep drives/monday drives/tuesday --odometry wheels --odometry kiss_icp --seeds 0,1,2`\n\n"
    "`skyfix sweep drives/mine --set 'particles=[500,2000,10000]' --set 'measure_every_m=[2,4,8]' --jobs 4`\n\n"
    "`skyfix sweep demo --matcher rotmatch --matcher runs/mine/hybrid.safetensors --out runs/networks`"
)(sweep)
app.command(
    epilog="Examples:\n\n"
    "`skyfix evaluate demo drives/kitti_360 --matcher geometric --json shots.json`\n\n"
    "`skyfix evaluate drives/mine --matcher rotmatch --matcher runs/hybrid/hybrid.safetensors "
    "--half-heading-deg 10 --half-heading-deg 180 --markdown table.md`\n\n"
    "`skyfix evaluate drives/kitti_360 --matcher exported --backend openvino-int8`"
)(evaluate)
app.command(
    epilog="Examples:\n\n"
    "`skyfix train learned/configs/hybrid.yaml --data osm --out runs/hybrid`\n\n"
    "`skyfix train learned/weights/rotmatch_near.yaml --data osm --set training.batch=16 --minutes 90 "
    "--cache samples`\n\n"
    "`torchrun --nproc-per-node 2 -m sequences.cli train learned/configs/hybrid.yaml --data osm`"
)(train)
app.command(
    epilog="Examples:\n\n"
    "`skyfix ablate learned/configs/ablation_hybrid.yaml --data osm --out runs/ablation --minutes 20 --seeds 0,1,2`\n\n"
    "`skyfix ablate learned/configs/sensitivity_hybrid.yaml --data osm --evaluate drives/mine`"
)(ablate)
app.command(
    epilog="Examples:\n\n"
    "`skyfix export rotmatch --out exported`\n\n"
    "`skyfix export runs/training/rotmatch.safetensors --out exported --int8 drives/kitti_13`"
)(export)
app.command(
    epilog="Examples:\n\n"
    "`skyfix emulate drives/kitti_00 --odometry sptam --measure-every-m 0`\n\n"
    "`skyfix emulate drives/kitti_00 --odometry sptam --correlation 0.9 --markdown emulated.md`"
)(emulate)
app.command(
    epilog="Examples:\n\n"
    "`skyfix retrieve drives/kitti_360 --index maps/karlsruhe.npz --places places.csv`\n\n"
    "`skyfix retrieve drives/mine --matcher runs/mine/rotmatch.safetensors --embedding runs/mine/places.safetensors`"
)(retrieve)
app.command(
    "train-places",
    epilog="Example: `skyfix train-places learned/weights/rotmatch.yaml --data osm "
    "--matcher runs/mine/rotmatch.safetensors --out runs/mine/places.safetensors`",
)(train_places)

app.command(
    "map",
    epilog="Example: `skyfix map karlsruhe.osm.pbf drives/mine --origin 49.0116 8.4169 --half-extent 800`",
)(draw_map)

app.command(
    epilog="Examples:\n\n"
    "`skyfix bag drive.bag drives/mine`\n\n"
    "`skyfix bag recording drives/mine --scans /velodyne_points --odometry /kiss/odometry --every 5`"
)(bag)


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


@app.command(epilog="Example: `skyfix benchmark filter_step --json timings.json`")
def benchmark(
    name: Annotated[
        str | None,
        typer.Argument(
            help="filter_step, fixed_lag, grid_filter, inference, smoother or translocnet. Default: all.",
            metavar="NAME",
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
    write_json(json_file, rows)
    if json_file is not None:
        for plot in write_plots(rows, json_file):
            print(f"plot: {plot}", file=sys.stderr)


@app.callback(invoke_without_command=True)
def _root(show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    if show_version:
        typer.echo(f"skyfix {version('skyfix')}")
        raise typer.Exit


def main() -> None:
    """Run the command line; the console script `skyfix`."""
    try:
        app()
    except SkyfixError as error:
        print(f"skyfix: error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
